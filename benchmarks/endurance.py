"""Run one stream for a very long time: does its memory grow, does a frame take longer?

    OMP_NUM_THREADS=1 python -m benchmarks.endurance --frames 100000 --out benchmarks/results/endurance/endurance.json

The sample clip is played forth and back without end, with time stamps that go on; two handles that move are followed,
with alarms where the monitor is calibrated. With ``--disturbed`` (``make soak``) the camera fails every ten seconds,
each time in another way, queries come and go, and the stream is saved and restored. Other jobs may run meanwhile: the
processor's time counts, wall time stands beside it. The result file is written anew at every reading.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console

import quest
from benchmarks.sensor_faults import BLIND, DEGRADED, DEPTH
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.errors import ConfigError, InputError
from quest.evaluation.bootstrap import LEVEL
from quest.evaluation.report import provenance, write_report
from quest.monitor import Alarm
from quest.track.stream import Stream
from quest.track.tracker import Tracker
from quest.types import Frame, Query

RESAMPLES = 1000


@dataclass(frozen=True)
class Reading:
    """What was measured after some frames."""

    frames: int
    """Frames done."""
    resident_bytes: int
    """Memory of the process that is in use."""
    cpu_s: float
    """Time of the processor so far, all threads."""
    wall_s: float
    """Time so far."""


@dataclass(frozen=True)
class Change:
    """How the time per frame changed from the second tenth of a run to the last."""

    early_ms: float
    """Median time per frame over the readings of the second tenth."""
    late_ms: float
    """Over those of the last."""
    percent: float
    """Change of the medians, percent of the early one."""
    low: float
    """Lower end of the 95 % interval, bootstrap over readings."""
    high: float
    readings: int
    """In each tenth."""


def forth_and_back(t: int, frames: int) -> int:
    """Frame of a clip at step ``t``, from 0, when it is played to its end, back to its start, and so on."""
    if frames < 2:
        raise InputError(f"clip: expected at least 2 frames to play forth and back, got {frames}")
    period = 2 * (frames - 1)
    place = t % period
    return min(place, period - place)


def resident_bytes() -> int:
    """Memory of this process that is in use.

    Raises:
        ConfigError: the system has no ``/proc``.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError as error:
        raise ConfigError(f"resident memory: expected /proc/self/statm, got {error}; use Linux") from error
    return pages * os.sysconf("SC_PAGE_SIZE")


def memory_growth(readings: Sequence[Reading], *, since: int) -> tuple[float, float]:
    """Growth of the resident memory in percent since a frame: at the end, and at its highest."""
    late = [r.resident_bytes for r in readings if r.frames >= since]
    if not late:
        raise InputError(f"readings: expected one after {since} frames, got none; run for longer")
    return 100.0 * (late[-1] / late[0] - 1.0), 100.0 * (max(late) / late[0] - 1.0)


def time_change(readings: Sequence[Reading], *, clock: str, seed: int = 0) -> Change:
    """Time per frame, by ``cpu_s`` or ``wall_s``, in the last tenth of evenly spaced readings against the second."""
    frames = np.array([r.frames for r in readings])
    per_frame_ms = 1e3 * np.diff([getattr(r, clock) for r in readings]) / np.diff(frames)
    tenth = -(-10 * frames[1:] // frames[-1])  # 1 to 10; a reading belongs to the frames before it
    early, late = per_frame_ms[tenth == 2], per_frame_ms[tenth == 10]
    if not len(early) or not len(late):
        raise InputError(f"readings: expected at least 10 after the first, got {len(per_frame_ms)}; run for longer")
    rng = np.random.default_rng(seed)
    drawn = [np.median(v[rng.integers(len(v), size=(RESAMPLES, len(v)))], axis=1) for v in (early, late)]
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(100.0 * (drawn[1] / drawn[0] - 1.0), (tail, 1.0 - tail))
    before, after = float(np.median(early)), float(np.median(late))
    return Change(before, after, 100.0 * (after / before - 1.0), float(low), float(high), len(late))


PERIOD, LASTS = 300, 30
"""Frames from one fault to the next, and how long it lasts."""


def faulty(frame: Frame, last: Frame, t: int) -> Frame:
    """A frame with the fault that step ``t`` has, if any."""
    if t % PERIOD < PERIOD - LASTS:
        return frame
    rng = np.random.default_rng(t)
    kinds = list((BLIND | DEGRADED | DEPTH).values())
    rgb, depth_m = kinds[t // PERIOD % len(kinds)](frame.rgb, frame.depth_m, last, rng)
    return replace(frame, rgb=rgb, depth_m=depth_m)


def disturbed(tracker: Tracker, stream: Stream, t: int, queries: Sequence[Query]) -> Stream:
    """The stream as it goes on at step ``t``: with a query more or less, or restored from what was saved."""
    if t % PERIOD == PERIOD // 4:
        stream.add(replace(queries[t // PERIOD % len(queries)], frame=t, name=f"again {t}"))
    if t % PERIOD == PERIOD // 2:
        stream.retire(f"again {t - PERIOD // 4}")
    return tracker.restore(tracker.save(stream)) if t % (3 * PERIOD) == 1 else stream


FRAMES_PER_S = 30.0
MEMORY_PERCENT, TIME_PERCENT = 2.0, 5.0
"""Changes up to these are accepted."""


@dataclass(frozen=True)
class Endurance:
    """Memory and time per frame of one long stream."""

    frames: int = 100_000
    """How many; at least 100."""
    settled: int = 10_000
    """Memory is compared with that after so many frames; at most a tenth of them."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    disturbed: bool = False
    """Whether the camera fails now and then, queries come and go, and the stream is saved and restored."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Run the stream; 1 if memory or time changed by more than is accepted."""
        if self.frames < 100:
            raise SystemExit(f"endurance: expected at least 100 frames, got {self.frames}")
        console = Console(highlight=False)
        torch.set_num_threads(1)
        clip = read_recording(sample_folder())
        tracker = quest.load(self.weights, device="cpu")
        truth = json.loads((sample_folder() / "truth.json").read_text())
        handles = {entity["name"]: entity["uv_px"][0] for entity in truth["entities"] if entity["moves"]}
        queries = [Query.point(0, x, y, name=name) for name, (x, y) in handles.items()]
        stream = tracker.stream(clip.camera, queries)
        every = self.frames // 100
        about = provenance() | {
            "weights": self.weights,
            "weights_hash": tracker.weights_hash,
            "alpha": None if stream.budget is None else stream.budget.alpha,
            "frames": self.frames,
            "disturbed": self.disturbed,
        }
        alarms: list[str] = []

        def heard(alarm: Alarm) -> None:
            alarms.append(f"frame {alarm.frame}: {alarm.name}, {alarm.reason}"[:200])

        stream.on_alarm(heard)
        readings = [Reading(0, resident_bytes(), 0.0, 0.0)]
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        off_px: list[float] = []
        for t in range(every * 100):
            i = forth_and_back(t, len(clip))
            frame = clip.frame(i)
            if self.disturbed:
                before, stream = stream, disturbed(tracker, stream, t, queries)
                if stream is not before:  # callbacks are not saved
                    stream.on_alarm(heard)
                frame = faulty(frame, clip.frame(forth_and_back(max(t - 1, 0), len(clip))), t)
            state = stream.step(frame.rgb, frame.depth_m, t / FRAMES_PER_S, frame.cam_from_world)
            if i == 0 and not self.disturbed:
                off_px = np.linalg.norm(state.uv_px - list(handles.values()), axis=1).round(2).tolist()
            if (t + 1) % every:
                continue
            cpu_s, wall_s = time.process_time() - start_cpu_s, time.perf_counter() - start_s
            readings.append(Reading(t + 1, resident_bytes(), cpu_s, wall_s))
            seen = {
                "alarms": len(alarms),
                "first_alarms": alarms[:10],
                "off_px": dict(zip(handles, off_px, strict=False)),
            }
            report = about | self._found(readings) | seen
            console.print(_line(readings))
            if self.out is not None:
                write_report(report | {"readings": readings}, self.out)
        found = self._found(readings)
        console.print_json(data=found)
        return 0 if found["passed"] else 1

    def _found(self, readings: list[Reading]) -> dict[str, Any]:
        """What the readings say so far; comparisons only when all frames are done."""
        since = min(self.settled, self.frames // 10)
        done = {"frames_done": readings[-1].frames, "complete": len(readings) == 101}
        if not done["complete"]:
            return done
        end, peak = memory_growth(readings, since=since)
        cpu, wall = (time_change(readings, clock=clock) for clock in ("cpu_s", "wall_s"))
        return done | {
            "memory_growth_percent": {"since_frame": since, "end": end, "peak": peak, "accepted": MEMORY_PERCENT},
            "cpu_change": asdict(cpu) | {"accepted_percent": TIME_PERCENT},
            "wall_change": asdict(wall),
            "passed": end <= MEMORY_PERCENT and cpu.percent <= TIME_PERCENT,
        }


def _line(readings: list[Reading]) -> str:
    before, now = readings[-2:]
    cpu_ms = 1e3 * (now.cpu_s - before.cpu_s) / (now.frames - before.frames)
    return f"{now.frames:>7} frames  {now.resident_bytes / 2**20:7.1f} MiB  {cpu_ms:6.2f} ms/frame  {now.wall_s:7.0f} s"


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Endurance).run())
