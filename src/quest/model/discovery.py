"""Discovery: peaks of the dense affordance map, which seed the slots."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from quest.model.network import UNKNOWN_INTENT, QuestNetwork
from quest.model.observation import FrameBatch, Observation, cell_centres

FOUND_PX = 16.0
"""A candidate this close to an entity of its label has found it, pixels of the network's input."""

_PURPOSES_APART_PX = 3.0


@dataclass(frozen=True)
class Peaks:
    """Candidates for entities, best first.

    Attributes:
        uv: coordinates in [0, 1]^2 of the network's input.
        label: index into LABELS.
        logit: score of the affordance map.
        intent: index into INTENTS, or UNKNOWN_INTENT if the network does not know.
    """

    uv: Float[Tensor, "K 2"]
    label: Int[Tensor, " K"]
    logit: Float[Tensor, " K"]
    intent: Int[Tensor, " K"]


def find_peaks(network: QuestNetwork, frames: FrameBatch, observed: Observation, *, radius_cells: float) -> Peaks:
    """Peaks of one frame (B = 1, T = 1), at most as many as the network has slots.

    A peak is the best of its 3 x 3 cells, label and intent; of peaks closer than ``radius_cells`` the best stays. The
    same label for another intent may come closer: the rims of a closed laptop are two things.
    """
    side, cell = network.config.cells, network.config.cell_px
    found = network.afford(frames, observed)
    purposes = found.logits.shape[-1]
    scores = found.logits[0, 0].flatten(1).T.reshape(-1, side, side)
    is_peak = scores == F.max_pool2d(scores.unsqueeze(0), 3, 1, 1).squeeze(0)
    flat = torch.where(is_peak, scores, -torch.inf).flatten()
    value, index = flat.topk(min(4 * network.config.slots, int(is_peak.sum())))
    channel, place = index.div(side * side, rounding_mode="floor"), index % (side * side)
    label, purpose = channel.div(purposes, rounding_mode="floor"), channel % purposes
    uv_px = cell_centres(network.config, device=place.device)[place] + cell * found.offset[0, 0][place, purpose]
    other_purpose = (label[:, None] == label) & (purpose[:, None] != purpose)
    apart_px = torch.where(other_purpose, _PURPOSES_APART_PX, radius_cells * cell)
    clash = torch.cdist(uv_px, uv_px) < apart_px
    keep: list[int] = []
    for i in range(len(value)):
        if len(keep) < network.config.slots and not bool(clash[i, keep].any()):
            keep.append(i)
    uv = (uv_px / network.config.encoder.image_size).clamp(0, 1)
    intent = purpose if purposes > 1 else torch.full_like(purpose, UNKNOWN_INTENT)
    return Peaks(uv[keep], label[keep], value[keep], intent[keep])


def match_peaks(
    uv_px: Float[Tensor, "K 2"],
    label: Int[Tensor, " K"],
    true_px: Float[Tensor, "E 2"],
    true_label: Int[Tensor, " E"],
) -> Int[Tensor, " K"]:
    """Which entity each candidate is right about: the nearest free one of its label within :data:`FOUND_PX`, else -1.

    Args:
        uv_px: candidates, best first, pixels of the network's input.
        label: their labels.
        true_px: entities that are seen.
        true_label: their labels.
    """
    gap = torch.cdist(uv_px.float(), true_px.float())
    gap = torch.where((label[:, None] == true_label) & (gap < FOUND_PX), gap, torch.inf)
    found = torch.full_like(label, -1)
    for k in range(len(label) if len(true_label) else 0):
        e = int(gap[k].argmin())
        if torch.isfinite(gap[k, e]):
            found[k] = e
            gap[:, e] = torch.inf
    return found
