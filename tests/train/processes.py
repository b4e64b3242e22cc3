"""A program that trains a tiny network on prepared views: the tests of many processes run it as it is or by torchrun.

python tests/train/processes.py CACHE OUT DEVICES ACCUMULATE...

One run for every ACCUMULATE, in ``OUT/ACCUMULATE``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from quest.paper.objective import PaperStageOne
from quest.train.devices import launch
from quest.train.feature_cache import FeatureCache
from quest.train.loop import StepReport, fit
from quest.train.settings import TrainingConfig, WindowConfig
from quest.train.windows import WindowSampler
from tests.paper.tiny import make_paper


def train(cache: Path, out: Path, *, devices: int, accumulate: int) -> list[float]:
    """Losses of a short run, which the first process also writes to ``out/losses.json``."""
    config = TrainingConfig(
        steps=4,
        warmup_steps=2,
        learning_rate=1e-3,
        validate_every=2,
        validation_batches=1,
        precision="32-true",
        accelerator="cpu",
        devices=devices,
        accumulate=accumulate,
    )
    fabric = launch(config)
    network = make_paper()
    names = sorted({path.name.rsplit("-v", 1)[0] for path in cache.glob("*/*-v*")})
    views = FeatureCache(cache, network.encoder).views(names)
    sampler = WindowSampler(views, network.config, WindowConfig(batch=8))
    reports: list[StepReport] = []
    objective = PaperStageOne(network)
    fit(objective, sampler, sampler, config, out=out, report=reports.append, fabric=fabric)
    losses = [report.loss for report in reports]
    if fabric.is_global_zero:
        (out / "losses.json").write_text(json.dumps({"losses": losses, "processes": fabric.world_size}))
    else:
        assert not losses, "only the first process reports"
    return losses


if __name__ == "__main__":
    for accumulate in sys.argv[4:]:
        train(Path(sys.argv[1]), Path(sys.argv[2]) / accumulate, devices=int(sys.argv[3]), accumulate=int(accumulate))
