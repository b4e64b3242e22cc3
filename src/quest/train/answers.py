"""Answers for the entities of windows, and which of them are right."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from quest.train.windows import WindowTruth

RIGHT_PX = 8.0
"""An answer this near to a seen entity is right, pixels of the input."""

_MOVED_WEIGHT = 3.0
_RIGHT_DISTANCE = 0.1


@dataclass(frozen=True)
class Answered:
    """Answers for the entities of a batch of windows, and the truth of the same frames."""

    embedding: Float[Tensor, "B T K D"]
    """Of what answers for each entity."""
    uv: Float[Tensor, "B T K 2"]
    """Coordinates in [0, 1]^2 of the input."""
    point: Float[Tensor, "B T K 3"]
    """Positions in the reference frame; NaN where they cannot be lifted."""
    asked: Bool[Tensor, "B K"]
    """Entities that have an answer."""
    truth: WindowTruth
    """What is true; index 0 of its time axis is the anchor frame."""

    @property
    def truth_uv(self) -> Float[Tensor, "B T K 2"]:
        """True coordinates."""
        return self.truth.uv[:, 1:]

    @property
    def truth_point(self) -> Float[Tensor, "B T K 3"]:
        """True reference positions."""
        return self.truth.point[:, 1:]

    @property
    def visible(self) -> Bool[Tensor, "B T K"]:
        """Whether the entity is seen."""
        return self.truth.visible[:, 1:]

    @property
    def mask(self) -> Bool[Tensor, "B T K"]:
        """Which answers count at all: of entities that are asked for and inside the image."""
        inside = ((self.truth_uv >= 0) & (self.truth_uv <= 1)).all(-1)
        return self.asked[:, None].expand_as(inside) & inside

    @property
    def seen(self) -> Bool[Tensor, "B T K"]:
        """Which answers count that are of entities in sight."""
        return self.mask & self.visible

    @property
    def importance(self) -> Float[Tensor, "B T K"]:
        """An entity that moved is what a tracker is asked about; most of them stand still in most windows."""
        return torch.where(has_moved(self.truth), _MOVED_WEIGHT, 1.0)


def has_moved(truth: WindowTruth) -> Bool[Tensor, "B T K"]:
    """Whether an entity has left its place at the anchor frame by more than 0.1 normalised units."""
    moved = (truth.point[:, 1:] - truth.point[:, :1]).norm(dim=-1) / truth.unit[:, None, None]
    return moved > _RIGHT_DISTANCE


def is_right(point: Float[Tensor, "B T K 3"], truth: WindowTruth, px: Float[Tensor, "B T K"]) -> Bool[Tensor, "B T K"]:
    """Whether the nearest true entity is the own one and within 0.1 normalised units.

    Where nothing is lifted, the distance in pixels decides.
    """
    target = torch.where(truth.exists[:, None, :, None], truth.point[:, 1:], torch.full_like(truth.point[:, 1:], 1e3))
    lifted = torch.isfinite(point).all(-1)
    distance = torch.cdist(point.nan_to_num().flatten(0, 1).float(), target.flatten(0, 1))
    distance = distance.unflatten(0, point.shape[:2]) / truth.unit[:, None, None, None]
    own = distance.diagonal(dim1=-2, dim2=-1)
    right = (own <= distance.amin(-1) + 1e-6) & (own < _RIGHT_DISTANCE)
    return torch.where(lifted, right, px < RIGHT_PX)
