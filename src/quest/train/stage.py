"""What a training run learns: the protocol that the loop knows."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn


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
