"""Measure how fast the loop trains the published network, beside bare forward, backward and step of the same.

    python benchmarks/training_speed.py --data takes/train --out benchmarks/results/speed/training.json

In turn, some steps of each: `loop` is what `quest train --stage 1` runs (drawing, reading and moving batches, losses,
schedule, clipping, optimiser, curves, report), timed from report to report; `bare` is losses, backward and optimiser on
batches that are on the device already, of a copy of the network in the same precision. Checkpoints and validations are
neither. The first step of every block is left out: the batch that it takes was read while the other had its turn. The
network is a new one, its features are of an encoder that was never trained: neither matters for speed. Let nothing else
run meanwhile.
"""

from __future__ import annotations

import copy
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from lightning_fabric import Fabric
from rich.console import Console

from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.evaluation.bootstrap import interval_over
from quest.evaluation.report import device_name, provenance, write_report
from quest.paper.network import PaperConfig, PaperNetwork
from quest.paper.objective import PaperStageOne
from quest.train.devices import launch
from quest.train.feature_cache import FeatureCache
from quest.train.loop import StepReport, fit
from quest.train.losses import weighted_sum
from quest.train.optimizer import make_optimizer
from quest.train.settings import TrainingConfig, WindowConfig
from quest.train.windows import WindowSampler


@dataclass(frozen=True)
class TrainingSpeed:
    """Frames per second of training steps, of the loop and bare."""

    data: tuple[str, ...]
    """Folders of take stores."""
    takes: int = 24
    """Takes to draw windows from, at most."""
    blocks: int = 12
    """Turns of each."""
    steps: int = 8
    """Steps of a turn that are timed."""
    cache: Path | None = None
    """Folder of the feature cache; a temporary one by default."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """Precision, accelerator, accumulation, compilation; the number of steps is not read."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """Batch."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Time both in turn and print means with 95 % bootstrap intervals over turns."""
        torch.manual_seed(self.training.seed)
        network = PaperNetwork(PaperConfig())
        fabric = launch(replace(self.training, devices=1))
        with tempfile.TemporaryDirectory() as scratch:
            sampler, data_hash = self._sampler(network, self.cache or Path(scratch) / "cache", fabric.device)
            turns = self._turns(network, sampler, Path(scratch), fabric)
        frames = self.steps * self.windows.batch * (network.config.window + 1)
        result = _summary(np.array(turns), frames)
        Console(highlight=False).print_json(data=result, default=asdict)
        if self.out is not None:
            about = {"network": "paper", "batch": self.windows.batch}
            about |= {
                name: getattr(self.training, name) for name in ("precision", "optimizer", "accumulate", "compile")
            }
            about |= {"device": device_name(fabric.device), "load": os.getloadavg()[0], "data_hash": data_hash}
            write_report(provenance() | about | result, self.out)
        return 0

    def _sampler(self, network: PaperNetwork, cache: Path, device: torch.device) -> tuple[WindowSampler, str]:
        stores = [TakeStore(folder) for folder in self.data]
        chosen = [(store, name) for store in stores for name in store.names()][: self.takes]
        features = FeatureCache(cache, network.encoder)
        for store, name in chosen:
            list(features.build(store, [name], device=device))
        views = features.views([name for _, name in chosen])
        data_hash = combined_hash((name, store.data_hash(name)) for store, name in chosen)
        return WindowSampler(views, network.config, self.windows), data_hash

    def _turns(
        self, network: PaperNetwork, sampler: WindowSampler, scratch: Path, fabric: Fabric
    ) -> list[tuple[float, float]]:
        """Seconds of the timed steps of each turn, of the loop and bare."""
        block = self.steps + 1
        never = block * (self.blocks + 1) + 1
        config = replace(
            self.training, steps=never, warmup_steps=1, validate_every=never, checkpoint_every=never, devices=1
        )
        bare = _Bare(copy.deepcopy(network).to(fabric.device), sampler, config, fabric.autocast)
        turns, began = [], 0.0

        def stepped(report: StepReport) -> None:
            nonlocal began
            _finish(fabric.device)
            if report.step % block == 1:
                began = time.perf_counter()
            elif report.step % block == 0:
                loop_s = time.perf_counter() - began
                turns.append((loop_s, bare.timed(self.steps)))
                if len(turns) > self.blocks:
                    raise _EnoughError

        objective = PaperStageOne(network)
        with suppress(_EnoughError):
            fit(objective, sampler, sampler, config, out=scratch / "run", report=stepped, fabric=fabric)
        return turns[1:]  # the first turn warms up


class _EnoughError(Exception):
    """All turns are over."""


class _Bare:
    """Losses, backward and optimiser of a network on batches that are there already."""

    def __init__(
        self, network: PaperNetwork, sampler: WindowSampler, config: TrainingConfig, autocast: Callable[[], Any]
    ) -> None:
        network.encoder.requires_grad_(False)
        self.objective = PaperStageOne(network.train())
        self.optimizer = make_optimizer(network, network.trainable(), replace(config, learning_rate=1e-5))
        self.autocast = autocast
        self.device = next(network.parameters()).device
        rng = np.random.default_rng(1)
        drawn = [sampler.draw(rng) for _ in range(4)]
        self.batches = [(frames.to(self.device), truth.to(self.device)) for frames, truth in drawn]

    def timed(self, steps: int) -> float:
        """Seconds of some steps, after one that is not timed."""
        self._step(0)
        _finish(self.device)
        start = time.perf_counter()
        for i in range(steps):
            self._step(i)
        _finish(self.device)
        return time.perf_counter() - start

    def _step(self, i: int) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        with self.autocast():
            loss = weighted_sum(self.objective.losses(*self.batches[i % len(self.batches)]), self.objective.weights)
        loss.backward()
        self.optimizer.step()


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _summary(turns: np.ndarray, frames: int) -> dict[str, Any]:
    size = frames * len(turns)
    return {
        "frames_per_s": interval_over(turns, lambda t: size / t[..., 0].sum(-1)),
        "bare_frames_per_s": interval_over(turns, lambda t: size / t[..., 1].sum(-1)),
        "share_of_bare": interval_over(turns, lambda t: t[..., 1].sum(-1) / t[..., 0].sum(-1)),
        "turns": [{"loop_s": round(loop, 4), "bare_s": round(bare, 4)} for loop, bare in turns.tolist()],
        "n_turns": len(turns),
        "n_frames": size,
    }


if __name__ == "__main__":
    raise SystemExit(tyro.cli(TrainingSpeed).run())
