"""``quest report``: a page about a run of ``quest track``."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from quest.cli.console import Console
from quest.data.store import locate_take
from quest.errors import TakeError
from quest.types import Take, Tracks

if TYPE_CHECKING:
    from quest.viz.report import Drift, RunRecord


@dataclass(frozen=True)
class Report:
    """Write one HTML page about a run of quest track: what happened, video, time lines, joints, world, settings."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that quest track wrote."""
    out: Path | None = None
    """The page; default: report.html in the folder."""
    open: bool = False
    """Open the page in a browser."""

    def run(self) -> int:
        """Compare with the truth if there is any, write, open."""
        from quest.viz.report import write_report

        console = Console()
        out = write_report(self.folder, self.out, compare=drift_of)
        console.print(f"report: {out} ({out.stat().st_size / 2**20:.1f} MiB)")
        if self.open and not webbrowser.open(out.resolve().as_uri()):
            console.note("no browser could be opened; open the page yourself")
        return 0


def drift_of(tracks: Tracks, run: RunRecord | None) -> Drift | str:
    """How far the tracks of a run are from the truth of its take, or in words why that is not known."""
    if run is None:
        return "The recording is not known without run.json, so there is nothing to compare with."
    given = run.recording.given
    if "://" in given:
        return "The recording is at a URL, which a report does not open."
    if not given.rstrip("/\\").endswith(".zarr"):
        return "The recording is no take, so its truth is not known."
    try:
        store, name = locate_take(given)
        take = store.read(name, views=())
    except TakeError as error:
        return f"The take cannot be read, so there is nothing to compare with: {error}"
    if len(take) != len(tracks):
        return f"The take has {len(take)} frames and the tracks have {len(tracks)}, so they are not of each other."
    return measure_drift(tracks, take)


def measure_drift(tracks: Tracks, take: Take) -> Drift:
    """Distance of each track from the entity that it was nearest to at first, as ``docs/metrics.md`` defines it."""
    from quest.evaluation.metrics import GATE, MISSING, accuracy, distance, identity
    from quest.evaluation.protocols import assign
    from quest.viz.report import Drift

    unit = take.info.half_diagonal_m
    truth = take.point_world[:, take.tracked]
    bound = np.asarray(np.isfinite(tracks.uv_px).all(axis=-1))
    pairs = assign(_first_gap(tracks, truth, bound) / unit, np.ones((len(tracks.names), truth.shape[1]), bool))
    queries, own = (np.array(each, dtype=int) for each in (zip(*pairs, strict=True) if pairs else ((), ())))
    gap = np.full(bound.shape, np.nan)
    right = np.full(len(tracks.names), np.nan)
    names: list[str | None] = [None] * len(tracks.names)
    if pairs:
        points, counted = tracks.point_world[:, queries], bound[:, queries]
        gap[:, queries] = np.where(counted, distance(points, truth[:, own], half_diagonal_m=unit), np.nan)
        shares = accuracy(identity(points, truth, own, half_diagonal_m=unit).T, own, counted.T)
        right[queries] = shares.total / np.maximum(shares.count, 1)
        for k, e in pairs:
            names[k] = take.info.entities[take.tracked[e]].name
    return Drift(tuple(names), gap, right, gate=GATE, unit_m=unit, missing=MISSING)


def _first_gap(tracks: Tracks, truth: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Mean distance in metres of each query and entity over the query's first frames; NaN where it has no point."""
    from quest.evaluation.protocols import START_FRAMES

    gaps = np.full((len(tracks.names), truth.shape[1]), np.nan)
    for k in range(len(tracks.names)):
        first = slice(int(bound[:, k].argmax()), int(bound[:, k].argmax()) + START_FRAMES)
        gap = np.linalg.norm(tracks.point_world[first, k, None] - truth[first], axis=-1)
        known = gap[np.isfinite(gap).all(axis=1)]
        if len(known):
            gaps[k] = known.mean(axis=0)
    return gaps
