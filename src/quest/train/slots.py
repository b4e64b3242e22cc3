"""What learned queries answer on a batch of windows: which slot is whose, and what the others must say."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.model.decoder import Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.model.slots import assign_slots, slot_cost
from quest.train import losses
from quest.train.windows import WindowTruth

CONFIDENT_PX = 8.0
"""An answer this near to a seen entity is worth confidence, pixels of the input."""


@dataclass(frozen=True)
class SlotAnswers:
    """Answers of all slots at the anchor frame and in the window, and which of them are whose.

    Attributes:
        prediction: answers of all slots; index 0 of the time axis is the anchor frame.
        label_logits: what each slot takes its entity for.
        slot: the slot of every entity.
        matched: entities that have one.
    """

    prediction: Prediction
    label_logits: Float[Tensor, "B S Q L"]
    slot: Int[Tensor, "B K"]
    matched: Bool[Tensor, "B K"]

    @property
    def of_entities(self) -> Prediction:
        """The answers of one slot per entity."""
        values = {f.name: _gather(getattr(self.prediction, f.name), self.slot) for f in fields(Prediction)}
        return Prediction(**values)


def answer_slots(
    network: QuestNetwork, observed: Observation, frames: FrameBatch, truth: WindowTruth, *, whole: bool
) -> SlotAnswers:
    """Answer with all slots and match them to entities, once for all frames.

    A tracker chooses slots at the start of a take and keeps them. So the anchor frame is answered as a stream's first
    frame is, by itself, and one match holds there and in the window.

    Args:
        network: a network with learned queries.
        observed: the anchor frame and the window.
        frames: the same frames.
        truth: what is true of them.
        whole: match by all these frames, those of the window too. This is how training learns from a match that is
            made once per take: of two slots that share an entity between anchor and window, one must answer in both.
            Without it by the anchor frame alone, as a tracker would and as answers are judged.
    """
    slots, first, window = network.slots(len(truth.unit)), slice(0, 1), slice(1, None)
    parts = [network.decode(slots, observed.during(t), frames.during(t)) for t in (first, window)]
    joined = {f.name: torch.cat([getattr(p, f.name) for p in parts], dim=1) for f in fields(Prediction)}
    prediction = Prediction(**joined)
    label_logits = network.labels(prediction)
    seen = truth.visible & truth.exists[:, None] & torch.isfinite(truth.uv).all(-1)
    if not whole:
        seen = torch.cat((seen[:, first], torch.zeros_like(seen[:, window])), dim=1)
    with torch.no_grad():
        label = truth.label[:, None, None].expand(*label_logits.shape[:3], -1)
        probability = prediction.right_logit.sigmoid().unsqueeze(-1) * label_logits.softmax(-1).gather(-1, label)
        cost = slot_cost(prediction.uv, probability, truth.uv, seen)
        slot, matched = assign_slots(cost, seen.any(dim=1))
    return SlotAnswers(prediction, label_logits, slot, matched)


def slot_confidence_loss(answers: SlotAnswers, truth: WindowTruth, *, image_size: int) -> Float[Tensor, ""]:
    """L_conf of all slots: "seen and within 8 px" for those that are matched, "no entity" for the others.

    All count alike: there are a few more slots than entities, not a hundred, and a confidence above one half is to
    mean that there more often is an entity than not.

    Args:
        answers: of all slots.
        truth: what is true of the frames.
        image_size: side of the input, pixels.
    """
    chosen, logit = answers.of_entities, answers.prediction.right_logit
    near = (chosen.uv.detach() - truth.uv).norm(dim=-1) * image_size < CONFIDENT_PX
    worth = (near & truth.visible & answers.matched[:, None]).to(logit.dtype)
    # Entities without a slot point to slot 0, which must not be told that it is nobody's.
    index = answers.slot[:, None].expand(-1, logit.shape[1], -1)
    target = torch.zeros_like(logit).scatter_reduce(2, index, worth, "amax") > 0.5
    return losses.confidence_loss(logit, target, torch.ones_like(target))


def slot_label_loss(answers: SlotAnswers, truth: WindowTruth) -> Float[Tensor, ""]:
    """Cross-entropy of the labels of matched slots, in the frames in which their entities are seen."""
    logits = _gather(answers.label_logits, answers.slot)
    label = truth.label[:, None].expand(logits.shape[:3])
    return losses.label_loss(logits, label, truth.visible & answers.matched[:, None])


def at_window(prediction: Prediction) -> Prediction:
    """The same without the anchor frame."""
    return replace(prediction, **{f.name: getattr(prediction, f.name)[:, 1:] for f in fields(Prediction)})


def _gather(value: Tensor, slot: Int[Tensor, "B K"]) -> Tensor:
    index = slot[:, None].expand(-1, value.shape[1], -1)
    if value.ndim == 4:
        index = index.unsqueeze(-1).expand(-1, -1, -1, value.shape[-1])
    return value.gather(2, index)
