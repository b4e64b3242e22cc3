"""Losses, their weights, and means that a divided batch shares.

The names are those of the publication: L_aff, L_vel, L_acc, L_conf, L_bound, L_feat, L_manifold. Each is a function of
predictions and truth that can be tested by itself. To add one, write its function here and its line in :data:`LOSSES`
of :mod:`quest.paper.objective`: the line gives its name, its weight and what it is of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from quest.errors import ConfigError
from quest.train.pooling import pooled

R = TypeVar("R", contravariant=True)


@dataclass(frozen=True)
class Loss(Generic[R]):
    """A term of an objective."""

    weight: float
    """In the sum; 0 turns it off."""
    of: Callable[[R], Float[Tensor, ""]]
    """Its value for what a network answered on a batch. Means are taken by :func:`masked_mean`, so that a batch can be
    divided."""


def weights_of(table: Mapping[str, Loss[Any]], changes: Mapping[str, float]) -> dict[str, float]:
    """The weight of every loss of a table; changes as for :func:`changed`."""
    return changed({name: loss.weight for name, loss in table.items()}, changes)


def changed(weights: Mapping[str, float], changes: Mapping[str, float]) -> dict[str, float]:
    """Weights of losses of which some differ.

    Raises:
        ConfigError: no such loss, or a weight below 0 or not finite.
    """
    for name, value in changes.items():
        if name not in weights:
            raise ConfigError(f"losses: this network has no {name!r}; expected some of {', '.join(weights)}")
        if not 0 <= value < math.inf:
            raise ConfigError(f"losses: expected {name} to be at least 0, got {value}; 0 turns it off")
    return {**weights, **{name: float(value) for name, value in changes.items()}}


def weighted_sum(values: Mapping[str, Float[Tensor, ""]], weights: Mapping[str, float]) -> Float[Tensor, ""]:
    """What a step lowers: every loss times its weight."""
    return torch.stack([weight * values[name] for name, weight in weights.items()]).sum()


def masked_mean(value: Float[Tensor, "*B"], mask: Float[Tensor, "*B"] | Bool[Tensor, "*B"]) -> Float[Tensor, ""]:
    """Mean of the values where the mask is, weighted by it; 0 where it is nowhere. NaN outside it does no harm.

    In a part of a batch, the part's share of the mean over the whole (see :mod:`quest.train.pooling`).
    """
    weight = mask.to(value.dtype)
    total = (torch.where(weight > 0, value, torch.zeros_like(value)) * weight).sum()
    return total / pooled(weight.sum()).clamp(min=1e-6)


def coordinate_loss(
    uv: Float[Tensor, "*B 2"], target: Float[Tensor, "*B 2"], weight: Float[Tensor, "*B"] | Bool[Tensor, "*B"]
) -> Float[Tensor, ""]:
    """L_aff: Huber loss of coordinates in [0, 1]^2, quadratic below 0.01."""
    target = torch.where((weight > 0).unsqueeze(-1), target, uv.detach())
    return masked_mean(F.huber_loss(uv, target, reduction="none", delta=0.01).sum(-1) / 0.01, weight)


def difference_loss(
    point: Float[Tensor, "B T K 3"],
    target: Float[Tensor, "B T K 3"],
    unit: Float[Tensor, " B"],
    mask: Bool[Tensor, "B T K"],
    *,
    order: int,
) -> Float[Tensor, ""]:
    """L_vel (order 1) and L_acc (order 2): L1 of differences of the 3D track, normalised units."""
    mask = mask & torch.isfinite(point).all(-1) & torch.isfinite(target).all(-1)
    error = torch.where(mask.unsqueeze(-1), point - target, torch.zeros_like(point)) / unit[:, None, None, None]
    for _ in range(order):
        error = error[:, 1:] - error[:, :-1]
        mask = mask[:, 1:] & mask[:, :-1]
    # Clamped, so that one frame on the wrong part does not outweigh all smooth ones.
    return masked_mean(error.abs().clamp(max=0.5).sum(-1), mask)


def confidence_loss(
    logit: Float[Tensor, "*B"], target: Bool[Tensor, "*B"], mask: Bool[Tensor, "*B"]
) -> Float[Tensor, ""]:
    """L_conf: binary cross-entropy."""
    return masked_mean(F.binary_cross_entropy_with_logits(logit, target.to(logit.dtype), reduction="none"), mask)


def bound_loss(uv: Float[Tensor, "*B 2"], mask: Bool[Tensor, "*B"]) -> Float[Tensor, ""]:
    """L_bound: how far raw coordinates leave [0, 1]^2."""
    return masked_mean((F.relu(-uv) + F.relu(uv - 1)).sum(-1), mask)


def feature_loss(embedding: Float[Tensor, "B T K D"], mask: Bool[Tensor, "B K"]) -> Float[Tensor, ""]:
    """L_feat: one minus the cosine of a query's embeddings in neighbouring frames."""
    cosine = F.cosine_similarity(embedding[:, 1:].float(), embedding[:, :-1].float(), dim=-1)
    return masked_mean(1 - cosine, mask[:, None].expand_as(cosine))


def manifold_loss(
    point: Float[Tensor, "B T K 3"],
    rest: Float[Tensor, "B K 3"],
    axis: Float[Tensor, "B K 6"],
    revolute: Bool[Tensor, "B K"],
    unit: Float[Tensor, " B"],
    mask: Bool[Tensor, "B T K"],
) -> Float[Tensor, ""]:
    """L_manifold: distance of a point to the line or circle that its entity moves on, normalised units.

    Args:
        point: predicted positions in the reference frame.
        rest: a true position on the line or circle.
        axis: origin and unit direction of the joint; a direction of zero makes the line one point, for what is fixed.
        revolute: circle about the axis, else line along it.
        unit: reference units per normalised unit.
        mask: which predictions count.
    """
    mask = mask & torch.isfinite(point).all(-1)
    point = torch.where(mask.unsqueeze(-1), point, rest[:, None])
    origin, direction = axis[:, None, :, :3], axis[:, None, :, 3:]

    def cylinder(p: Tensor) -> tuple[Tensor, Tensor]:
        height = ((p - origin) * direction).sum(-1)
        radial = (p - origin) - height.unsqueeze(-1) * direction
        return height, radial.square().sum(-1).clamp(min=1e-8).sqrt()

    height, radius = cylinder(point)
    rest_height, rest_radius = cylinder(rest[:, None])
    circle = ((height - rest_height) ** 2 + (radius - rest_radius) ** 2).clamp(min=1e-8).sqrt()
    offset = point - rest[:, None]
    along = (offset * direction).sum(-1, keepdim=True)
    line = (offset - along * direction).square().sum(-1).clamp(min=1e-8).sqrt()
    distance = torch.where(revolute[:, None], circle, line) / unit[:, None, None]
    return masked_mean(distance.clamp(max=0.5), mask)
