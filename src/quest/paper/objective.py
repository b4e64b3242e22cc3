"""What the published network learns in stage 1: slots are matched to entities, and each match is drawn to its entity.

L = L_aff + 1.0 L_vel + 0.5 L_acc + λ_conf L_conf + λ_bound L_bound + λ_feat L_feat + λ_geo L_manifold, and the labels,
which the publication does not have. It leaves the last four weights open.

Remedies for what makes the prediction of sets slow to learn are here too, all of them off unless asked for: a fixed
order of entities in place of a match (``order``), and the losses ``exists``, ``early`` and ``where``, which weigh 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from quest.model.frames import FrameBatch
from quest.paper.matching import assign_slots, slot_cost
from quest.paper.network import PaperNetwork, SlotAnswers
from quest.train import losses
from quest.train.answers import RIGHT_PX, Answered
from quest.train.losses import Loss
from quest.train.validation import WindowScores, score_windows
from quest.train.windows import WindowSampler, WindowTruth

Order = Literal["match", "entity"]
"""How entities get their slots in training: by the least cost, as published, or entity i slot i."""


@dataclass(frozen=True)
class SlotRollout(Answered):
    """Answers of all slots on a batch of windows, and which of them are whose."""

    slots: SlotAnswers
    """Of all slots; index 0 of the time axis is the anchor frame."""
    slot: Int[Tensor, "B E"]
    """The slot of every entity; ``asked`` says which entities have one."""
    image_size: int
    """Side of the input, pixels."""

    @property
    def of_entities(self) -> SlotAnswers:
        """The answers of one slot per entity, at the anchor frame too."""
        return self.slots.of(self.slot)


def roll_out(
    network: PaperNetwork, frames: FrameBatch, truth: WindowTruth, *, whole: bool, order: Order = "match"
) -> SlotRollout:
    """Answer with all slots and match them to entities, once for all frames.

    A tracker chooses slots at the start of a clip and keeps them. So the anchor frame is answered as a clip's first
    frame is, by itself, and one match holds there and in the window.

    Args:
        network: the network.
        frames: the anchor frame and the window.
        truth: what is true of them.
        whole: match by all these frames. This is how training learns from a match that is made once per take: of two
            slots that share an entity between anchor and window, one must answer in both. Without it by the anchor
            frame alone, as a tracker would and as answers are judged.
        order: how slots are given away.
    """
    slots = network(frames.during(slice(0, 1))).then(network(frames.during(slice(1, None))))
    seen = truth.visible & truth.exists[:, None] & torch.isfinite(truth.uv).all(-1)
    if not whole:
        seen = torch.cat((seen[:, :1], torch.zeros_like(seen[:, 1:])), dim=1)
    wanted = seen.any(dim=1)
    if order == "entity":
        slot = torch.arange(wanted.shape[1], device=wanted.device).expand_as(wanted)
        matched = wanted & (slot < network.config.slots)
        slot = torch.where(matched, slot, 0)
    else:
        with torch.no_grad():
            label = truth.label[:, None, None].expand(*slots.label_logits.shape[:3], -1)
            probability = slots.logit.sigmoid().unsqueeze(-1) * slots.label_logits.softmax(-1).gather(-1, label)
            slot, matched = assign_slots(slot_cost(slots.uv, probability, truth.uv, seen), wanted)
    own = slots.of(slot)
    return SlotRollout(
        embedding=own.embedding[:, 1:],
        uv=own.uv[:, 1:],
        point=own.point[:, 1:],
        asked=matched,
        truth=truth,
        slots=slots,
        slot=slot,
        image_size=network.config.encoder.image_size,
    )


def _weight(r: SlotRollout) -> Float[Tensor, "B S E"]:
    """What each place of a matched slot counts, at the anchor frame too: there the tracker chooses them."""
    inside = ((r.truth.uv >= 0) & (r.truth.uv <= 1)).all(-1)
    seen = r.asked[:, None] & r.truth.visible & inside
    return seen * torch.cat((torch.ones_like(r.importance[:, :1]), r.importance), dim=1)


def coordinate_loss(r: SlotRollout) -> Float[Tensor, ""]:
    """L_aff of matched slots."""
    return losses.coordinate_loss(r.of_entities.uv, r.truth.uv, _weight(r))


def early_loss(r: SlotRollout) -> Float[Tensor, ""]:
    """L_aff of what all but the last layer would answer."""
    uv = r.of_entities.earlier_uv.movedim(-2, 0)
    return losses.coordinate_loss(uv, r.truth.uv.expand_as(uv), _weight(r).expand(uv.shape[:-1]))


def where_loss(r: SlotRollout) -> Float[Tensor, ""]:
    """Cross-entropy of where matched slots look last: at the token in which their entity is."""
    log_p, weight = (r.of_entities.where + 1e-6).log(), _weight(r)
    side = math.isqrt(log_p.shape[-1])
    cell = (r.truth.uv.nan_to_num() * side).long().clamp(0, side - 1)
    token = (cell[..., 1] * side + cell[..., 0]).unsqueeze(-1)
    return losses.masked_mean(-log_p.gather(-1, token).squeeze(-1), weight)


def slot_confidence_loss(r: SlotRollout) -> Float[Tensor, ""]:
    """L_conf of all slots: "seen and within 8 px" for those that are matched, "no entity" for the others.

    All count alike: there are a few more slots than entities, not a hundred, and a confidence above one half is to
    mean that there more often is an entity than not.
    """
    chosen = r.of_entities
    near = (chosen.uv.detach() - r.truth.uv).norm(dim=-1) * r.image_size < RIGHT_PX
    return _confidence(r, near)


def exists_loss(r: SlotRollout) -> Float[Tensor, ""]:
    """As L_conf, but a matched slot is told "seen" however far it is off."""
    return _confidence(r, torch.ones_like(r.truth.visible))


def _confidence(r: SlotRollout, worthy: Bool[Tensor, "B S E"]) -> Float[Tensor, ""]:
    logit = r.slots.logit
    worth = (worthy & r.truth.visible & r.asked[:, None]).to(logit.dtype)
    # Entities without a slot point to slot 0, which must not be told that it is nobody's.
    index = r.slot[:, None].expand(-1, logit.shape[1], -1)
    target = torch.zeros_like(logit).scatter_reduce(2, index, worth, "amax") > 0.5
    return losses.confidence_loss(logit, target, torch.ones_like(target))


def slot_label_loss(r: SlotRollout) -> Float[Tensor, ""]:
    """Cross-entropy of the labels of matched slots, in the frames in which their entities are seen."""
    log_p = r.of_entities.label_logits.log_softmax(-1)
    label = r.truth.label[:, None].expand(log_p.shape[:3]).unsqueeze(-1)
    return losses.masked_mean(-log_p.gather(-1, label).squeeze(-1), r.truth.visible & r.asked[:, None])


# A hidden entity's pixel shows what hides it, so losses of lifted points ask for entities that are seen.
LOSSES: dict[str, Loss[SlotRollout]] = {
    "aff": Loss(1.0, coordinate_loss),
    "vel": Loss(1.0, lambda r: losses.difference_loss(r.point, r.truth_point, r.truth.unit, r.seen, order=1)),
    "acc": Loss(0.5, lambda r: losses.difference_loss(r.point, r.truth_point, r.truth.unit, r.seen, order=2)),
    "conf": Loss(0.3, slot_confidence_loss),
    "bound": Loss(0.1, lambda r: losses.bound_loss(r.uv, r.mask)),
    "feat": Loss(0.02, lambda r: losses.feature_loss(r.embedding, r.asked)),
    "geo": Loss(
        0.2,
        lambda r: losses.manifold_loss(
            r.point, r.truth.point[:, 0], r.truth.axis, r.truth.revolute, r.truth.unit, r.seen
        ),
    ),
    "label": Loss(1.0, slot_label_loss),
    "exists": Loss(0.0, exists_loss),
    "early": Loss(0.0, early_loss),
    "where": Loss(0.0, where_loss),
}


class PaperStageOne:
    """Stage 1 of the published network, for :func:`quest.train.loop.fit`.

    ``changes`` are weights of losses that are to differ; 0 turns one off. A flow head stays as it is.
    """

    name = "paper-stage-1"

    def __init__(
        self, network: PaperNetwork, changes: Mapping[str, float] | None = None, *, order: Order = "match"
    ) -> None:
        self.network = network
        self._order: Order = order
        self.weights = losses.weights_of(LOSSES, changes or {})

    def trained(self) -> list[nn.Parameter]:
        """All parameters outside the encoder and the flow head."""
        return self.network.trainable()

    def refined(self) -> list[nn.Parameter]:
        """None: the encoder stays as it is."""
        return []

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> dict[str, Float[Tensor, ""]]:
        """Every loss, unweighted."""
        answered = roll_out(self.network, frames, truth, whole=True, order=self._order)
        return {name: loss.of(answered) for name, loss in LOSSES.items()}

    def answered(self, frames: FrameBatch, truth: WindowTruth) -> Answered:
        """What entities are answered, as a tracker would."""
        return roll_out(self.network, frames, truth, whole=False)

    def validate(self, sampler: WindowSampler, *, batches: int, device: torch.device) -> WindowScores:
        """Distance and identity on fixed windows."""
        return score_windows(self.network, self.answered, sampler, batches=batches, device=device)
