"""Measure where a frame's time goes, and how far the networks are from what the processor can do.

    python -m benchmarks.roofline --out benchmarks/results/speed/roofline.json

*Networks*: the floor of a network is its multiplications and additions over the rate of one large product of matrices,
measured here, in the same precision and with as many threads. *Parts*: the packaged clip is played as a stream with
eight queries on one thread; the time of each part is divided into what its calls into OpenCV, SciPy's trees and PyTorch
take, and the rest, which is Python and NumPy. Let nothing else run meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch
import tyro
from rich.console import Console
from torch.utils.flop_counter import FlopCounterMode

import quest
from benchmarks.tracking_speed import queries_on
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.evaluation.report import device_name, provenance, write_report
from quest.filter import landmarks
from quest.filter import step as filtering
from quest.model.found import find
from quest.model.xfeat import XFeat
from quest.monitor import Monitor
from quest.track import Tracker
from quest.track import describing as making
from quest.track.preprocess import Preprocessor, grey_of
from quest.types import Clip

QUERIES = 8
PARTS: tuple[tuple[Any, str, str], ...] = (
    (Preprocessor, "accept", "checks of the frame"),
    (Preprocessor, "picture", "checks of the frame"),
    (Preprocessor, "prepare", "checks of the frame"),
    (making, "_describe", "dense descriptors"),
    (filtering, "observe", "landmarks, camera, bodies"),
    (filtering, "follow_patches", "patches of the queries"),
    (filtering, "weigh", "hypotheses of the queries"),
    (filtering, "sow", "new landmarks"),
    (filtering, "read_off", "answers"),
    (Monitor, "step", "monitor"),
)
"""Where a part is called from, by which name, and what it is called in the table."""
KERNELS: tuple[tuple[Any, str], ...] = (
    *((cv2, name) for name in (
        "calcOpticalFlowPyrLK", "goodFeaturesToTrack", "boxFilter", "sqrBoxFilter", "Scharr", "matchTemplate", "remap",
        "getRectSubPix", "minMaxLoc", "dilate", "circle", "resize", "cvtColor", "Laplacian", "findHomography",
        "solvePnPRansac", "solvePnPRefineLM",
    )),
    (landmarks, "KDTree"),
    (landmarks.KDTree, "query"),
    (torch, "einsum"),
    (XFeat, "features"),
)  # fmt: skip
"""What is compiled and does its own work."""


@dataclass(frozen=True)
class Roofline:
    """Floor and measured time of the networks, and the parts of a frame."""

    weights: str = "quest-s16"
    """Name or file of the weights."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of threads of the networks."""
    times: int = 9
    """How often each network runs; medians are told."""
    settled: int = 8
    """Frames of the stream that are not timed."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Measure, print and write."""
        clip = read_recording(sample_folder())
        if min(self.threads, default=0) < 1 or self.times < 1 or not 0 < self.settled < len(clip):
            raise SystemExit(f"roofline: expected threads, times and 1 to {len(clip) - 1} settled, got {self}")
        before = torch.get_num_threads()
        networks = [row for count in self.threads for row in self._networks(clip, count)]
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        parts = list(self._parts(quest.load(self.weights, device="cpu"), clip))
        torch.set_num_threads(before)
        result = {"networks": networks, "parts": parts}
        Console(highlight=False).print_json(data=result)
        if self.out is not None:
            about = {"weights": self.weights, "device": device_name(torch.device("cpu")), "queries": QUERIES}
            write_report(provenance() | about | result, self.out)
        return 0

    def _networks(self, clip: Clip, threads: int) -> Iterable[dict[str, Any]]:
        torch.set_num_threads(threads)
        for precision, engine in (("float32", "torch"), ("bfloat16", "bfloat16")):
            square = torch.ones(1024, 1024, dtype=getattr(torch, precision))
            rate = 2 * 1024**3 / self._median_s(partial(torch.mm, square, square))
            tracker = quest.load(self.weights, device="cpu", engine=engine)
            look = partial(find, tracker.network, clip.rgb[0], size_px=tracker.config.size_px, odds=tracker.config)
            describe = partial(making.described, tracker.features, grey_of(clip.rgb[0]))
            for network, once in (("finder", look), ("dense descriptors", describe)):
                flops, took_s = _flops(once), self._median_s(once)
                row = {"network": network, "precision": precision, "threads": threads, "gflop": flops / 1e9}
                yield row | {"floor_ms": 1e3 * flops / rate, "ms": 1e3 * took_s, "times": took_s * rate / flops}

    def _median_s(self, call: Callable[[], Any]) -> float:
        took_s = []
        with torch.inference_mode():
            for _ in range(self.times + 2):
                start_s = time.perf_counter()
                call()
                took_s.append(time.perf_counter() - start_s)
        return float(np.median(took_s[2:]))

    def _parts(self, tracker: Tracker, clip: Clip) -> Iterable[dict[str, Any]]:
        stream, clock = tracker.stream(clip.camera, queries_on(clip, QUERIES)), Clock()
        for t in range(len(clip)):
            if t == self.settled:
                clock.spent_s.clear()
            frame = clip.frame(t)
            with clock.running():
                stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        names = list(dict.fromkeys(name for *_, name in PARTS))
        frames = len(clip) - self.settled
        for name in names:
            all_ms, compiled_ms = (1e3 * clock.spent_s[name, what] / frames for what in ("all", "compiled"))
            yield {"part": name, "ms": all_ms, "compiled_ms": compiled_ms, "rest_ms": all_ms - compiled_ms}


class Clock:
    """Processor time of parts, and of the kernels within them."""

    def __init__(self) -> None:
        self.spent_s: defaultdict[tuple[str, str], float] = defaultdict(float)
        self._here = threading.local()  # descriptors have a thread of their own

    @contextmanager
    def running(self) -> Iterator[None]:
        """Time what is called meanwhile."""
        with ExitStack() as stack:
            for owner, name, part in PARTS:
                stack.enter_context(mock.patch.object(owner, name, self._timed(getattr(owner, name), part)))
            for owner, name in KERNELS:
                stack.enter_context(mock.patch.object(owner, name, self._timed(getattr(owner, name), None)))
            yield

    def _timed(self, call: Callable[..., Any], part: str | None) -> Callable[..., Any]:
        def timed(*args: Any, **settings: Any) -> Any:
            outer = getattr(self._here, "part", "")
            self._here.part = part or outer
            start_s = time.thread_time()
            result = call(*args, **settings)
            self.spent_s[self._here.part, "all" if part else "compiled"] += time.thread_time() - start_s
            self._here.part = outer
            return result

        return timed


def _flops(call: Callable[[], Any]) -> float:
    """Multiplications and additions of a network; one of each counts two."""
    with torch.inference_mode(), FlopCounterMode(display=False) as counter:
        call()
    return float(counter.get_total_flops())


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Roofline).run())
