"""What a training run learns: the protocol that the loop knows, and stage 1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.config import DecoderConfig
from quest.model.network import QuestNetwork, WindowNetwork
from quest.model.observation import FrameBatch
from quest.train.losses import weights_of
from quest.train.objective import LOSSES, Answered, roll_out
from quest.train.validation import WindowScores, score_windows
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
    weights: dict[str, float]
    """Weight of every loss by its name."""

    @property
    def network(self) -> WindowNetwork[DecoderConfig]:
        """The network of which something is trained."""
        ...

    def trained(self) -> list[nn.Parameter]:
        """What is trained; every batch must give each of them a gradient."""
        ...

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> dict[str, Float[Tensor, ""]]:
        """Every loss of ``weights`` on a batch, unweighted.

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
        changes: weights of losses that are to differ; 0 turns one off.
    """

    name = "stage-1"

    def __init__(self, network: QuestNetwork, changes: Mapping[str, float] | None = None) -> None:
        self.network = network
        self.weights = weights_of(LOSSES, changes or {})

    def trained(self) -> list[nn.Parameter]:
        """All parameters outside the encoder, the flow head and a map with a trunk of its own."""
        return self.network.trainable()

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> dict[str, Float[Tensor, ""]]:
        """Every loss of stage 1."""
        answered = roll_out(self.network, frames, truth)
        return {name: loss.of(answered) for name, loss in LOSSES.items()}

    def answered(self, frames: FrameBatch, truth: WindowTruth) -> Answered:
        """What entities are answered."""
        return roll_out(self.network, frames, truth)

    def validate(self, sampler: WindowSampler, *, batches: int, device: torch.device) -> WindowScores:
        """Distance, identity and discovery on fixed windows."""
        return score_windows(self.network, self.answered, sampler, batches=batches, device=device)
