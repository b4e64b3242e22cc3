"""Losses of stage 1.

The names follow the design: L_aff, L_vel, L_acc, L_conf, L_bound, L_feat, L_manifold; a heatmap adds its cross-entropy
and 3D offset, discovery its focal loss. Each is a function of predictions and truth that can be tested by itself.
To add one, write its function here and its line in the table of the network that learns by it, :data:`LOSSES` of
:mod:`quest.train.objective` or of :mod:`quest.paper.objective`: the line gives its name, its weight and what it is of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.errors import ConfigError
from quest.model.affordance import AffordanceMap
from quest.model.joint_head import JointBelief
from quest.model.observation import grid_centres
from quest.train.pooling import pooled
from quest.types import GRIPS, LABELS

FAR_WEIGHT = 0.2
"""Of offsets across a whole handle or link, beside those of the cells around an entity."""

_NO_ERROR = 0.999
"""Target of a cell that may have any score."""

_OUTLINED = torch.tensor([LABELS.index(label) for label in GRIPS])


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
    """The weight of every loss of a table.

    Args:
        table: losses by name.
        changes: weights that are to differ.

    Raises:
        ConfigError: no such loss, or a weight below 0 or not finite.
    """
    for name, value in changes.items():
        if name not in table:
            raise ConfigError(f"losses: this network has no {name!r}; expected some of {', '.join(table)}")
        if not 0 <= value < math.inf:
            raise ConfigError(f"losses: expected {name} to be at least 0, got {value}; 0 turns it off")
    return {name: float(changes.get(name, loss.weight)) for name, loss in table.items()}


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


def heatmap_loss(
    logits: Float[Tensor, "*B C"], uv: Float[Tensor, "*B 2"], weight: Float[Tensor, "*B"], *, cells: int
) -> Float[Tensor, ""]:
    """Cross-entropy against a Gaussian of 0.6 cells around the true position.

    Args:
        logits: score per cell.
        uv: true coordinates in [0, 1]^2.
        weight: how much each position counts; 0 outside the image.
        cells: cells along one side.
    """
    inside = weight > 0
    place = torch.where(inside.unsqueeze(-1), uv, torch.full_like(uv, 0.5)) * cells
    centre = torch.arange(cells, device=uv.device) + 0.5
    x = torch.exp(-0.5 * ((centre - place[..., :1]) / 0.6) ** 2)
    y = torch.exp(-0.5 * ((centre - place[..., 1:]) / 0.6) ** 2)
    target = (y.unsqueeze(-1) * x.unsqueeze(-2)).flatten(-2)
    target = target / target.sum(-1, keepdim=True).clamp(min=1e-9)
    return masked_mean(-(target * logits.log_softmax(-1)).sum(-1), weight)


def point_loss(
    point: Float[Tensor, "B T K 3"],
    target: Float[Tensor, "B T K 3"],
    unit: Float[Tensor, " B"],
    weight: Float[Tensor, "B T K"] | Bool[Tensor, "B T K"],
) -> Float[Tensor, ""]:
    """Huber loss of the 3D distance in normalised units, linear above 0.05."""
    weight = weight * (torch.isfinite(point).all(-1) & torch.isfinite(target).all(-1))
    error = torch.where((weight > 0).unsqueeze(-1), point - target, torch.zeros_like(point))
    error = error / unit[:, None, None, None]
    loss = F.huber_loss(error, torch.zeros_like(error), reduction="none", delta=0.05).sum(-1) / 0.05
    return masked_mean(loss, weight)


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


def joint_loss(
    belief: JointBelief,
    point: Float[Tensor, "B T K 3"],
    axis: Float[Tensor, "B K 6"],
    revolute: Bool[Tensor, "B K"],
    mask: Bool[Tensor, "B T K"],
) -> Float[Tensor, ""]:
    """Negative log likelihood of an entity's joint: its kind, and the direction and place of its axis.

    Errors are Laplace-like with a spread that the network predicts; a direction has two degrees of freedom, a place
    three. Axes have no sign.

    Args:
        belief: what the network believes.
        point: true positions in the reference frame.
        axis: true origin and unit direction of the joint; a direction of zero says that there is no joint, and then
            nothing counts.
        revolute: whether the joint turns.
        mask: which beliefs count.
    """
    mask = mask & (axis[:, None, :, 3:] != 0).any(-1)
    revolute = revolute[:, None].expand_as(mask)
    origin, direction = axis[:, None, :, :3], axis[:, None, :, 3:]
    kind = F.binary_cross_entropy_with_logits(belief.revolute_logit, revolute.float(), reduction="none")

    def likelihood(error: Tensor, log_spread: Tensor, freedom: int) -> Tensor:
        return error * (-log_spread).exp() + freedom * log_spread

    def sine(predicted: Tensor) -> Tensor:
        return torch.linalg.cross(predicted, direction.expand_as(predicted)).square().sum(-1).clamp(min=1e-8).sqrt()

    slide_spread, turn_spread, foot_spread = belief.log_spread.unbind(-1)
    slide = likelihood(sine(belief.slide_axis), slide_spread, 2)
    known = torch.where(mask.unsqueeze(-1), point, origin)
    offset = known - origin
    foot = (offset * direction).sum(-1, keepdim=True) * direction - offset
    gap = (belief.foot - foot).square().sum(-1).clamp(min=1e-8).sqrt()
    turn = likelihood(sine(belief.turn_axis), turn_spread, 2) + likelihood(gap, foot_spread, 3)
    return masked_mean(kind + torch.where(revolute, turn, slide), mask & torch.isfinite(known).all(-1))


def affordance_loss(
    found: AffordanceMap,
    uv: Float[Tensor, "B T K 2"],
    label: Int[Tensor, "B K"],
    intent: Int[Tensor, "B K"],
    visible: Bool[Tensor, "B T K"],
    owner: Int[Tensor, "B T C"] | None = None,
) -> Float[Tensor, ""]:
    """Focal loss of the dense map; in the 3 x 3 cells around every entity, L1 of the offsets to it.

    Where cells are near several entities of one purpose, they point to the nearest. All other cells that are a part of
    an entity point to it too: the middle of a long thing is known by where its ends are. To score them like the middle
    of a handle is no error, as they point to the same place, nor is it where a handle hides its own middle; rims and
    fronts are asked for their middle.

    Reference: Law and Deng, CornerNet, ECCV 2018, equations 1 and 2.

    Args:
        found: the map.
        uv: true coordinates in [0, 1]^2.
        label: index into LABELS.
        intent: index into INTENTS.
        visible: which entities are seen.
        owner: the entity that each cell is a part of, -1 for none; None where that is not known.
    """
    cells, purposes = math.isqrt(found.logits.shape[2]), found.logits.shape[-1]
    place = torch.where(visible.unsqueeze(-1), uv, torch.full_like(uv, 0.5)).clamp(0, 1 - 1e-6) * cells
    gap = place.unsqueeze(-2) - grid_centres(cells, 1, device=uv.device)
    owner = torch.full(found.logits.shape[:3], -1, device=uv.device) if owner is None else owner
    blob = torch.exp(-0.5 * gap.square().sum(-1) / 0.8**2)
    cell = place[..., 1].long() * cells + place[..., 0].long()
    blob = blob.scatter(-1, cell.unsqueeze(-1), 1.0) * visible.unsqueeze(-1)
    outlined = torch.isin(label, _OUTLINED.to(label.device))[:, None, :, None]
    part = (owner[:, :, None] == torch.arange(uv.shape[2], device=uv.device)[:, None]) & outlined
    blob = torch.maximum(blob, _NO_ERROR * part)
    purpose = intent.clamp(max=purposes - 1)
    one_hot = F.one_hot(label * purposes + purpose, len(LABELS) * purposes).to(blob.dtype)[:, None, :, None]
    target = (blob.unsqueeze(-1) * one_hot).amax(dim=2)
    meant = [visible & (purpose == n)[:, None] for n in range(purposes)]
    pointing = [_pointing_loss(found.offset[..., n, :], gap, meant[n], owner) for n in range(purposes)]
    return _focal_loss(found.logits.flatten(-2), target) + 0.5 * torch.stack(pointing).mean()


def _focal_loss(logits: Float[Tensor, "B T C N"], target: Float[Tensor, "B T C N"]) -> Float[Tensor, ""]:
    log_p, log_not, p = F.logsigmoid(logits), F.logsigmoid(-logits), logits.sigmoid()
    positive = target >= 1
    loss = torch.where(positive, -((1 - p) ** 2) * log_p, -((1 - target) ** 4) * p**2 * log_not)
    return loss.sum() / pooled(positive.sum().to(loss.dtype)).clamp(min=1)


def _pointing_loss(
    offset: Float[Tensor, "B T C 2"],
    gap: Float[Tensor, "B T K C 2"],
    meant: Bool[Tensor, "B T K"],
    owner: Int[Tensor, "B T C"],
) -> Float[Tensor, ""]:
    """L1 of offsets, in cells, to the nearest of the entities that are meant, else to the one a cell is a part of."""
    least, nearest = torch.where(meant.unsqueeze(-1), gap.abs().amax(-1), torch.inf).min(dim=2)
    near, own = least < 1.5, owner.clamp(min=0)
    part = (owner >= 0) & meant.gather(2, own) & ~near
    index = torch.where(near, nearest, own)[:, :, None, :, None]
    residual = (offset - gap.gather(2, index.expand(-1, -1, -1, -1, 2)).squeeze(2)).abs().sum(-1)
    return masked_mean(residual, near) + FAR_WEIGHT * masked_mean(residual, part)
