"""Time and memory of trackers: each follows the same points of the same clip in a process of its own."""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from quest.bench.settings import Making
from quest.bench.workbench import Asked, build
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.evaluation.bootstrap import interval_over
from quest.types import Query

QUERIES, TURNS = 8, 3


def speed_rows(making: Making, asked: Sequence[Asked]) -> list[dict[str, Any]]:
    """A row per tracker: milliseconds a frame over turns, and the most memory that its process had."""
    fresh, rows = multiprocessing.get_context("spawn"), []
    for each in asked:
        with fresh.Pool(1) as pool:
            times_s, frames, memory_mib = pool.apply(_timed, (making, each))
        ms = interval_over(1000 * times_s / frames, lambda turns: turns.mean(axis=-1))
        about = {"line": each.label, "queries": QUERIES, "frames": frames, "turns": TURNS, "ms": ms}
        rows.append(about | {"frames_per_s": 1000 / ms.mean, "memory_mib": memory_mib})
    return rows


def _timed(making: Making, asked: Asked) -> tuple[np.ndarray, int, float | None]:
    """Seconds of each turn, frames of the clip, and the peak of this process's memory, MiB."""
    torch.set_num_threads(1)
    clip = read_recording(sample_folder())
    rng = np.random.default_rng(0)
    size = np.array([clip.camera.width, clip.camera.height])
    points = (0.2 + 0.6 * rng.random((QUERIES, 2))) * size
    queries = [Query.point(0, float(x), float(y)) for x, y in points]
    tracker, times_s = build(making, asked, making.seeds[0], cached=False), []
    for _ in range(TURNS):
        start_s = time.perf_counter()
        tracker.track(clip, queries)
        times_s.append(time.perf_counter() - start_s)
    return np.array(times_s), len(clip), _peak_mib()


def _peak_mib() -> float | None:
    """The most memory that this process had; None where the system does not tell."""
    status = Path("/proc/self/status")
    if status.is_file():  # the reading below begins with that of the process that started this one
        lines = (line.split() for line in status.read_text().splitlines())
        return next((int(words[1]) / 2**10 for words in lines if words[0] == "VmHWM:"), None)
    if sys.platform == "win32":
        return None
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # bytes on macOS
