"""From a batch of windows to the losses of stage 1, for anchored and for learned queries."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from quest.errors import ConfigError
from quest.model.decoder import Anchor, HeatmapHead, Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.train import losses
from quest.train.settings import LossWeights
from quest.train.windows import WindowTruth

_OCCLUDED_WEIGHT = 0.3
_MOVED_WEIGHT = 3.0
_RIGHT_DISTANCE = 0.1
_CONFIDENT_PX = 8.0


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
        anchor: what the queries are bound to.
        content: the query that answers for each entity, before the decoder.
    """

    prediction: Prediction
    taught: Prediction
    truth_uv: Float[Tensor, "B T K 2"]
    truth_point: Float[Tensor, "B T K 3"]
    visible: Bool[Tensor, "B T K"]
    mask: Bool[Tensor, "B T K"]
    observed: Observation
    anchor_observed: Observation
    anchor: Anchor
    content: Float[Tensor, "B K D"]


def roll_out(network: QuestNetwork, frames: FrameBatch, truth: WindowTruth) -> Rollout:
    """Bind at the anchor frame (index 0) and answer the frames after it."""
    observed = network.observe(frames)
    first, window = observed.during(slice(0, 1)), observed.during(slice(1, None))
    rest = frames.during(slice(1, None))
    uv, point, visible = truth.uv[:, 1:], truth.point[:, 1:], truth.visible[:, 1:]
    if network.config.queries == "anchored":
        anchor = bind_at(network, frames, first, truth.anchor_uv, truth.told, truth.bound)
        prediction = network.decode(anchor, window, rest)
        taught = _teach(network, anchor, prediction, window, uv)
        mask = truth.bound[:, None].expand_as(visible)
        content = anchor.content
    else:
        anchor = network.slots(len(truth.unit))
        prediction = taught = network.decode(anchor, window, rest)
        with torch.no_grad():
            at_first = network.decode(anchor, first, frames.during(slice(0, 1)))
            slot, matched = match_slots(at_first.uv[:, 0], truth.uv[:, 0], truth.bound)
        prediction = taught = _select(prediction, slot)
        content = anchor.content.gather(1, slot.unsqueeze(-1).expand(-1, -1, anchor.content.shape[-1]))
        mask = matched[:, None].expand_as(visible)
    inside = ((uv >= 0) & (uv <= 1)).all(-1)
    return Rollout(prediction, taught, uv, point, visible, mask & inside, window, first, anchor, content)


def bind_at(
    network: QuestNetwork,
    frames: FrameBatch,
    observed: Observation,
    uv: Float[Tensor, "B K 2"],
    label: Int[Tensor, "B K"],
    valid: Bool[Tensor, "B K"],
) -> Anchor:
    """Bind queries to pixels of the first frame of a batch; their 3D points come from its depth."""
    first = frames.during(slice(0, 1))
    uv_px = uv.unsqueeze(1) * network.config.encoder.image_size
    point = first.to_reference(uv_px, first.near_depth_at(uv_px)).squeeze(1)
    return network.bind(observed, uv, point, label, valid)


def match_slots(
    uv: Float[Tensor, "B Q 2"], target: Float[Tensor, "B K 2"], wanted: Bool[Tensor, "B K"]
) -> tuple[Int[Tensor, "B K"], Bool[Tensor, "B K"]]:
    """Assign slots to entities by least total distance (Hungarian), once for all frames of a window."""
    slot = torch.zeros(wanted.shape, dtype=torch.long)
    matched = torch.zeros_like(wanted)
    distance = torch.cdist(target.nan_to_num(), uv).cpu().numpy()
    for b in range(len(wanted)):
        entities = np.flatnonzero(wanted[b].cpu().numpy())
        rows, columns = linear_sum_assignment(distance[b, entities])
        slot[b, entities[rows]] = torch.from_numpy(columns)
        matched[b, entities[rows]] = True
    return slot.to(uv.device), matched


def stage_one(network: QuestNetwork, frames: FrameBatch, truth: WindowTruth) -> tuple[LossTerms, Rollout]:
    """All losses of stage 1 on one batch."""
    roll = roll_out(network, frames, truth)
    free, taught, mask = roll.prediction, roll.taught, roll.mask
    seen = mask & roll.visible
    # An entity that moved is what a tracker is asked about; most of them stand still in most windows.
    importance = torch.where(has_moved(truth), _MOVED_WEIGHT, 1.0)
    weight = mask * importance * torch.where(roll.visible, 1.0, _OCCLUDED_WEIGHT)
    zero = free.uv.sum() * 0
    px = (free.uv - roll.truth_uv).norm(dim=-1) * network.config.encoder.image_size
    heat = affordance = joint = zero
    if network.config.head == "heatmap":
        heat = losses.heatmap_loss(free.logits, roll.truth_uv, weight, cells=network.config.cells)
        conf = losses.confidence_loss(free.visible_logit, roll.visible, mask)
        right, judged = is_right(free.point.detach(), truth, px.detach())
        conf = conf + losses.confidence_loss(free.right_logit, right, mask & judged)
        affordance = _affordance(network, roll, truth)
        belief = network.joint(free.embedding)
        joint = losses.joint_loss(belief, roll.truth_point, truth.axis, truth.revolute, mask)
    else:
        conf = losses.confidence_loss(free.right_logit, roll.visible & (px.detach() < _CONFIDENT_PX), mask)
        affordance = losses.label_loss(network.learned_label(roll.content), truth.label, mask[:, 0])
    terms = LossTerms(
        aff=losses.coordinate_loss(taught.uv, roll.truth_uv, seen * importance),
        heat=heat,
        point=losses.point_loss(taught.point, roll.truth_point, truth.unit, mask * importance),
        vel=losses.difference_loss(taught.point, roll.truth_point, truth.unit, seen, order=1),
        acc=losses.difference_loss(taught.point, roll.truth_point, truth.unit, seen, order=2),
        conf=conf,
        bound=losses.bound_loss(taught.uv, mask),
        feat=losses.feature_loss(free.embedding, truth.bound) if free.embedding.shape[1] > 1 else zero,
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
    return torch.where(lifted, right, px < _CONFIDENT_PX), torch.isfinite(px)


def _affordance(network: QuestNetwork, roll: Rollout, truth: WindowTruth) -> Tensor:
    # The anchor frame and the newest one: the frames between differ little from them.
    fine = torch.cat((roll.anchor_observed.fine, roll.observed.fine[:, -1:]), dim=1)
    logits, offset = network.affordance(fine)
    uv = truth.uv[:, [0, -1]].flatten(0, 1)
    visible = (truth.visible & truth.exists[:, None])[:, [0, -1]].flatten(0, 1)
    label = truth.label.repeat_interleave(2, dim=0)
    return losses.affordance_loss(
        logits.flatten(0, 1), offset.flatten(0, 1), uv, label, visible, cells=network.config.cells
    )


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


def _select(prediction: Prediction, slot: Int[Tensor, "B K"]) -> Prediction:
    """The answers of one slot per entity."""
    values = {}
    for f in fields(prediction):
        value = getattr(prediction, f.name)
        index = slot[:, None].expand(-1, value.shape[1], -1)
        if value.ndim == 4:
            index = index.unsqueeze(-1).expand(-1, -1, -1, value.shape[-1])
        values[f.name] = value.gather(2, index)
    return Prediction(**values)
