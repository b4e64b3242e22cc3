"""The one training loop, for every stage, on one device or many."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.errors import ConfigError
from quest.extras import require
from quest.model.weights import weights_digest
from quest.train.batches import Batch, MicroBatch, Sampler, stream_batches
from quest.train.checkpoint import Progress, check_same_run, load_checkpoint, load_generators, save_checkpoint
from quest.train.devices import (
    deterministic_algorithms,
    divide,
    generator_states,
    launch,
    part_ways,
    restore_generators,
)
from quest.train.losses import weighted_sum
from quest.train.optimizer import SHARE, RunningMean, make_optimizer
from quest.train.pooling import Tally, pooling
from quest.train.settings import TrainingConfig

if TYPE_CHECKING:
    from lightning_fabric import Fabric
    from torch.utils.tensorboard import SummaryWriter

_LOG_EVERY = 10


@runtime_checkable
class Scores(Protocol):
    """A dataclass of validation scores, plain numbers or None; ``str`` of it is a line for people."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by; less is better."""
        ...


@runtime_checkable
class Objective(Protocol):
    """What the loop needs to know of a stage of training."""

    name: str
    """Tells runs of different stages apart."""
    weights: dict[str, float]
    """Weight of every loss by its name."""

    @property
    def network(self) -> Any:
        """The network of which something is trained: a module with a ``config`` that is stored with its weights."""
        ...

    def trained(self) -> list[nn.Parameter]:
        """What is trained; every batch must give each of them a gradient."""
        ...

    def refined(self) -> list[nn.Parameter]:
        """Which of them were trained before on much more than is learned here, and learn at a smaller rate."""
        ...

    def losses(self, frames: Any, truth: Any, /) -> dict[str, Float[Tensor, ""]]:
        """Every loss of ``weights`` on a batch, unweighted.

        Means are taken by :func:`~quest.train.losses.masked_mean`, so that a batch can be divided.
        """
        ...

    def validate(self, sampler: Any, /, *, batches: int, device: torch.device) -> Scores:
        """Scores on the same examples at every call; the network is left in training mode."""
        ...


@dataclass(frozen=True)
class StepReport:
    """What a caller is told after every step."""

    step: int
    """Steps done."""
    loss: float
    """Weighted sum of the losses."""
    scores: Scores | None
    """Validation scores, at the steps where there are any."""
    best: float
    """Best validation score so far."""


def fit(
    objective: Objective,
    training: Sampler,
    validation: Sampler,
    config: TrainingConfig,
    *,
    out: Path,
    report: Callable[[StepReport], None],
    fabric: Fabric | None = None,
) -> Path:
    """Train what the objective trains; goes on from ``out/last`` where there is one, as if never interrupted.

    Only the first process writes and reports.

    Args:
        objective: what is learned, of which network.
        training: examples to learn from.
        validation: other examples; the same ones are drawn at every validation.
        config: how to train.
        out: folder for the checkpoints ``last`` and ``best`` and the curves.
        report: called after every step.
        fabric: devices and processes that :func:`~quest.train.devices.launch` started; started here if None.

    Returns:
        Folder of the best checkpoint.

    Raises:
        ConfigError: the loss became infinite, or the batch cannot be divided among the processes.
        WeightsError: ``out`` holds a run of another network or stage.
        MissingExtraError: Lightning Fabric or TensorBoard is not installed.
    """
    require("tensorboard")
    fabric = launch(config) if fabric is None else fabric
    parts = divide(
        training.config.batch, rank=fabric.global_rank, processes=fabric.world_size, accumulate=config.accumulate
    )
    with deterministic_algorithms(config.deterministic):
        learner = _Learner(objective, config, fabric)
        rng = np.random.default_rng(config.seed)
        progress = learner.resume(rng, out)
        writer = _writer(fabric, out, progress)
        batches = stream_batches(training, rng, parts, readers=config.readers)
        with writer or nullcontext():
            while progress.step < config.steps and progress.stale < config.patience:
                step = progress.step + 1
                batch = next(batches)
                values = learner.learn(batch, step)
                progress = replace(progress, step=step, rng=batch.rng)
                scores = None
                if step % config.validate_every == 0 or step == config.steps:
                    scores = learner.validate(validation)
                    progress = _judge(progress, scores)
                if scores is not None or step % config.checkpoint_every == 0:
                    learner.save(progress, out)
                if writer is not None:
                    _log(writer, objective, values, scores, step)
                if fabric.is_global_zero:
                    report(StepReport(step, float(values[0]), scores, progress.best))
            if progress.best_step == 0:  # as many steps were done before, but the run was stopped before it was judged
                progress = _judge(progress, learner.validate(validation))
                learner.save(progress, out)
    fabric.barrier()
    return out / "best"


class _Step(nn.Module):
    """The objective as a module, which is what DDP wraps."""

    def __init__(self, objective: Objective) -> None:
        super().__init__()
        self.network = objective.network
        self._objective = (objective.losses, objective.weights)

    def forward(self, batch: MicroBatch) -> tuple[Float[Tensor, ""], Float[Tensor, " N"]]:
        """The weighted sum of the losses, and each by itself, detached."""
        losses, weights = self._objective
        values = losses(batch.frames, batch.truth)
        return weighted_sum(values, weights), torch.stack([values[name].detach() for name in weights])


class _Learner:
    """One process's share of every step."""

    def __init__(self, objective: Objective, config: TrainingConfig, fabric: Fabric) -> None:
        self.objective = objective
        self.config = config
        self.fabric = fabric
        self.trained = objective.trained()
        chosen = {id(p) for p in self.trained}
        for parameter in objective.network.parameters():
            parameter.requires_grad_(id(parameter) in chosen)
        self.optimizer = make_optimizer(objective.network, self.trained, config, refined=objective.refined())
        self.mean = RunningMean(self.trained, self.optimizer, config.average_decay)

    def resume(self, rng: np.random.Generator, out: Path) -> Progress:
        """Take up the last checkpoint of a folder, or start, and hand everything to the devices."""
        network = self.objective.network
        begun = weights_digest(network)
        if self.config.compile:
            for part in network.busiest():
                part.compile()
        # First to the devices: the optimiser's state is loaded to where the parameters are.
        self.module, self.fabric_optimizer = self.fabric.setup(_Step(self.objective), self.optimizer)
        start = Progress(0, math.inf, 0, 0, _state(rng), network.config.to_json(), self.objective.name, begun)
        generators = {}
        if (out / "last").exists() or (out / ".old-last").exists():
            start = load_checkpoint(out / "last", network, self.optimizer)
            check_same_run(start, network.config, self.objective.name, begun, out)
            rng.bit_generator.state = json.loads(start.rng)
            generators = load_generators(out / "last")
        network.train()
        # Nobody writes before everybody has read.
        steps = torch.as_tensor(self.fabric.all_gather(torch.tensor(start.step, device=self.fabric.device)))
        if int(steps.min()) != int(steps.max()):
            raise ConfigError(f"training: not every process finds the checkpoint in {out}; all machines must share it")
        if not generators:
            part_ways(self.fabric, self.config.seed)
        restore_generators(self.fabric, generators)
        return start

    def learn(self, batch: Batch, step: int) -> Float[Tensor, " N"]:
        """One step of the optimiser.

        Returns:
            The loss of the whole batch, then its terms, on the CPU.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * group[SHARE] * _schedule(step, self.config)
            group["weight_decay"] = self.config.weight_decay
        self.optimizer.zero_grad(set_to_none=True)
        fabric, parts = self.fabric, [part.to(self.fabric.device) for part in batch.parts]
        tally = self._count(parts) if len(parts) > 1 else None
        pool = tally.read if tally else self._sum if fabric.world_size > 1 else None
        shares = []
        for i, part in enumerate(parts):
            if tally:
                tally.restart()
            with fabric.no_backward_sync(self.module, enabled=i + 1 < len(parts)):
                with pooling(pool):
                    loss, terms = self.module(part)
                # DDP takes the mean over processes, but these are parts of a sum.
                fabric.backward(loss * fabric.world_size)
            shares.append(torch.cat((loss.detach()[None], terms)).float())
        values = torch.stack(shares).sum(0)
        values = (self._sum(values) if fabric.world_size > 1 else values).cpu()
        if not torch.isfinite(values[0]):
            raise ConfigError(f"training: the loss became {values[0].item()} at step {step}; lower the learning rate")
        torch.nn.utils.clip_grad_norm_(self.trained, self.config.clip_norm)
        self.fabric_optimizer.step()
        self.mean.update(step)
        return values

    def validate(self, sampler: Sampler) -> Scores:
        """Scores of the mean of the weights, which the first process finds out and tells the others."""
        scores = None
        if self.fabric.is_global_zero:
            batches = self.config.validation_batches
            with self.fabric.autocast(), self.mean.applied():
                scores = self.objective.validate(sampler, batches=batches, device=self.fabric.device)
        scores = self.fabric.broadcast(scores)
        assert scores is not None
        return scores

    def save(self, progress: Progress, out: Path) -> None:
        """Write the last checkpoint, and the mean of the weights as the best one where it is."""
        generators = generator_states(self.fabric)
        if self.fabric.is_global_zero:
            network = self.objective.network
            # The best first: a run that is killed in between does this step again, and finds the same.
            if progress.best_step == progress.step:
                with self.mean.applied():
                    save_checkpoint(out / "best", network, self.optimizer, progress, generators)
            save_checkpoint(out / "last", network, self.optimizer, progress, generators)
        self.fabric.barrier()

    def _count(self, parts: list[MicroBatch]) -> Tally:
        """How much counts in all micro-batches of all processes."""
        tally = Tally()
        with torch.no_grad(), self.fabric.autocast(), pooling(tally.add):
            for part in parts:
                tally.restart()
                self.objective.losses(part.frames, part.truth)
        if self.fabric.world_size > 1:
            tally.sum_over(self._sum)
        return tally

    def _sum(self, value: Tensor) -> Tensor:
        total = self.fabric.all_reduce(value.clone(), reduce_op="sum")
        assert isinstance(total, Tensor)
        return total


def _schedule(step: int, config: TrainingConfig) -> float:
    if step <= config.warmup_steps:
        return step / config.warmup_steps
    done = (step - config.warmup_steps) / max(1, config.steps - config.warmup_steps)
    return 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * done))


def _judge(progress: Progress, scores: Scores) -> Progress:
    # The first score is the best so far whatever it is, so that there always is a best checkpoint.
    if scores.score < progress.best or progress.best_step == 0:
        return replace(progress, best=scores.score, best_step=progress.step, stale=0)
    return replace(progress, stale=progress.stale + 1)


def _state(rng: np.random.Generator) -> str:
    return json.dumps(rng.bit_generator.state)


def _writer(fabric: Fabric, out: Path, progress: Progress) -> SummaryWriter | None:
    if not fabric.is_global_zero:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(out / "curves"), purge_step=progress.step + 1)


def _log(
    writer: SummaryWriter, objective: Objective, values: Float[Tensor, " N"], scores: Scores | None, step: int
) -> None:
    if step % _LOG_EVERY == 0 or step == 1:
        for name, value in zip(("total", *objective.weights), values.tolist(), strict=True):
            writer.add_scalar(f"loss/{name}", value, step)
    if scores is not None:
        for name, value in asdict(scores).items():  # type: ignore[call-overload]
            if value is not None:
                writer.add_scalar(f"validation/{name}", value, step)
