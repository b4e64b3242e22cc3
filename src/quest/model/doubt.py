"""The log odds of a loss, learned: a small network weighs what the filter reads off its posterior.

Where the filter knew that it is wrong it would be elsewhere, so its own odds of a loss are too low: a body of a wrong
pose carries a query along, and its newest view with it. What that looks like in the readings is learned from streams
whose truth is known (``benchmarks/fit_doubt.py``).

Reference: Platt, Probabilistic outputs for support vector machines, 1999, of which this is the form with many inputs.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from quest.errors import WeightsError
from quest.model.encoder import load_exactly
from quest.model.tensor_file import read_tensors, save_tensors

FORMAT = "quest-doubt-1"
PACKAGED = Path(str(resources.files("quest") / "assets" / "doubt.safetensors"))
"""File of the network that ships."""
LIMIT = 4.0
"""Readings are kept within so many of their standard deviations."""


class Doubt(nn.Module):
    """A network of one hidden layer.

    Args:
        readings: how many it weighs.
        hidden: width of the layer.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, readings: int, hidden: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(readings))
        self.register_buffer("scale", torch.ones(readings))
        self.hidden = nn.Linear(readings, hidden)
        self.out = nn.Linear(hidden, 1)

    def forward(self, readings: Float[Tensor, "*N R"]) -> Float[Tensor, "*N"]:
        """Log odds that the identity is lost; NaN where a reading is."""
        told = ((readings - self.mean) / self.scale).clamp(-LIMIT, LIMIT)
        return self.out(torch.tanh(self.hidden(told)))[..., 0]

    @torch.no_grad()
    def log_odds(self, readings: Float[np.ndarray, "*N R"]) -> Float64[np.ndarray, "*N"]:
        """The same of arrays."""
        return self(torch.from_numpy(readings).float()).double().numpy()


def save_doubt(doubt: Doubt, path: Path, *, readings: Sequence[str], about: str) -> None:
    """Write a network whole or not at all.

    Raises:
        WeightsError: the file cannot be written.
    """
    metadata = {"format": FORMAT, "readings": json.dumps(list(readings)), "about": about}
    tensors = {name: tensor.detach().contiguous() for name, tensor in doubt.state_dict().items()}
    save_tensors(tensors, path, metadata=metadata)


def read_doubt(readings: Sequence[str], path: Path = PACKAGED) -> Doubt:
    """A network of :func:`save_doubt`, in evaluation mode and without gradients.

    Args:
        readings: the names of what the filter gives, in its order.
        path: the file; by default the one that ships.

    Raises:
        WeightsError: the file is missing or torn, or its network weighs other readings.
    """
    metadata, tensors = read_tensors(path)
    if metadata.get("format") != FORMAT:
        raise WeightsError(f"{path}: expected a network of format {FORMAT}, got {metadata.get('format')!r}")
    if metadata.get("readings") != json.dumps(list(readings)):
        raise WeightsError(f"{path}: its network weighs other readings than the filter gives; make it again")
    doubt = Doubt(len(readings), len(tensors.get("hidden.bias", ())))
    load_exactly(doubt, tensors, what=f"network {path}")
    return doubt.eval().requires_grad_(False)
