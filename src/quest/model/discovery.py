"""Discovery: peaks of the dense affordance map, and pieces that stand out of planes, which seed the slots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.model.affordance import AffordanceMap
from quest.model.network import UNKNOWN_INTENT, QuestNetwork
from quest.model.observation import FrameBatch, Observation, cell_centres
from quest.model.pieces import PIECES_APART_PX, Pieces, find_pieces, groups, may_be_piece
from quest.types import GRIPS, LABELS

FOUND_WITHIN = 0.1
"""A candidate this close to an entity of its label has found it, normalised units: the gate of protocol semantic."""

RADIUS_CELLS = 1.5
"""How far peaks of one label are apart, unless a tracker's settings say otherwise."""

_PURPOSES_APART_PX = 3.0

_ALIKE = 1.0
"""Cells along a rim whose logit is at most so much below the best one's are a part of it ..."""
_VOTES_WITHIN_PX = 12.0
"""... if they point so near to where the best one points."""


@dataclass(frozen=True)
class Peaks:
    """Candidates for entities, best first."""

    uv: Float[Tensor, "K 2"]
    """Coordinates in [0, 1]^2 of the network's input."""
    point_m: Float[Tensor, "K 3"]
    """What is seen there, lifted by the nearest depth around: camera axes, metres; NaN without depth."""
    label: Int[Tensor, " K"]
    """Index into LABELS."""
    logit: Float[Tensor, " K"]
    """Score of the affordance map; log odds of being right where the network ranks pieces."""
    intent: Int[Tensor, " K"]
    """Index into INTENTS, or UNKNOWN_INTENT if the network does not know."""

    def __len__(self) -> int:
        return len(self.label)

    def select(self, index: Sequence[int]) -> Peaks:
        """Some of them."""
        return Peaks(*(getattr(self, f.name)[list(index)] for f in fields(self)))


@dataclass(frozen=True)
class Candidates:
    """All peaks of a frame, of which those of one label that are too close to each other cannot all be entities."""

    peaks: Peaks
    """The peaks, best first."""
    clash: Bool[Tensor, "K K"]
    """Which are too close to each other, whatever their labels."""

    def apart(self, among: Sequence[int] | None = None) -> list[int]:
        """Of peaks of one label that are too close to each other the best alone.

        Where it cannot be told what something is, it stays under each label: as the front of a drawer and the handle
        in its middle, say, of which only one may be there.

        Args:
            among: indices of the peaks that count, best first; all by default.
        """
        clash = self.clash & (self.peaks.label[:, None] == self.peaks.label)
        keep: list[int] = []
        for i in range(len(self.peaks)) if among is None else among:
            if not bool(clash[i, keep].any()):
                keep.append(i)
        return keep


@dataclass(frozen=True)
class Sighted:
    """What a frame has to choose from, before it is ranked."""

    peaks: Candidates
    """Of the affordance map, with its scores."""
    pieces: Pieces
    """What stands out of planes."""
    on_piece: Bool[Tensor, "K P"]
    """Which peaks of handles and knobs are on which piece."""
    group: Int[Tensor, " K"]
    """Of each peak, see :func:`quest.model.pieces.groups`."""


def find_candidates(
    network: QuestNetwork, frames: FrameBatch, observed: Observation | None, *, radius_cells: float, mirror: bool = True
) -> Candidates:
    """What may be an entity in one frame (B = 1, T = 1): peaks of the map, and pieces if the network ranks them.

    A peak is the best of its 3 x 3 cells, label and intent, and lies where its cell points to; a rim, along which
    neighbouring places look alike, where the best cells around point to in the mean. Peaks clash that are closer than
    ``radius_cells``. The same label for another intent may come closer, a rim as close as it likes: those of a closed
    laptop are two things. A piece lies in its own middle, once for every label that it may have; handles and knobs on
    it clash with it however far they are from there.

    Args:
        network: whose map is read.
        frames: the frame.
        observed: the frame as observed, or None (see :meth:`QuestNetwork.afford`).
        radius_cells: how far peaks are apart.
        mirror: whether the map is the mean of the frame's and of its mirror image's, which finds more and costs the
            encoding of another image.
    """
    if network.affordance_pieces is None:
        return _peaks(network, frames, _map(network, frames, observed, mirror=mirror), radius_cells=radius_cells)
    sighted = sight(network, frames, observed, radius_cells=radius_cells, mirror=mirror)
    return _ranked(network, frames, sighted, radius_px=radius_cells * network.config.cell_px)


def sight(
    network: QuestNetwork, frames: FrameBatch, observed: Observation | None, *, radius_cells: float, mirror: bool = True
) -> Sighted:
    """Peaks and pieces of one frame; the arguments are those of :func:`find_candidates`."""
    found = _map(network, frames, observed, mirror=mirror)
    peaks = _peaks(network, frames, found, radius_cells=radius_cells)
    side = network.config.cells
    pieces = find_pieces(frames, found.logits[0, 0].permute(1, 2, 0).unflatten(-1, (side, side)), network.config)
    uv_px, label = peaks.peaks.uv * network.config.encoder.image_size, peaks.peaks.label
    on_piece = pieces.under(uv_px).to(label.device) & may_be_piece(label)[:, None]
    return Sighted(peaks, pieces, on_piece, groups(frames, uv_px, label, on_piece.any(dim=1)))


def _map(network: QuestNetwork, frames: FrameBatch, observed: Observation | None, *, mirror: bool) -> AffordanceMap:
    found = network.afford(frames, observed)
    if not mirror:
        return found
    return found.mean(network.afford(_mirrored(network, frames)).mirrored())


def _peaks(network: QuestNetwork, frames: FrameBatch, found: AffordanceMap, *, radius_cells: float) -> Candidates:
    side, cell = network.config.cells, network.config.cell_px
    purposes = found.logits.shape[-1]
    scores = found.logits[0, 0].flatten(1).T.reshape(-1, side, side)
    is_peak = scores == F.max_pool2d(scores.unsqueeze(0), 3, 1, 1).squeeze(0)
    flat = torch.where(is_peak, scores, -torch.inf).flatten()
    value, index = flat.topk(min(4 * network.config.slots, int(is_peak.sum())))
    channel, place = index.div(side * side, rounding_mode="floor"), index % (side * side)
    label, purpose = channel.div(purposes, rounding_mode="floor"), channel % purposes
    pointed = cell_centres(network.config, device=place.device)[:, None] + cell * found.offset[0, 0]
    uv_px = pointed[place, purpose]
    rim = torch.nonzero(label == LABELS.index("rim"))[:, 0]
    votes, likeness = pointed[:, purpose[rim]].transpose(0, 1), scores.flatten(1)[channel[rim]] - value[rim, None]
    uv_px[rim] = _agreed(uv_px[rim], votes, likeness)
    other_purpose = (label[:, None] == label) & (purpose[:, None] != purpose)
    apart_px = torch.where(other_purpose, _PURPOSES_APART_PX, radius_cells * cell)
    apart_px[rim] = torch.where(other_purpose[rim], 0.0, apart_px[rim])
    clash = torch.cdist(uv_px, uv_px) < apart_px
    intent = purpose if purposes > 1 else torch.full_like(purpose, UNKNOWN_INTENT)
    return Candidates(_lifted(network, frames, uv_px, label, value, intent), clash)


def _lifted(
    network: QuestNetwork,
    frames: FrameBatch,
    uv_px: Float[Tensor, "K 2"],
    label: Int[Tensor, " K"],
    logit: Float[Tensor, " K"],
    intent: Int[Tensor, " K"],
) -> Peaks:
    size = network.config.encoder.image_size
    uv_px = uv_px.clamp(0, size)
    return Peaks(uv_px / size, frames.to_camera(frames.near_point_at(uv_px[None, None]))[0, 0], label, logit, intent)


def _ranked(network: QuestNetwork, frames: FrameBatch, sighted: Sighted, *, radius_px: float) -> Candidates:
    """Peaks and pieces by their log odds of being right."""
    head = network.affordance_pieces
    assert head is not None
    peaks, pieces, size = sighted.peaks.peaks, sighted.pieces, network.config.encoder.image_size
    device, kinds, count = peaks.uv.device, len(GRIPS), len(sighted.pieces.shapes)
    label = torch.tensor([LABELS.index(name) for name in GRIPS], device=device).repeat(count)
    purpose = pieces.purpose.flatten().to(device)
    intent = purpose if network.config.intents else torch.full_like(purpose, UNKNOWN_INTENT)
    logit = head(pieces.inputs.to(device)).flatten()
    uv_px = pieces.uv_px.to(device).repeat_interleave(kinds, dim=0)
    stand_out = _lifted(network, frames, uv_px, label, logit, intent)
    trusted = replace(peaks, logit=head.trust(peaks.logit.float(), sighted.group))
    between = torch.cdist(peaks.uv * size, uv_px) < radius_px
    between |= sighted.on_piece.repeat_interleave(kinds, dim=1)
    among = torch.cdist(uv_px, uv_px) < PIECES_APART_PX
    clash = torch.cat((torch.cat((sighted.peaks.clash, between), 1), torch.cat((between.T, among), 1)))
    every = Peaks(*(torch.cat((getattr(trusted, f.name), getattr(stand_out, f.name))) for f in fields(Peaks)))
    order = every.logit.argsort(descending=True, stable=True)
    return Candidates(every.select(order.tolist()), clash[order][:, order])


def find_peaks(
    network: QuestNetwork, frames: FrameBatch, observed: Observation | None, *, radius_cells: float, mirror: bool = True
) -> Peaks:
    """Those of :func:`find_candidates` that are apart, at most as many as the network has slots."""
    found = find_candidates(network, frames, observed, radius_cells=radius_cells, mirror=mirror)
    return found.peaks.select(found.apart()[: network.config.slots])


def _agreed(
    uv_px: Float[Tensor, "R 2"], votes: Float[Tensor, "R C 2"], likeness: Float[Tensor, "R C"]
) -> Float[Tensor, "R 2"]:
    """The mean of where cells like a peak's point to, near where its own does.

    Args:
        uv_px: where each peak's cell points to.
        votes: where all cells point to.
        likeness: their logits less the peak's.
    """
    near = (votes - uv_px[:, None]).norm(dim=-1) < _VOTES_WITHIN_PX
    agree = (near & (likeness > -_ALIKE)).unsqueeze(-1)
    return (votes * agree).sum(dim=1) / agree.sum(dim=1)


def _mirrored(network: QuestNetwork, frames: FrameBatch) -> FrameBatch:
    """The frames as a camera would see them whose world is mirrored left to right."""
    rgb = frames.rgb.flip(-2)
    fx, fy, cx, cy = frames.intrinsics.unbind(-1)
    flip = frames.center.new_tensor([-1.0, 1.0, 1.0, 1.0])
    return FrameBatch(
        features=network.encode(rgb.flatten(0, 1)).float().unflatten(0, rgb.shape[:2]),
        rgb=rgb,
        depth_m=frames.depth_m.flip(-1),
        cell_depth_m=frames.cell_depth_m.flip(-1),
        intrinsics=torch.stack((fx, fy, network.config.encoder.image_size - cx, cy), dim=-1),
        ref_from_cam=flip[:, None] * frames.ref_from_cam * flip,  # no matrix product: it would be in bfloat16
        center=frames.center * flip[:3],
        scale=frames.scale,
    )


def match_peaks(
    point_m: Float[Tensor, "K 3"],
    label: Int[Tensor, " K"],
    true_point_m: Float[Tensor, "E 3"],
    true_label: Int[Tensor, " E"],
    *,
    half_diagonal_m: float,
) -> Int[Tensor, " K"]:
    """Which entity each candidate is right about: the nearest free one of its label within 0.1, else -1.

    Args:
        point_m: candidates, best first, metres; NaN is right about nothing.
        label: their labels.
        true_point_m: entities that are seen, in the same axes.
        true_label: their labels.
        half_diagonal_m: metres per normalised unit.
    """
    gap = torch.cdist(point_m.float(), true_point_m.float()) / half_diagonal_m
    gap = torch.where((label[:, None] == true_label) & (gap < FOUND_WITHIN), gap, torch.inf)
    found = torch.full_like(label, -1)
    for k in range(len(label) if len(true_label) else 0):
        e = int(gap[k].argmin())
        if torch.isfinite(gap[k, e]):
            found[k] = e
            gap[:, e] = torch.inf
    return found
