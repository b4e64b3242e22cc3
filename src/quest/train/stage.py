"""What a training run learns: the protocol that the loop knows, and stage 1."""

from __future__ import annotations

from dataclasses import fields
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.train.objective import LossTerms, stage_one
from quest.train.settings import LossWeights
from quest.train.validation import WindowScores, validate
from quest.train.windows import WindowSampler, WindowTruth


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
    network: QuestNetwork
    """The network of which something is trained."""
    terms: tuple[str, ...]
    """Names of the losses."""

    def trained(self) -> list[nn.Parameter]:
        """What is trained; every batch must give each of them a gradient."""
        ...

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> tuple[Float[Tensor, ""], Float[Tensor, " N"]]:
        """The weighted sum of the losses on a batch, and each loss by itself, detached.

        Means are taken by :func:`~quest.train.losses.masked_mean`, so that a batch can be divided.
        """
        ...

    def validate(self, sampler: WindowSampler, *, batches: int, device: torch.device) -> Scores:
        """Scores on the same windows at every call; the network is left in training mode."""
        ...


class StageOne:
    """Stage 1: everything but the encoder learns to follow and judge, and to find where that has no stage of its own.

    Args:
        network: the network; a flow head, and a map with a trunk of its own, stay as they are. The flow head should be
            trained again afterwards; the map does not stand on what changed.
        weights: weight of every loss.
    """

    name = "stage-1"
    terms: tuple[str, ...] = tuple(f.name for f in fields(LossTerms))

    def __init__(self, network: QuestNetwork, weights: LossWeights) -> None:
        self.network = network
        self.weights = weights

    def trained(self) -> list[nn.Parameter]:
        """All parameters outside the encoder, the flow head and a map with a trunk of its own."""
        return self.network.trainable()

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> tuple[Float[Tensor, ""], Float[Tensor, " N"]]:
        """All losses of stage 1."""
        terms, _ = stage_one(self.network, frames, truth)
        return terms.total(self.weights), torch.stack([getattr(terms, name).detach() for name in self.terms])

    def validate(self, sampler: WindowSampler, *, batches: int, device: torch.device) -> WindowScores:
        """Distance, identity and discovery on fixed windows."""
        return validate(self.network, sampler, batches=batches, device=device)
