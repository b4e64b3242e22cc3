"""How a run was made, and the page about it: everything in one HTML file that needs no network."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quest import __version__
from quest.data.video import probe_video
from quest.errors import InputError, RecordingError
from quest.extras import require
from quest.tracks import read_tracks
from quest.types import Camera, Query, Tracks
from quest.untrusted import build, read_json, reading, require_file
from quest.viz.narrate import alarm_spans, narrate, summarise
from quest.viz.palette import HELD, LOST
from quest.viz.report.plots import Drift, Thinning, coordinates, drift_plot, time_lines, world
from quest.whole_file import whole_file
from quest.wording import counted

RUN_FILE = "run.json"
RUN_VERSION = 1
_REMEDY = "track again, or delete it: the report then does without"
MOST_VIDEO_BYTES = 64 * 2**20
"""A larger video is not put into the page."""
MOST_ALARMS = 200
MOST_SENTENCES = 200
"""More are counted and not listed."""
_MOST_KNOTS = 5000
_LONGEST_NAME = 80
_JOINERS = "\u200c\u200d"
"""Invisible, and part of how some scripts and pictographs are written."""


@dataclass(frozen=True)
class Recorded:
    """The recording that was tracked."""

    given: str
    """As it was given on the command line."""
    view: int
    """Which view of it, where it is a take."""
    name: str
    """Its name."""
    frames: int
    """How many were tracked."""
    camera: Camera
    """Intrinsics of every frame."""
    has_depth: bool
    """Whether it brought any depth."""
    notes: tuple[str, ...]
    """Its degradations in words."""


@dataclass(frozen=True)
class RunRecord:
    """How a run was made."""

    quest: str
    """Version of quest."""
    date: str
    """When tracking ended, ISO 8601 with the offset of its time zone."""
    command: str
    """The command that does it again, in a shell's words."""
    recording: Recorded
    """What was tracked."""
    weights: str
    """Name or file of the weights."""
    weights_hash: str | None
    """SHA-256 of their file."""
    alpha: float
    """Of the monitor."""
    alpha_frames: int | None
    """Frames that alpha is for; None for the whole recording."""
    device: str
    """Where the networks ran."""
    queries: tuple[Query, ...] | None
    """As asked; None where entities were discovered."""
    overlay: bool
    """Whether the run drew ``overlay.mp4``."""
    took_s: float
    """Seconds that tracking took, without reading and drawing."""


def write_run(run: RunRecord, folder: Path) -> None:
    """Write ``run.json`` into a folder, whole or not at all."""
    with whole_file(folder / RUN_FILE) as partial:
        partial.write_text(json.dumps({"version": RUN_VERSION, **asdict(run)}, allow_nan=False, indent=1) + "\n")


def read_run(folder: Path) -> RunRecord | None:
    """The record in a folder; None where it has none.

    Raises:
        InputError: it is damaged or of another format version.
    """
    path = folder / RUN_FILE
    if not path.exists():
        return None
    value = read_json(path, InputError, _REMEDY)
    with reading(path, InputError, _REMEDY):
        value = build(dict, value, "run")
        version = value.pop("version", None)
        if version != RUN_VERSION:
            raise ValueError(f"format version {version!r}, expected {RUN_VERSION}")
        return build(RunRecord, value, "run")


class Video(NamedTuple):
    """The overlay video, or why there is none."""

    uri: str | None
    """Its bytes as a data URI."""
    missing: str
    """Why there is none; empty where there is."""
    frames_per_s: float = 30.0
    """Nominal rate."""
    note: str = ""
    """What is odd about it."""


Compare = Callable[[Tracks, RunRecord | None], Drift | str]
"""Says how far tracks are from the truth, or why that is not known."""


def not_compared(tracks: Tracks, run: RunRecord | None) -> Drift | str:
    """Why a page that Python wrote has no truth."""
    return "Nothing was compared: the command quest report compares runs on takes with their truth."


def write_report(run: str | Path, out: str | Path | None = None, *, compare: Compare = not_compared) -> Path:
    """Write a page about a run of ``quest track``, all or nothing; what is there already is replaced.

    Args:
        run: the run's folder: ``tracks.parquet``, and as far as they are there ``run.json`` and ``overlay.mp4``.
        out: file to write; ``report.html`` in the folder by default.
        compare: gives the drift, or why it is not known; ``quest report`` has one for takes.

    Returns:
        The file.

    Raises:
        InputError: there is no such folder, or it has no tracks, or a file in it is damaged.
        MissingExtraError: the extra ``viz`` is not installed.
    """
    jinja2, offline = require("jinja2"), require("plotly.offline")
    folder = Path(run)
    out = folder / "report.html" if out is None else Path(out)
    if out.is_dir():
        raise InputError(f"report {out}: this is a folder; name a file, such as {out / 'report.html'}")
    tracks, record = _read(folder)
    page = _content(folder, tracks, record, compare(tracks, record))
    own = Path(__file__).parent
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(own), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    files = {name: (own / f"page.{name}").read_text(encoding="utf-8") for name in ("css", "js")}
    plotly = {"plotly": offline.get_plotlyjs(), "plotly_version": require("plotly").__version__}
    text = environment.get_template("page.html").render(page | files | plotly)
    with whole_file(out) as partial:
        partial.write_bytes(text.encode("utf-8", "replace"))
    return out


def _read(folder: Path) -> tuple[Tracks, RunRecord | None]:
    """The tracks of a run, and how it was made."""
    if not folder.is_dir():
        what = "this is a file" if folder.exists() else "no such folder"
        raise InputError(f"run {folder}: {what}; expected the folder that quest track wrote, such as outputs/sample")
    if not (folder / "tracks.parquet").exists():
        raise InputError(f"run {folder}: expected tracks.parquet in it, found none; run quest track --out {folder}")
    tracks = read_tracks(folder / "tracks.parquet")
    if not len(tracks):
        raise InputError(f"run {folder}: its tracks have no frames, so there is nothing to tell; track again")
    return tracks, read_run(folder)


def _content(folder: Path, tracks: Tracks, record: RunRecord | None, drift: Drift | str) -> dict[str, Any]:
    """What the template needs."""
    tracks = replace(
        tracks,
        names=tuple(map(shown, tracks.names)),
        labels=tuple(label and shown(label) for label in tracks.labels),
        frame_flags=tuple(shown(flag, longest=500) for flag in tracks.frame_flags),
        stamp_s=tracks.stamp_s - tracks.stamp_s[0],
    )
    thinning, alarms, words = Thinning.of(len(tracks), len(tracks.names)), alarm_spans(tracks), narrate(tracks)
    video, lines, joints = _video(folder, tracks, record), time_lines(tracks, thinning), coordinates(tracks, thinning)
    space, truth = world(tracks, thinning), None if isinstance(drift, str) else drift_plot(tracks, drift, thinning)
    knots = np.unique(np.linspace(0, len(tracks) - 1, min(len(tracks), _MOST_KNOTS)).astype(int))
    clock = {
        "frames": len(tracks), "frames_per_s": video.frames_per_s, "knots": knots.tolist(),
        "stamp_s": np.round(tracks.stamp_s[knots], 4).tolist(),
    }  # fmt: skip
    poses = tracks.cam_from_world
    return {
        "name": shown(folder.resolve().name if record is None else record.recording.name),
        "what": _what(tracks, record), "record": record, "tracks": tracks, "video": video,
        "mismatch": record is not None and record.recording.frames != len(tracks),
        "words": words[:MOST_SENTENCES] or ["No entity was asked for or found."],
        "more_words": max(len(words) - MOST_SENTENCES, 0),
        "lines": summarise(tracks, alarms),
        "alarms": alarms[:MOST_ALARMS], "more_alarms": max(len(alarms) - MOST_ALARMS, 0),
        "monitored": tracks.lost_p is not None and bool(np.isfinite(tracks.lost_p).any()),
        "time_lines": lines, "coordinates": joints, "world": space, "drift_plot": truth, "drift": drift,
        "joints": _joint_rows(tracks), "drift_rows": [] if isinstance(drift, str) else _drift_rows(tracks, drift),
        "poses": poses is not None and bool(np.isfinite(poses).any()),
        "plots": {"clock": clock, "plots": [vars(plot) for plot in (lines, *joints, space, truth) if plot is not None]},
        "bin_frames": thinning.width, "colours": {"held": HELD, "lost": LOST}, "shown": shown, "version": __version__,
    }  # fmt: skip


def shown(text: str, *, longest: int = _LONGEST_NAME) -> str:
    """A text from outside as a page can show it: what cannot be printed is written out, what is long is cut."""
    seen = "".join(
        letter if letter.isprintable() or letter in _JOINERS else letter.encode("unicode_escape").decode()
        for letter in text[:longest]
    )
    return f"{seen}…" if len(text) > longest else seen


def _what(tracks: Tracks, record: RunRecord | None) -> str:
    """The recording in a line."""
    source = []
    if record is not None:
        camera = record.recording.camera
        source = [f"{camera.width} × {camera.height} px", "with depth" if record.recording.has_depth else "no depth"]
    length, queries = f"{tracks.stamp_s[-1]:.2f} s", counted(len(tracks.names), "query", "queries")
    return ", ".join((counted(len(tracks), "frame"), length, *source, queries))


def _video(folder: Path, tracks: Tracks, record: RunRecord | None) -> Video:
    path = folder / "overlay.mp4"
    if not path.exists():
        return Video(None, "There is no overlay.mp4: the run was told not to draw it, or only its tracks were saved.")
    if record is not None and not record.overlay:
        return Video(None, "The overlay.mp4 in the folder is of an earlier run: this one was told not to draw.")
    try:
        require_file(path, RecordingError)
        info = probe_video(path)
    except RecordingError as error:
        return Video(None, f"The video cannot be shown: {shown(str(error), longest=300)}.")
    if path.stat().st_size > MOST_VIDEO_BYTES:
        size, most = (f"{size / 2**20:.0f}" for size in (path.stat().st_size, MOST_VIDEO_BYTES))
        return Video(None, f"overlay.mp4 has {size} MiB and is not part of this page, which takes up to {most}.")
    uri = f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}"
    odd = info.frames not in (0, len(tracks))
    note = f"The video has {info.frames} frames, the tracks have {len(tracks)}: it is of another run." if odd else ""
    return Video(uri, "", info.frames_per_s, note)


def _joint_rows(tracks: Tracks) -> list[tuple[int, str, str, str, str]]:
    """Query, kind, range, axis and origin of each joint that is known."""
    joints = tracks.joints
    if joints is None:
        return []
    return [
        (k, kind, joints.describe(k).removeprefix(kind).strip() or "does not move", _vector(axis), _vector(origin))
        for k, (kind, axis, origin) in enumerate(zip(joints.kind, joints.axis, joints.origin, strict=True))
        if kind != "unknown"
    ]


def _vector(values: Sequence[float] | np.ndarray) -> str:
    return ", ".join(f"{value:z.3f}" for value in values) if np.isfinite(values).all() else "none"


def _drift_rows(tracks: Tracks, drift: Drift) -> list[tuple[int, str, str, str, str, str]]:
    """Query, entity, mean and largest distance, that at the end, and share of frames with the right identity."""
    rows = []
    for k, entity in enumerate(drift.entity):
        known = drift.distance[np.isfinite(drift.distance[:, k]), k]
        if entity is None or not len(known):
            rows.append((k, "none near it at first", "", "", "", ""))
        else:
            numbers = (f"{value:.3f}" for value in (known.mean(), known.max(), known[-1]))
            rows.append((k, shown(entity), *numbers, f"{drift.accuracy[k]:.0%}"))
    return rows
