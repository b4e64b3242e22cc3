"""Measure how fast takes are made, loading, rendering, annotating and writing included.

    python benchmarks/generation_speed.py --out benchmarks/results/speed/generation.json

The first take pays for the renderer's shaders and is left out. Let nothing else run meanwhile.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console

from quest.data.provenance import code_commit, machine, package_versions
from quest.data.store import TakeStore
from quest.sim.generate import TakeSettings, generate_take
from quest.sim.plan import ObjectShelf, plan_takes, procedural_objects
from quest.sim.renderer import Renderer


@dataclass(frozen=True)
class GenerationSpeed:
    """Frames per second of `quest generate` on procedural objects, three views of 224 x 224."""

    takes: int = 12
    """Takes that are timed."""
    level: int = 1
    """Joints that move one after the other."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Time the takes one by one and print the mean with a 95 % bootstrap interval over takes."""
        settings, renderer = TakeSettings(), Renderer()
        objects = procedural_objects(self.takes + 1, 0)
        seconds, frames = [], []
        with tempfile.TemporaryDirectory() as folder, ObjectShelf() as shelf:
            store = TakeStore(folder)
            for spec in plan_takes(objects, levels=(self.level,), takes_per_object=1):
                start = time.perf_counter()
                sim_object = shelf.load(spec.source, spec.object_id)
                take = generate_take(sim_object, spec.level, spec.seed, renderer=renderer, settings=settings)
                store.write(take)
                seconds.append(time.perf_counter() - start)
                frames.append(len(take) * len(take.views))
        result = {"frames_per_s": _rate(np.array(frames[1:]), np.array(seconds[1:])), "first_take_s": seconds[0]}
        result |= {"n_takes": self.takes, "n_frames": sum(frames[1:]), "level": self.level, "machine": machine()}
        result |= {"load": os.getloadavg()[0], "renderer": str(renderer.device), "commit": code_commit()}
        result |= {"versions": package_versions(), "command": "python benchmarks/generation_speed.py"}
        Console().print_json(data=result)
        if self.out is not None:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            self.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        return 0


def _rate(frames: np.ndarray, seconds: np.ndarray) -> dict[str, float]:
    draws = np.random.default_rng(0).integers(len(frames), size=(1000, len(frames)))
    rates = frames[draws].sum(axis=1) / seconds[draws].sum(axis=1)
    low, high = np.quantile(rates, (0.025, 0.975))
    return {"mean": float(frames.sum() / seconds.sum()), "low": float(low), "high": float(high)}


if __name__ == "__main__":
    raise SystemExit(tyro.cli(GenerationSpeed).run())
