"""The one training loop."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from quest.errors import ConfigError
from quest.extras import require
from quest.model.network import QuestNetwork
from quest.train.checkpoint import Progress, check_same_network, load_checkpoint, save_checkpoint
from quest.train.objective import LossTerms, stage_one
from quest.train.settings import LossWeights, TrainingConfig
from quest.train.validation import WindowScores, validate
from quest.train.windows import WindowSampler


@dataclass(frozen=True)
class StepReport:
    """What a caller is told after every step.

    Attributes:
        step: steps done.
        loss: weighted sum of the losses.
        scores: validation scores, at the steps where there are any.
        best: best validation score so far.
    """

    step: int
    loss: float
    scores: WindowScores | None
    best: float


def fit(
    network: QuestNetwork,
    training: WindowSampler,
    validation: WindowSampler,
    config: TrainingConfig,
    weights: LossWeights,
    *,
    out: Path,
    report: Callable[[StepReport], None],
) -> Path:
    """Train everything but the encoder; goes on from ``out/last`` where there is one.

    Args:
        network: the network; its encoder stays as it is.
        training: windows to learn from.
        validation: windows of other objects; the same ones are drawn at every validation.
        config: how to train.
        weights: weight of every loss.
        out: folder for the checkpoints ``last`` and ``best`` and the curves.
        report: called after every step.

    Returns:
        Folder of the best checkpoint.

    Raises:
        WeightsError: ``out`` holds a run of another network.
        MissingExtraError: Lightning Fabric or TensorBoard is not installed.
    """
    fabric = require("lightning_fabric").Fabric(accelerator="auto", devices=1, precision=config.precision)
    require("tensorboard")
    from torch.utils.tensorboard import SummaryWriter

    network.encoder.requires_grad_(False)
    optimizer = torch.optim.AdamW(network.trainable(), lr=config.learning_rate, weight_decay=config.weight_decay)
    rng = np.random.default_rng(config.seed)
    progress = _resume(network, optimizer, rng, config, out)
    _, optimizer = fabric.setup(network, optimizer)
    writer = SummaryWriter(str(out / "curves"), purge_step=progress.step)
    while progress.step < config.steps and progress.stale < config.patience:
        step = progress.step + 1
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * _schedule(step, config)
        frames, truth = training.draw(rng)
        frames, truth = frames.to(fabric.device), truth.to(fabric.device)
        with fabric.autocast():
            terms, _ = stage_one(network, frames, truth)
        loss = terms.total(weights)
        if not torch.isfinite(loss):
            raise ConfigError(f"training: the loss became {loss.item()} at step {step}; lower the learning rate")
        optimizer.zero_grad(set_to_none=True)
        fabric.backward(loss)
        torch.nn.utils.clip_grad_norm_(network.trainable(), config.clip_norm)
        optimizer.step()
        _log(writer, terms, loss, step)
        scores = None
        progress = _advance(progress, step=step, rng=rng)
        if step % config.validate_every == 0 or step == config.steps:
            with fabric.autocast():
                scores = validate(network, validation, batches=config.validation_batches, device=fabric.device)
            for f in fields(scores):
                writer.add_scalar(f"validation/{f.name}", getattr(scores, f.name), step)
            progress = _judge(progress, scores)
            save_checkpoint(out / "last", network, optimizer, progress)
            if progress.best_step == step:
                save_checkpoint(out / "best", network, optimizer, progress)
        report(StepReport(step, float(loss.detach()), scores, progress.best))
    writer.close()
    return out / "best"


def _schedule(step: int, config: TrainingConfig) -> float:
    if step <= config.warmup_steps:
        return step / config.warmup_steps
    done = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * done))


def _resume(
    network: QuestNetwork,
    optimizer: torch.optim.Optimizer,
    rng: np.random.Generator,
    config: TrainingConfig,
    out: Path,
) -> Progress:
    if not (out / "last").exists() and not (out / ".old-last").exists():
        return Progress(0, math.inf, 0, 0, _rng_state(rng), network.config.to_json())
    progress = load_checkpoint(out / "last", network, optimizer)
    check_same_network(progress, network.config, out)
    rng.bit_generator.state = json.loads(progress.rng)
    return progress


def _advance(progress: Progress, *, step: int, rng: np.random.Generator) -> Progress:
    return Progress(step, progress.best, progress.best_step, progress.stale, _rng_state(rng), progress.network)


def _judge(progress: Progress, scores: WindowScores) -> Progress:
    # The first score is the best so far whatever it is, so that there always is a best checkpoint.
    better = scores.mean_distance < progress.best or progress.best_step == 0
    return Progress(
        progress.step,
        scores.mean_distance if better else progress.best,
        progress.step if better else progress.best_step,
        0 if better else progress.stale + 1,
        progress.rng,
        progress.network,
    )


def _rng_state(rng: np.random.Generator) -> str:
    return json.dumps(rng.bit_generator.state)


def _log(writer, terms: LossTerms, loss: Tensor, step: int) -> None:
    if step % 10 == 0 or step == 1:
        writer.add_scalar("loss/total", float(loss.detach()), step)
        for f in fields(terms):
            writer.add_scalar(f"loss/{f.name}", float(getattr(terms, f.name).detach()), step)
