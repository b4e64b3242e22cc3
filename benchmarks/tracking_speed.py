"""Measure how long a frame takes, from picture to answers with monitor, by how many queries are followed.

    python benchmarks/tracking_speed.py --out benchmarks/results/speed/tracking.json

The packaged clip is played as a stream, in turn with each number of queries, which are points spread over what is
nearest to the camera in its first frame. Frame 0, in which they bind, and the few after it are not timed. `discovery`
is a first frame in which everything is to be found. `start` is a process of its own from its beginning to its end, with
compiled Python files. Let nothing else run meanwhile.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float
from rich.console import Console

import quest
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.evaluation.bootstrap import interval_over
from quest.evaluation.report import device_name, provenance, write_report
from quest.track import Stream, Tracker
from quest.types import Clip, Query

NEAREST = 0.3
"""Share of the first frame's pixels with depth that queries are asked for at: the nearest ones."""


STARTS = {
    "`import quest`": ["-c", "import quest"],
    "`quest --help`": ["-m", "quest", "--help"],
    "weights read, one picture answered": [
        "-c",
        "import quest; from quest.data.sample import sample_folder; clip = quest.read(sample_folder()); "
        "frame = clip.frame(0); quest.load().stream(clip.camera).step(frame.rgb, frame.depth_m, frame.stamp_s)",
    ],
}
"""What is started, and the arguments of Python."""


@dataclass(frozen=True)
class TrackingSpeed:
    """Milliseconds per frame of one stream."""

    queries: tuple[int, ...] = (1, 4, 8, 16, 32)
    """Numbers of queries."""
    turns: int = 5
    """How often each is played."""
    settled: int = 8
    """Frames of a turn that are not timed."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    device: str = "auto"
    """Where the networks run."""
    engines: tuple[str, ...] = ("torch", "bfloat16")
    """What runs them, as of quest track --engine."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Play all turns and print medians, high quantiles and frames per second."""
        clip = read_recording(sample_folder())
        if not self.engines or min(self.queries, default=0) < 1 or self.turns < 1 or not 0 < self.settled < len(clip):
            raise SystemExit(
                f"tracking_speed: expected engines, queries, turns and 1 to {len(clip) - 1} settled, got {self}"
            )
        trackers = {engine: quest.load(self.weights, device=self.device, engine=engine) for engine in self.engines}
        frames_ms: dict[tuple[str, int], list[np.ndarray]] = defaultdict(list)
        discovery_ms: dict[str, list[float]] = defaultdict(list)
        for (engine, tracker), _ in product(trackers.items(), range(self.turns)):
            self._discovery_ms(tracker, clip)  # warms up
            discovery_ms[engine].append(self._discovery_ms(tracker, clip))
            for count in self.queries:
                stream = tracker.stream(clip.camera, queries_on(clip, count))
                frames_ms[engine, count].append(played_ms(stream, clip)[self.settled :])
        result = {
            "rows": [
                {"engine": engine, "queries": count, **_summary(np.array(turns))}
                for (engine, count), turns in frames_ms.items()
            ],
            "discovery": [
                {"engine": engine, "median_ms": float(np.median(ms)), "n": len(ms)}
                for engine, ms in discovery_ms.items()
            ],
            "start": list(self._starts()),
        }
        Console(highlight=False).print_json(data=result, default=asdict)
        if self.out is not None:
            tracker = next(iter(trackers.values()))
            about = {"weights": self.weights, "weights_hash": tracker.weights_hash, "threads": torch.get_num_threads()}
            about |= {"device": device_name(tracker.device), "load": os.getloadavg()[0]}
            about |= {"source_px": [clip.camera.width, clip.camera.height]}
            write_report(provenance() | about | result, self.out)
        return 0

    def _starts(self) -> Iterable[dict[str, Any]]:
        with TemporaryDirectory() as cache:
            environ = os.environ | {"PYTHONPYCACHEPREFIX": cache, "PYTHONDONTWRITEBYTECODE": ""}
            for what, arguments in STARTS.items():
                took_s = []
                for _ in range(self.turns + 1):  # the first compiles
                    start_s = time.perf_counter()
                    subprocess.run([sys.executable, *arguments], env=environ, check=True, stdout=subprocess.DEVNULL)
                    took_s.append(time.perf_counter() - start_s)
                yield {"what": what, "median_s": float(np.median(took_s[1:])), "n": self.turns}

    def _discovery_ms(self, tracker: Tracker, clip: Clip) -> float:
        return float(played_ms(tracker.stream(clip.camera), clip, frames=1)[0])


def queries_on(clip: Clip, count: int) -> list[Query]:
    """So many points, the same at every call, on what is nearest in a clip's first frame."""
    depth_m = clip.frame(0).depth_m
    assert depth_m is not None
    known = depth_m > 0
    rows, columns = np.nonzero(known & (depth_m <= np.quantile(depth_m[known], NEAREST)))
    chosen = np.random.default_rng(0).choice(len(rows), size=count, replace=False)
    return [Query.point(0, float(columns[i]) + 0.5, float(rows[i]) + 0.5, name=f"point {i}") for i in chosen]


def played_ms(stream: Stream, clip: Clip, *, frames: int | None = None) -> Float[np.ndarray, " T"]:
    """Milliseconds of each frame of a clip, played as a stream."""
    took_ms = []
    for t in range(len(clip) if frames is None else frames):
        frame = clip.frame(t)
        start_s = time.perf_counter()
        stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)  # answers are on the CPU
        took_ms.append(1e3 * (time.perf_counter() - start_s))
    return np.array(took_ms)


def _summary(turns_ms: Float[np.ndarray, "R T"]) -> dict[str, Any]:
    """Median and 95 % quantile of a frame, and frames per second with a 95 % bootstrap interval over turns."""
    return {
        "turns": len(turns_ms),
        "frames": turns_ms.size,
        "median_ms": float(np.median(turns_ms)),
        "p95_ms": float(np.quantile(turns_ms, 0.95)),
        "frames_per_s": interval_over(turns_ms, lambda drawn: 1e3 / drawn.mean(axis=(-2, -1))),
    }


if __name__ == "__main__":
    raise SystemExit(tyro.cli(TrackingSpeed).run())
