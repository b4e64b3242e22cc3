"""From a batch of windows to the losses of stage 1, for anchored and for learned queries."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from quest.errors import ConfigError
from quest.model.decoder import Anchor, HeatmapHead, Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.train import losses
from quest.train.settings import LossWeights
from quest.train.slots import (
    CONFIDENT_PX,
    SlotAnswers,
    answer_slots,
    at_window,
    slot_confidence_loss,
    slot_label_loss,
)
from quest.train.windows import WindowTruth

_OCCLUDED_WEIGHT = 0.3
_MOVED_WEIGHT = 3.0
_RIGHT_DISTANCE = 0.1


@dataclass(frozen=True)
class LossTerms:
    """One value per field of :class:`~quest.train.settings.LossWeights`, unweighted."""

    aff: Tensor
    heat: Tensor
    point: Tensor
    vel: Tensor
    acc: Tensor
    conf: Tensor
    bound: Tensor
    feat: Tensor
    geo: Tensor
    map: Tensor
    joint: Tensor

    def total(self, weights: LossWeights) -> Tensor:
        """Weighted sum."""
        parts = [getattr(weights, f.name) * getattr(self, f.name) for f in fields(self)]
        return torch.stack(parts).sum()


@dataclass(frozen=True)
class Rollout:
    """Predictions of a batch of windows and the truth of the same frames.

    Attributes:
        prediction: answers, taken freely (as a tracker would).
        taught: the same, refined around the true cell where the free peak is far from it.
        truth_uv: true coordinates.
        truth_point: true reference positions.
        visible: whether the entity is seen.
        mask: which answers count at all.
        observed: the window's observation.
        anchor_observed: the anchor frame's observation.
        asked: entities that have a query: those that it was bound to, or that a slot was matched to.
        slots: answers of all slots, for networks that have them.
    """

    prediction: Prediction
    taught: Prediction
    truth_uv: Float[Tensor, "B T K 2"]
    truth_point: Float[Tensor, "B T K 3"]
    visible: Bool[Tensor, "B T K"]
    mask: Bool[Tensor, "B T K"]
    observed: Observation
    anchor_observed: Observation
    asked: Bool[Tensor, "B K"]
    slots: SlotAnswers | None = None


def roll_out(network: QuestNetwork, frames: FrameBatch, truth: WindowTruth, *, whole: bool = False) -> Rollout:
    """Bind at the anchor frame (index 0) and answer the frames after it.

    Args:
        network: the network.
        frames: the anchor frame and the window.
        truth: what is true of them.
        whole: whether learned slots are matched by the window too, to learn from it
            (see :func:`~quest.train.slots.answer_slots`).
    """
    observed = network.observe(frames)
    first, window = observed.during(slice(0, 1)), observed.during(slice(1, None))
    uv, point, visible = truth.uv[:, 1:], truth.point[:, 1:], truth.visible[:, 1:]
    slots = None
    if network.config.queries == "anchored":
        anchor = bind_at(network, frames, first, truth)
        prediction = network.decode(anchor, window, frames.during(slice(1, None)))
        taught = _teach(network, anchor, prediction, window, uv)
        asked = truth.bound
    else:
        slots = answer_slots(network, observed, frames, truth, whole=whole)
        prediction = taught = at_window(slots.of_entities)
        asked = slots.matched
    mask = asked[:, None].expand_as(visible) & ((uv >= 0) & (uv <= 1)).all(-1)
    return Rollout(prediction, taught, uv, point, visible, mask, window, first, asked, slots)


def bind_at(network: QuestNetwork, frames: FrameBatch, observed: Observation, truth: WindowTruth) -> Anchor:
    """Bind queries to their pixels of the first frame of a batch; their 3D points come from its depth."""
    first = frames.during(slice(0, 1))
    uv_px = truth.anchor_uv.unsqueeze(1) * network.config.encoder.image_size
    point = first.near_point_at(uv_px).squeeze(1)
    return network.bind(observed, truth.anchor_uv, point, truth.told, truth.bound, truth.told_intent)


def stage_one(network: QuestNetwork, frames: FrameBatch, truth: WindowTruth) -> tuple[LossTerms, Rollout]:
    """All losses of stage 1 on one batch."""
    roll = roll_out(network, frames, truth, whole=True)
    free, taught, mask = roll.prediction, roll.taught, roll.mask
    seen = mask & roll.visible
    # An entity that moved is what a tracker is asked about; most of them stand still in most windows.
    importance = torch.where(has_moved(truth), _MOVED_WEIGHT, 1.0)
    weight = mask * importance * torch.where(roll.visible, 1.0, _OCCLUDED_WEIGHT)
    zero = free.uv.sum() * 0
    heat = joint = zero
    if roll.slots is None:
        px = (free.uv - roll.truth_uv).norm(dim=-1) * network.config.encoder.image_size
        heat = losses.heatmap_loss(free.logits, roll.truth_uv, weight, cells=network.config.cells)
        conf = losses.confidence_loss(free.visible_logit, roll.visible, mask)
        right, judged = is_right(free.point.detach(), truth, px.detach())
        conf = conf + losses.confidence_loss(free.right_logit, right, mask & judged)
        # A map with a trunk of its own has a stage of its own.
        affordance = zero if network.config.map_layers else _affordance(network, frames, roll, truth)
        belief = network.joint(free.embedding)
        joint = losses.joint_loss(belief, roll.truth_point, truth.axis, truth.revolute, mask)
        aff = losses.coordinate_loss(taught.uv, roll.truth_uv, seen * importance)
        lifted = mask
    else:
        conf = slot_confidence_loss(roll.slots, truth, image_size=network.config.encoder.image_size)
        affordance = slot_label_loss(roll.slots, truth)
        aff = _slot_coordinates(roll.slots, truth, importance)
        # A hidden entity's pixel shows what hides it: no coordinates lift it to where the entity is.
        lifted = seen
    terms = LossTerms(
        aff=aff,
        heat=heat,
        point=losses.point_loss(taught.point, roll.truth_point, truth.unit, lifted * importance),
        vel=losses.difference_loss(taught.point, roll.truth_point, truth.unit, seen, order=1),
        acc=losses.difference_loss(taught.point, roll.truth_point, truth.unit, seen, order=2),
        conf=conf,
        bound=losses.bound_loss(taught.uv, mask),
        feat=losses.feature_loss(free.embedding, roll.asked) if free.embedding.shape[1] > 1 else zero,
        geo=losses.manifold_loss(taught.point, truth.point[:, 0], truth.axis, truth.revolute, truth.unit, seen),
        map=affordance,
        joint=joint,
    )
    return terms, roll


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
    return torch.where(lifted, right, px < CONFIDENT_PX), torch.isfinite(px)


def _affordance(network: QuestNetwork, frames: FrameBatch, roll: Rollout, truth: WindowTruth) -> Tensor:
    # The anchor frame and the newest one: the frames between differ little from them.
    ends = frames.ends()
    found = network.afford(ends, Observation.stack([roll.anchor_observed, roll.observed.during(slice(-1, None))]))
    visible = (truth.visible & truth.exists[:, None])[:, [0, -1]]
    return losses.affordance_loss(found, truth.uv[:, [0, -1]], truth.label, truth.intent, visible)


def _teach(
    network: QuestNetwork, anchor: Anchor, prediction: Prediction, observed: Observation, uv: Tensor
) -> Prediction:
    head, side = network.head, network.config.cells
    if not isinstance(head, HeatmapHead):
        raise ConfigError("only a heatmap can be refined around a cell")
    place = (uv.nan_to_num(0.5) * side).long().clamp(0, side - 1)
    row, column = prediction.peak.div(side, rounding_mode="floor"), prediction.peak % side
    near = ((row - place[..., 1]).abs() <= 1) & ((column - place[..., 0]).abs() <= 1)
    cell = torch.where(near, prediction.peak, place[..., 1] * side + place[..., 0])
    taught_uv, point = head.refine(prediction.embedding, anchor, prediction.logits, observed, cell)
    return replace(prediction, peak=cell, uv=taught_uv, point=point)


def _slot_coordinates(slots: SlotAnswers, truth: WindowTruth, importance: Float[Tensor, "B T K"]) -> Tensor:
    """L_aff of matched slots, at the anchor frame too: there the tracker chooses them."""
    inside = ((truth.uv >= 0) & (truth.uv <= 1)).all(-1)
    seen = slots.matched[:, None] & truth.visible & inside
    weight = seen * torch.cat((torch.ones_like(importance[:, :1]), importance), dim=1)
    return losses.coordinate_loss(slots.of_entities.uv, truth.uv, weight)
