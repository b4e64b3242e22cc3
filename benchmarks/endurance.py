"""Run one stream for a very long time: does its memory grow, does a frame take longer?

    OMP_NUM_THREADS=1 python benchmarks/endurance.py --frames 100000 --out benchmarks/results/endurance/endurance.json

The sample clip is played forth and back without end, with time stamps that go on; two handles that move are followed,
with alarms where the weights have a monitor. The encoder, which keeps nothing between frames, runs in the first 2,000
frames (a tenth of a shorter run); then its features are replayed by the picture's digest, which saves an hour. All else
runs in every frame. The times that are compared lie in the replayed part, if every picture has come up by then: a run
of less than 1,200 frames only shows that this works. Other jobs may run meanwhile: the processor's time counts, wall
time stands beside it. The result file is written anew at every reading.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

import quest
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.evaluation.endurance import (
    FeatureRing,
    Reading,
    forth_and_back,
    memory_growth,
    resident_bytes,
    time_change,
)
from quest.evaluation.report import provenance, write_report
from quest.types import Query

HANDLES = {"drawer below": (59.0, 155.5), "drawer above": (167.0, 42.5)}
"""Pixels of the two handles of the sample clip that move, in its first frame."""

FRAMES_PER_S = 30.0
MEMORY_PERCENT, TIME_PERCENT = 2.0, 5.0
"""Changes up to these are accepted."""


@dataclass(frozen=True)
class Endurance:
    """Memory and time per frame of one long stream."""

    frames: int = 100_000
    """How many; at least 100."""
    encoded: int = 2_000
    """Frames in which the encoder runs; at most a tenth of them."""
    settled: int = 10_000
    """Memory is compared with that after so many frames; at most a tenth of them."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
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
        ring = FeatureRing(tracker.network)
        queries = [Query.point(0, x, y, name=name) for name, (x, y) in HANDLES.items()]
        stream = tracker.stream(clip.camera, queries)
        every, encoded = self.frames // 100, min(self.encoded, self.frames // 10)
        about = provenance() | {
            "weights": self.weights,
            "weights_hash": tracker.weights_hash,
            "alpha": None if stream.budget is None else stream.budget.alpha,
            "frames": self.frames,
            "encoded": encoded,
        }
        alarms: list[str] = []
        stream.on_alarm(lambda alarm: alarms.append(f"frame {alarm.frame}: {alarm.name}, {alarm.reason}"[:200]))
        readings = [Reading(0, resident_bytes(), 0.0, 0.0)]
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        off_px: list[float] = []
        for t in range(every * 100):
            ring.replay = t >= encoded
            i = forth_and_back(t, len(clip))
            frame = clip.frame(i)
            state = stream.step(frame.rgb, frame.depth_m, t / FRAMES_PER_S, frame.cam_from_world)
            if i == 0:
                off_px = np.linalg.norm(state.uv_px - list(HANDLES.values()), axis=1).round(2).tolist()
            if (t + 1) % every:
                continue
            cpu_s, wall_s = time.process_time() - start_cpu_s, time.perf_counter() - start_s
            readings.append(Reading(t + 1, resident_bytes(), cpu_s, wall_s))
            seen = {
                "alarms": len(alarms),
                "first_alarms": alarms[:10],
                "off_px": dict(zip(HANDLES, off_px, strict=True)),
            }
            report = about | self._found(readings) | seen | {"encoder_runs": ring.computed, "pictures": len(ring)}
            console.print(_line(readings))
            if self.out is not None:
                write_report(report | {"readings": [asdict(r) for r in readings]}, self.out)
        found = self._found(readings)
        console.print(_table(found))
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


def _table(found: dict[str, Any]) -> Table:
    memory, cpu, wall = found["memory_growth_percent"], found["cpu_change"], found["wall_change"]
    table = Table(title=f"{found['frames_done']} frames", box=box.SIMPLE_HEAD)
    for heading in ("", "change %", "95 %", "accepted %"):
        table.add_column(heading, justify="right" if heading else "left")
    name = f"memory since frame {memory['since_frame']} (peak {memory['peak']:+.2f})"
    table.add_row(name, f"{memory['end']:+.2f}", "", f"{MEMORY_PERCENT:g}")
    for name, change, accepted in (("processor", cpu, f"{TIME_PERCENT:g}"), ("wall", wall, "")):
        name = f"{name} time per frame, {change['early_ms']:.2f} to {change['late_ms']:.2f} ms"
        table.add_row(name, f"{change['percent']:+.2f}", f"{change['low']:+.2f} to {change['high']:+.2f}", accepted)
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Endurance).run())
