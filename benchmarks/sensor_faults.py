"""Faults of a camera: are they flagged, is what is blind still tracked, and is everything found again afterwards?

    python -m benchmarks.sensor_faults --real VIDEO POSED --takes TAKES --out benchmarks/results/sensor_faults.json

Every fault lasts a second, from frame 15 on, and the clip is followed for half a second more. Flagged means a new flag
within three frames. Found again are queries within 12 pixels (of a diagonal of 800) of where the same clip has them
without the fault, of those that it has tracked there. A false flag is a new one in a frame without a fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro
from rich.console import Console

import quest
from benchmarks.study import rows_table
from quest.data.store import TakeStore
from quest.evaluation.drift import clopper_pearson
from quest.evaluation.real.run import shown
from quest.evaluation.real.sets import open_set
from quest.evaluation.report import provenance, write_report
from quest.track.state import StreamState
from quest.track.tracker import Tracker
from quest.types import Clip, Frame, Query

BEGIN, LASTS, AFTER = 15, 30, 15
WITHIN, NEAR = 3, 12 / 800

Fault = Callable[[np.ndarray, np.ndarray | None, Frame, np.random.Generator], tuple[np.ndarray, np.ndarray | None]]


def picture(change: Callable[[np.ndarray, Frame, np.random.Generator], np.ndarray], *, depth: bool = True) -> Fault:
    """A fault of the colours; without ``depth`` what stands before the lens blocks the depth too."""
    return lambda rgb, d, last, rng: (change(rgb, last, rng), d if depth or d is None else np.zeros_like(d))


def depths(change: Callable[[np.ndarray, Frame], np.ndarray]) -> Fault:
    """A fault of the depth alone."""
    return lambda rgb, d, last, rng: (rgb, None if d is None else change(d, last).astype(np.float32))


def half_black(rgb: np.ndarray) -> np.ndarray:
    """Without its left half."""
    return np.where(np.arange(rgb.shape[1])[:, None] < rgb.shape[1] // 2, 0, rgb).astype(np.uint8)


def blurred(rgb: np.ndarray) -> np.ndarray:
    """Out of focus."""
    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), rgb.shape[1] / 40))


def one_plane(depth_m: np.ndarray) -> np.ndarray:
    """The same depth everywhere."""
    return np.full_like(depth_m, np.median(depth_m[depth_m > 0]) if depth_m.any() else 1.0)


def shifted(depth_m: np.ndarray, share: float) -> np.ndarray:
    """Moved to the right by a share of the width."""
    return np.roll(depth_m, round(share * depth_m.shape[1]), axis=1)


def frozen_depth(depth_m: np.ndarray, last: Frame) -> np.ndarray:
    """That of the last frame before the fault."""
    return depth_m if last.depth_m is None else last.depth_m


BLIND: dict[str, Fault] = {
    "covered, black": picture(lambda rgb, last, rng: np.zeros_like(rgb), depth=False),
    "covered, dark with noise": picture(
        lambda rgb, last, rng: rng.integers(0, 6, rgb.shape).astype(np.uint8), depth=False
    ),
    "white": picture(lambda rgb, last, rng: np.full_like(rgb, 255), depth=False),
    "noise": picture(lambda rgb, last, rng: rng.integers(0, 256, rgb.shape).astype(np.uint8), depth=False),
    "frozen": lambda rgb, d, last, rng: (last.rgb, None if d is None else last.depth_m),
    "frozen colours": picture(lambda rgb, last, rng: last.rgb),
}
"""Faults in which nothing can be seen."""
DEGRADED: dict[str, Fault] = {
    "upside down": lambda rgb, d, last, rng: (rgb[::-1, ::-1].copy(), None if d is None else d[::-1, ::-1].copy()),
    "left half black": picture(lambda rgb, last, rng: half_black(rgb)),
    "out of focus": picture(lambda rgb, last, rng: blurred(rgb)),
    "overexposed": picture(lambda rgb, last, rng: np.clip(rgb.astype(int) * 6 + 60, 0, 255).astype(np.uint8)),
    "red and blue exchanged": picture(lambda rgb, last, rng: rgb[..., ::-1].copy()),
}
"""Faults in which something can be seen."""
DEPTH: dict[str, Fault] = {
    "depth times 1000": depths(lambda d, last: d * 1000),
    "depth times 10": depths(lambda d, last: d * 10),
    "no depth": depths(lambda d, last: np.zeros_like(d)),
    "frozen depth": depths(frozen_depth),
    "depth of one plane": depths(lambda d, last: one_plane(d)),
    "depth shifted by 1.3 % of the width": depths(lambda d, last: shifted(d, 0.013)),
    "depth shifted by 4 % of the width": depths(lambda d, last: shifted(d, 0.04)),
}
"""Faults of the depth."""


@dataclass(frozen=True)
class Played:
    """What came of one fault in one clip."""

    source: str
    fault: str
    inputs: str
    flagged: bool
    tracking: float
    """Share of answers that say so from the fourth frame of the fault on."""
    found: int
    """Queries that were found again."""
    queries: int
    """Of so many."""


class Player:
    """A clip that is tracked up to the fault once, then on with every fault and without."""

    def __init__(self, source: str, inputs: str, clip: Clip, queries: Sequence[Query], tracker: Tracker) -> None:
        self.source, self.inputs, self.clip, self.tracker = source, inputs, clip, tracker
        stream = tracker.stream(clip.camera, list(queries))
        states = [self._step(stream, t, None) for t in range(BEGIN)]
        self.data, self.usual = tracker.save(stream), set(states[-1].flags)
        self.healthy = self._follow(None)
        everything = [*states[2:], *self.healthy]
        self.frames, self.false_flags = len(everything), sum(bool(set(s.flags) - self.usual) for s in everything)

    def _step(self, stream: Any, t: int, fault: Fault | None) -> StreamState:
        frame = self.clip.frame(t)
        rgb, depth_m = frame.rgb, frame.depth_m
        if fault is not None and BEGIN <= t < BEGIN + LASTS:
            rgb, depth_m = fault(rgb, depth_m, self.clip.frame(BEGIN - 1), np.random.default_rng(t))
        return stream.step(rgb, depth_m, frame.stamp_s, frame.cam_from_world)

    def _follow(self, fault: Fault | None) -> list[StreamState]:
        stream = self.tracker.restore(self.data)
        return [self._step(stream, t, fault) for t in range(BEGIN, min(BEGIN + LASTS + AFTER, len(self.clip)))]

    def play(self, name: str, fault: Fault) -> Played:
        """One fault."""
        states = self._follow(fault)
        during, end, truth = states[:LASTS], states[-1], self.healthy[-1]
        near_px = NEAR * float(np.hypot(self.clip.camera.width, self.clip.camera.height))
        held = np.array([str(state) == "tracking" for state in truth.state])
        off_px = np.linalg.norm(end.uv_px - truth.uv_px, axis=-1)
        return Played(
            self.source,
            name,
            self.inputs,
            any(set(s.flags) - self.usual for s in during[:WITHIN]),
            float(np.mean([str(v) == "tracking" for s in during[WITHIN:] for v in s.state])),
            int((off_px[held] <= near_px).sum()),
            int(held.sum()),
        )


@dataclass(frozen=True)
class SensorFaults:
    """Play faults over real and simulated clips."""

    real: tuple[Path, ...] = ()
    """Sets of real recordings (docs/metrics.md)."""
    takes: Path | None = None
    """Store of simulated takes."""
    clips: int = 4
    """How many of each source, evenly spaced by name."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    out: Path | None = None
    """Result file, written anew after every clip."""

    def run(self) -> int:
        """Play them all, and show the table."""
        torch.set_num_threads(1)
        tracker = quest.load(self.weights, device="cpu")
        console, played, frames, flags = Console(highlight=False), list[Played](), 0, 0
        for player in self._players(tracker):
            kinds = {**BLIND, **DEGRADED, **(DEPTH if player.inputs != "colours" else {})}
            played += [player.play(name, fault) for name, fault in kinds.items()]
            frames, flags = frames + player.frames, flags + player.false_flags
            console.print(f"{player.source}, {player.clip.name}, {player.inputs}", markup=False)
            if self.out is not None:
                write_report(self._report(played, frames, flags, tracker), self.out)
        title = f"flagged within {WITHIN} frames; found again after {AFTER}"
        console.print(rows_table(title, self._report(played, frames, flags, tracker)["rows"]))
        console.print(f"false flags: {flags} of {frames} frames without a fault")
        return 0

    def _players(self, tracker: Tracker) -> Iterator[Player]:
        least = BEGIN + LASTS + AFTER
        for folder in self.real:
            clips = [(labelled, clip) for labelled in open_set(folder).clips if len(clip := labelled.read()) >= least]
            for labelled, clip in _spread(clips, self.clips):
                inputs, way = list(shown(clip).items())[-1]
                queries = [query for query in labelled.labels.queries() if query.frame == 0]
                if queries:
                    yield Player(folder.name, inputs, way, queries, tracker)
        if self.takes is None:
            return
        store = TakeStore(self.takes)
        for name in _spread(store.names(), self.clips):
            view = store.read(name).views[0]
            queries = [Query.point(0, *map(float, view.uv_px[0, e])) for e in np.flatnonzero(view.visible[0])[:8]]
            if len(view.clip) >= least and queries:
                for inputs, way in shown(view.clip).items():
                    if inputs != "depth and poses":
                        yield Player("simulated", inputs, way, queries, tracker)

    def _report(self, played: list[Played], frames: int, flags: int, tracker: Tracker) -> dict[str, Any]:
        rows = [
            _row(fault, where, chosen)
            for where in (*dict.fromkeys(p.source for p in played), "all")
            for fault in (*dict.fromkeys(p.fault for p in played), "all")
            if (chosen := [p for p in played if fault in (p.fault, "all") and where in (p.source, "all")])
        ]
        about = provenance() | {"weights": self.weights, "weights_hash": tracker.weights_hash}
        return about | {"false_flags": flags, "healthy_frames": frames, "rows": rows}


def _spread(items: Sequence[Any], number: int) -> list[Any]:
    """Some of many, evenly spaced."""
    return [
        items[i] for i in dict.fromkeys(np.linspace(0, len(items) - 1, min(number, len(items))).round().astype(int))
    ]


def _row(fault: str, where: str, played: Sequence[Played]) -> dict[str, Any]:
    flagged, found, queries = (
        sum(each) for each in zip(*((p.flagged, p.found, p.queries) for p in played), strict=True)
    )
    blind = [p.tracking for p in played if p.fault in BLIND]
    return {
        "fault": fault,
        "source": where,
        "plays": len(played),
        "flagged": flagged / len(played),
        "flagged_interval": list(clopper_pearson(flagged, len(played))),
        "tracking_while_blind": float(np.mean(blind)) if blind else None,
        "queries": queries,
        "found_again": found / queries if queries else None,
        "found_again_interval": list(clopper_pearson(found, queries)) if queries else None,
    }


if __name__ == "__main__":
    raise SystemExit(tyro.cli(SensorFaults).run())
