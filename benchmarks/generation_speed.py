"""Measure how fast takes are made, beside a loop that does nothing but render the same scenes.

    python benchmarks/generation_speed.py --out benchmarks/results/speed/generation.json

Per take, in turn: `generate` is what `quest generate` does (load or make the object, choose joints and cameras, render,
annotate, and compress and write the take in the background while the next one is made); `bare` poses the same objects
in the same dressed scene before the same cameras, renders, and fetches colours, positions and labels, only for the
moments that `generate` draws as well. Scenes are set up within `generate` and not within `bare`. The first take pays
for the renderer's shaders and is left out. Let nothing else run meanwhile.
"""

from __future__ import annotations

import cProfile
import os
import pstats
import tempfile
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console

from quest.data.store import TakeStore
from quest.evaluation.bootstrap import interval_over
from quest.evaluation.report import provenance, write_report
from quest.sim.plan import plan_takes, procedural_objects
from quest.sim.production import Studio, write_once
from quest.sim.renderer import Renderer, Stage
from quest.types import Take


@dataclass(frozen=True)
class GenerationSpeed:
    """Frames per second of `quest generate` on procedural objects, three views of 224 x 224, and of a bare loop."""

    takes: int = 12
    """Takes that are timed."""
    level: int = 1
    """Joints that move one after the other."""
    profile: bool = False
    """Also print where `generate` spends its time; this slows it down."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Time both take by take and print means with 95 % bootstrap intervals over takes."""
        studio = Studio()
        specs = plan_takes(procedural_objects(self.takes + 1, 0), levels=(self.level,), takes_per_object=1)
        timed: list[tuple[float, ...]] = []
        profiler = cProfile.Profile() if self.profile else None
        with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(1) as writer:
            store, writing = TakeStore(folder), _done()
            studio.open(specs)
            for spec in specs:
                if profiler and timed:
                    profiler.enable()
                start = _now()
                take, _ = studio.make(spec)
                writing.result()
                generate_s = _now() - start
                if profiler:
                    profiler.disable()
                assert Renderer.latest is not None
                bare_s = _bare_loop(Renderer.latest, take)
                # It is written while the next one is made, and by then the bare loop is over.
                writing = writer.submit(write_once, store, take)
                timed.append((len(take) * len(take.views), *generate_s, *bare_s))
            start = _now()
            writing.result()
            last, rest = timed[-1], _now() - start
            timed[-1] = (last[0], last[1] + rest[0], last[2] + rest[1], *last[3:])
        result = _summary(np.array(timed[1:])) | {"first_take_s": timed[0][1], "level": self.level}
        result |= provenance() | {"load": os.getloadavg()[0], "renderer": studio.describe()["renderer"]}
        Console().print_json(data=result, default=asdict)
        if profiler:
            pstats.Stats(profiler).sort_stats("tottime").print_stats(25)
        if self.out is not None:
            write_report(result, self.out)
        return 0


def _now() -> np.ndarray:
    """Seconds on the wall and of processor time of all threads."""
    return np.array([time.perf_counter(), time.process_time()])


def _bare_loop(stage: Stage, take: Take) -> np.ndarray:
    """Seconds and processor seconds that rendering and fetching alone take."""
    scene, cameras = stage.scene, stage.cameras
    start = _now()
    last: Any = None
    for pose in take.link_pose:
        if last is not None and np.array_equal(pose, last):
            continue
        stage.pose(pose)
        scene.update_render()
        for camera in cameras:
            camera.take_picture()
        for camera in cameras:
            for name in ("Color", "Position", "Segmentation"):
                camera.get_picture(name)
        last = pose
    return _now() - start


def _summary(timed: np.ndarray) -> dict[str, Any]:
    frames = timed[:, 0]
    return {
        "frames_per_s": interval_over(timed, lambda t: t[..., 0].sum(-1) / t[..., 1].sum(-1)),
        "bare_frames_per_s": interval_over(timed, lambda t: t[..., 0].sum(-1) / t[..., 3].sum(-1)),
        "share_of_bare": interval_over(timed, lambda t: t[..., 3].sum(-1) / t[..., 1].sum(-1)),
        "share_of_bare_processor_time": interval_over(timed, lambda t: t[..., 4].sum(-1) / t[..., 2].sum(-1)),
        "per_take": [
            {"frames": int(n), "generate_s": g, "generate_cpu_s": gc, "bare_s": b, "bare_cpu_s": bc}
            for n, g, gc, b, bc in zip(frames, *np.round(timed.T[1:], 3).tolist(), strict=True)
        ],
        "n_takes": len(timed),
        "n_frames": int(frames.sum()),
    }


def _done() -> Future[None]:
    future: Future[None] = Future()
    future.set_result(None)
    return future


if __name__ == "__main__":
    raise SystemExit(tyro.cli(GenerationSpeed).run())
