"""Tracking with learned queries, as published: every frame's window is decoded anew, and slots keep what they took.

A slot's answer is the lifted pixel of its coordinates. What it is called is decided in the frame in which it is taken:
whether there is an entity by its confidence, which label it has by its embedding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from quest.model.decoder import Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.model.slots import assign_slots, slot_cost
from quest.track.following import Following
from quest.track.placing import Placed, as_array
from quest.track.settings import TrackerConfig
from quest.types import LABELS


@dataclass(frozen=True)
class Slots:
    """What all slots say of the newest frame."""

    prediction: Prediction
    """Their answers (B = T = 1)."""
    label_p: Float[Tensor, "Q L"]
    """Probability of every label."""

    def existence(self, config: TrackerConfig) -> list[float]:
        """Probability that each holds an entity."""
        logit = self.prediction.right_logit[0, 0]
        return (config.slot_gain * (logit + config.slot_bias)).sigmoid().tolist()

    @property
    def label(self) -> list[str]:
        """What each takes its entity for."""
        return [LABELS[int(n)] for n in self.label_p.argmax(dim=-1)]


def decode_slots(network: QuestNetwork, window: Observation, frames: FrameBatch) -> Slots:
    """The slots' answers for the newest frame, which they see in its window.

    Args:
        network: a network with learned queries.
        window: the newest frames, at most T (B = 1).
        frames: the newest frame.
    """
    slots = network.slots(1)
    x = network.embed(slots, window)[:, -1:]
    prediction = network.answer(x, slots, window.during(slice(-1, None)), frames)
    return Slots(prediction, network.labels(prediction)[0, 0].softmax(dim=-1))


def slots_at(
    slots: Slots, uv: Float[Tensor, "K 2"], labels: Sequence[str | None], following: Sequence[Following]
) -> list[int]:
    """The slots that answer for points, at the cost that training matches them by; no two share one.

    Slots that answer for something already are taken again where there are not enough others, and so are slots of
    the same frame where there are fewer than points.

    Args:
        slots: what they say of the frame.
        uv: the points, in [0, 1]^2 of the input.
        labels: their labels, where they are told.
        following: queries that have found their entity.
    """
    p = slots.prediction
    exists, told = p.right_logit[0, 0].sigmoid(), [None if name is None else LABELS.index(name) for name in labels]
    alike = torch.stack([torch.ones_like(exists) if n is None else slots.label_p[:, n] for n in told], dim=-1)
    wanted = torch.ones(1, len(uv), dtype=torch.bool, device=p.uv.device)
    target = uv.to(p.uv)[None, None]
    cost = slot_cost(p.uv, (exists[:, None] * alike)[None, None], target, wanted[:, None])
    used = sorted({f.slot for f in following if f.slot is not None})
    # More than all that is free can cost together, so that what is taken comes last.
    cost[..., used] += 2 * len(uv) * (1 + float(cost.abs().max()))
    slot, found = assign_slots(cost, wanted)
    return torch.where(found, slot, cost.argmin(dim=-1))[0].tolist()


def place_slots(
    slots: Slots, following: Sequence[Following], *, has_depth: bool
) -> tuple[Float[Tensor, "K 2"], Placed, Float[np.ndarray, " K"]]:
    """Where the queries are.

    Where the frame has depth, but not at a slot's pixel, its last point is held and it does not count as seen.

    Args:
        slots: what they say of the frame.
        following: the queries, which remember where they are.
        has_depth: whether the frame has any depth.

    Returns:
        Coordinates at which the slots see them, their places, and the slots' confidence.
    """
    index = [f.slot for f in following if f.slot is not None]
    assert len(index) == len(following)
    p = slots.prediction
    point = as_array(p.point[0, 0, index])
    seen, right = (as_array(logit[0, 0, index].sigmoid()) for logit in (p.visible_logit, p.right_logit))
    held = np.zeros(len(index), bool)
    for k, query in enumerate(following):
        if np.isfinite(point[k]).all():
            query.place = point[k].copy()
        elif query.place is not None and has_depth:
            point[k], held[k] = query.place, True
        query.held = bool(held[k])
    unknown, no = np.full(len(index), np.nan), np.zeros(len(index), bool)
    placed = Placed(point, point, np.where(held, 0.0, seen), held, no, unknown, unknown)
    return p.uv[0, 0, index], placed, right
