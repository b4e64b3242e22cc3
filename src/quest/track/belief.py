"""Where an entity may be, over the cells of the newest frame, carried from frame to frame.

Every frame is matched with the unchanged anchor; the belief only says that things do not jump. It is the forward
recursion of a hidden Markov model whose states are the cells, so nothing is committed to and a wrong belief is left
again through the jump probability.

Reference: Rabiner, A Tutorial on Hidden Markov Models, Proceedings of the IEEE 1989, section III.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from quest.geometry import exact_product
from quest.track.settings import TrackerConfig


@dataclass(frozen=True)
class Belief:
    """Belief of K queries over the cells of one frame."""

    probability: Float[Tensor, "K C"]
    """Sums to one over the cells."""
    cell_point: Float[Tensor, "C 3"]
    """The cells' points in the reference frame, NaN where depth is missing."""


def moved(
    belief: Belief, cell_point: Float[Tensor, "C 3"], cell_uv: Float[Tensor, "C 2"], sigma: float
) -> Float[Tensor, "K C"]:
    """Where entities may be now that were seen in the previous frame; sums to one over the cells.

    Args:
        belief: after the previous frame.
        cell_point: the newest frame's lifted cells.
        cell_uv: the cells' centres in [-1, 1]^2, which stand in where depth is missing.
        sigma: how far things move.
    """
    return exact_product(belief.probability, _move(belief.cell_point, cell_point, cell_uv, sigma))


def update(
    prior: Float[Tensor, "K C"] | None,
    logits: Float[Tensor, "K C"],
    seen: Float[Tensor, " K"],
    favour: Float[Tensor, "K C"],
    config: TrackerConfig,
) -> Float[Tensor, "K C"]:
    """One step of the recursion: the probability of every cell.

    Args:
        prior: where entities may be before the frame is looked at; None where anywhere, in a search and in a new
            reference frame.
        logits: scores of the newest frame's cells.
        seen: probability that each entity is seen, by which the frame's scores are trusted.
        favour: log weights of the cells by what else is known, the joint.
        config: how far things move.
    """
    likelihood = (logits / config.temperature).log_softmax(dim=-1)
    if prior is None:
        return (likelihood + favour).softmax(dim=-1)
    prior = (1 - config.jump) * prior + config.jump / likelihood.shape[-1]
    # A hidden entity's scores say little about where it is.
    return (seen.clamp(0.1, 1.0).unsqueeze(-1) * likelihood + favour + prior.log()).softmax(dim=-1)


def _move(
    before: Float[Tensor, "C 3"], after: Float[Tensor, "C 3"], cell_uv: Float[Tensor, "C 2"], sigma: float
) -> Float[Tensor, "C C"]:
    """Probability of every cell after, given every cell before (rows sum to one)."""
    valid = torch.isfinite(before).all(-1)[:, None] & torch.isfinite(after).all(-1)[None]
    in_space = torch.cdist(before.nan_to_num(), after.nan_to_num())
    in_image = torch.cdist(cell_uv, cell_uv)
    distance = torch.where(valid, in_space, in_image)
    return (-0.5 * (distance / sigma) ** 2).softmax(dim=-1)
