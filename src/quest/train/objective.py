"""From a batch of windows to the losses of stage 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from quest.model.decoder import Anchor, Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.train import losses
from quest.train.losses import Loss
from quest.train.windows import WindowTruth

RIGHT_PX = 8.0
"""An answer this near to a seen entity is right, pixels of the input."""

_OCCLUDED_WEIGHT = 0.3
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


@dataclass(frozen=True)
class Rollout(Answered):
    """What the network answers on a batch of windows, taken freely, as a tracker would."""

    prediction: Prediction
    """Everything that it says, of which ``embedding``, ``uv`` and ``point`` are a part."""
    taught: Prediction
    """The same, refined around the true cell where the free peak is far from it."""
    observed: Observation
    """The window's observation."""
    anchor_observed: Observation
    """The anchor frame's observation."""
    frames: FrameBatch
    """The anchor frame and the window."""
    network: QuestNetwork
    """That answered."""


def roll_out(network: QuestNetwork, frames: FrameBatch, truth: WindowTruth) -> Rollout:
    """Bind queries at the anchor frame and answer in the window.

    Args:
        network: the network.
        frames: the anchor frame and the window.
        truth: what is true of them.
    """
    observed = network.observe(frames)
    first, window = observed.during(slice(0, 1)), observed.during(slice(1, None))
    anchor = bind_at(network, frames, first, truth)
    free = network.decode(anchor, window)
    taught = _teach(network, anchor, free, window, truth.uv[:, 1:])
    return Rollout(
        embedding=free.embedding,
        uv=free.uv,
        point=free.point,
        asked=truth.bound,
        truth=truth,
        prediction=free,
        taught=taught,
        observed=window,
        anchor_observed=first,
        frames=frames,
        network=network,
    )


def bind_at(network: QuestNetwork, frames: FrameBatch, observed: Observation, truth: WindowTruth) -> Anchor:
    """Bind queries to their pixels of the first frame of a batch; their 3D points come from its depth."""
    first = frames.during(slice(0, 1))
    uv_px = truth.anchor_uv.unsqueeze(1) * network.config.encoder.image_size
    point = first.near_point_at(uv_px).squeeze(1)
    return network.bind(observed, truth.anchor_uv, point, truth.told, truth.bound, truth.told_intent)


def has_moved(truth: WindowTruth) -> Bool[Tensor, "B T K"]:
    """Whether an entity has left its place at the anchor frame by more than 0.1 normalised units."""
    moved = (truth.point[:, 1:] - truth.point[:, :1]).norm(dim=-1) / truth.unit[:, None, None]
    return moved > _RIGHT_DISTANCE


def is_right(
    point: Float[Tensor, "B T K 3"], truth: WindowTruth, px: Float[Tensor, "B T K"]
) -> tuple[Bool[Tensor, "B T K"], Bool[Tensor, "B T K"]]:
    """Whether the nearest true entity is the own one and within 0.1 normalised units.

    Where nothing is lifted, the distance in pixels decides.

    Returns:
        The answer, and whether it can be judged at all.
    """
    target = torch.where(truth.exists[:, None, :, None], truth.point[:, 1:], torch.full_like(truth.point[:, 1:], 1e3))
    lifted = torch.isfinite(point).all(-1)
    distance = torch.cdist(point.nan_to_num().flatten(0, 1).float(), target.flatten(0, 1))
    distance = distance.unflatten(0, point.shape[:2]) / truth.unit[:, None, None, None]
    own = distance.diagonal(dim1=-2, dim2=-1)
    right = (own <= distance.amin(-1) + 1e-6) & (own < _RIGHT_DISTANCE)
    return torch.where(lifted, right, px < RIGHT_PX), torch.isfinite(px)


def _confidence(r: Rollout) -> Tensor:
    px = (r.uv - r.truth_uv).norm(dim=-1) * r.network.config.encoder.image_size
    right, judged = is_right(r.point.detach(), r.truth, px.detach())
    seen = losses.confidence_loss(r.prediction.visible_logit, r.visible, r.mask)
    return seen + losses.confidence_loss(r.prediction.right_logit, right, r.mask & judged)


def _affordance(r: Rollout) -> Tensor:
    if r.network.config.map_layers:  # a map with a trunk of its own has a stage of its own
        return r.uv.sum() * 0
    # The anchor frame and the newest one: the frames between differ little from them.
    seen = Observation.stack([r.anchor_observed, r.observed.during(slice(-1, None))])
    truth, found = r.truth, r.network.afford(r.frames.ends(), seen)
    visible = (truth.visible & truth.exists[:, None])[:, [0, -1]]
    return losses.affordance_loss(found, truth.uv[:, [0, -1]], truth.label, truth.intent, visible)


def _teach(
    network: QuestNetwork, anchor: Anchor, prediction: Prediction, observed: Observation, uv: Tensor
) -> Prediction:
    head, side = network.head, network.config.cells
    place = (uv.nan_to_num(0.5) * side).long().clamp(0, side - 1)
    row, column = prediction.peak.div(side, rounding_mode="floor"), prediction.peak % side
    near = ((row - place[..., 1]).abs() <= 1) & ((column - place[..., 0]).abs() <= 1)
    cell = torch.where(near, prediction.peak, place[..., 1] * side + place[..., 0])
    taught_uv, point = head.refine(prediction.embedding, anchor, prediction.logits, observed, cell)
    return replace(prediction, peak=cell, uv=taught_uv, point=point)


def _heatmap(r: Rollout) -> Tensor:
    weight = r.mask * r.importance * torch.where(r.visible, 1.0, _OCCLUDED_WEIGHT)
    return losses.heatmap_loss(r.prediction.logits, r.truth_uv, weight, cells=r.network.config.cells)


def _difference(r: Rollout, order: int) -> Tensor:
    return losses.difference_loss(r.taught.point, r.truth_point, r.truth.unit, r.seen, order=order)


def _manifold(r: Rollout) -> Tensor:
    truth = r.truth
    return losses.manifold_loss(r.taught.point, truth.point[:, 0], truth.axis, truth.revolute, truth.unit, r.seen)


def _joint(r: Rollout) -> Tensor:
    return losses.joint_loss(r.network.joint(r.embedding), r.truth_point, r.truth.axis, r.truth.revolute, r.mask)


LOSSES: dict[str, Loss[Rollout]] = {
    "aff": Loss(20.0, lambda r: losses.coordinate_loss(r.taught.uv, r.truth_uv, r.seen * r.importance)),
    "heat": Loss(1.0, _heatmap),
    "point": Loss(2.0, lambda r: losses.point_loss(r.taught.point, r.truth_point, r.truth.unit, r.mask * r.importance)),
    "vel": Loss(1.0, lambda r: _difference(r, 1)),
    "acc": Loss(0.5, lambda r: _difference(r, 2)),
    "conf": Loss(0.3, _confidence),
    "bound": Loss(0.1, lambda r: losses.bound_loss(r.taught.uv, r.mask)),
    "feat": Loss(0.02, lambda r: losses.feature_loss(r.embedding, r.asked)),
    "geo": Loss(0.2, _manifold),
    "map": Loss(1.0, _affordance),
    "joint": Loss(0.1, _joint),
}
"""The losses of stage 1 by name (``docs/training.md`` says what each is of)."""
