"""Discovery: peaks of the dense affordance map, which seed the slots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.model.bars import ALIKE, find_ridges
from quest.model.network import UNKNOWN_INTENT, QuestNetwork
from quest.model.observation import FrameBatch, Observation, cell_centres
from quest.types import LABELS

FOUND_WITHIN = 0.1
"""A candidate this close to an entity of its label has found it, normalised units: the gate of protocol semantic."""

_PURPOSES_APART_PX = 3.0

_VOTES_WITHIN_PX = 40.0
"""Cells along a rim are a part of it if they point so near to where the best one points."""


@dataclass(frozen=True)
class Peaks:
    """Candidates for entities, best first.

    Attributes:
        uv: coordinates in [0, 1]^2 of the network's input.
        point_m: what is seen there, lifted by the nearest depth around: camera axes, metres; NaN without depth.
        label: index into LABELS.
        logit: score of the affordance map.
        intent: index into INTENTS, or UNKNOWN_INTENT if the network does not know.
    """

    uv: Float[Tensor, "K 2"]
    point_m: Float[Tensor, "K 3"]
    label: Int[Tensor, " K"]
    logit: Float[Tensor, " K"]
    intent: Int[Tensor, " K"]

    def __len__(self) -> int:
        return len(self.label)

    def select(self, index: Sequence[int]) -> Peaks:
        """Some of them."""
        return Peaks(*(getattr(self, f.name)[list(index)] for f in fields(self)))


@dataclass(frozen=True)
class Candidates:
    """All peaks of a frame, of which those that are too close to each other cannot all be entities.

    Attributes:
        peaks: the peaks, best first.
        clash: which are too close to each other.
    """

    peaks: Peaks
    clash: Bool[Tensor, "K K"]

    def apart(self, among: Sequence[int] | None = None) -> list[int]:
        """Of peaks that are too close to each other the best alone.

        Args:
            among: indices of the peaks that count, best first; all by default. Who looks for one label does not mind
                what is a better peak of another at the same place.
        """
        keep: list[int] = []
        for i in range(len(self.peaks)) if among is None else among:
            if not bool(self.clash[i, keep].any()):
                keep.append(i)
        return keep


def find_candidates(
    network: QuestNetwork,
    frames: FrameBatch,
    observed: Observation,
    *,
    radius_cells: float,
    prominence: float = 0.0,
    mirror: bool = True,
) -> Candidates:
    """Peaks of one frame (B = 1, T = 1).

    A peak is the best of its 3 x 3 cells, label and intent, and lies where its cell points to; a rim, along which all
    places look alike, where its cells point to in the mean. So does a handle that has several peaks, if those are to
    be one (see :mod:`quest.model.bars`). Peaks clash that are closer than ``radius_cells``. The same label for another
    intent may come closer, a rim as close as it likes: those of a closed laptop are two things.

    Args:
        network: whose map is read.
        frames: the frame.
        observed: the frame as observed.
        radius_cells: how far peaks are apart.
        prominence: by how much the logit falls between two peaks of one handle at least; 0 lets it have several.
        mirror: whether the map is the mean of the frame's and of its mirror image's, which finds more and costs the
            encoding of another image.
    """
    side, cell = network.config.cells, network.config.cell_px
    found = network.afford(frames, observed)
    if mirror:
        other = _mirrored(network, frames)
        found = found.mean(network.afford(other, network.observe(other)).mirrored())
    purposes = found.logits.shape[-1]
    scores = found.logits[0, 0].flatten(1).T.reshape(-1, side, side)
    is_peak = scores == F.max_pool2d(scores.unsqueeze(0), 3, 1, 1).squeeze(0)
    flat = torch.where(is_peak, scores, -torch.inf).flatten()
    pointed = cell_centres(network.config, device=flat.device)[:, None] + cell * found.offset[0, 0]
    peaks = flat.topk(min(4 * network.config.slots, int(is_peak.sum())))
    index, bars = _one_per_bar(network, frames, scores, pointed, peaks, prominence=prominence)
    value = flat[index]
    channel, place = index.div(side * side, rounding_mode="floor"), index % (side * side)
    label, purpose = channel.div(purposes, rounding_mode="floor"), channel % purposes
    uv_px = pointed[place, purpose]
    for n, cells in bars.items():
        uv_px[n] = pointed[cells, purpose[n]].mean(dim=0)
    rim = torch.nonzero(label == LABELS.index("rim"))[:, 0]
    votes, likeness = pointed[:, purpose[rim]].transpose(0, 1), scores.flatten(1)[channel[rim]] - value[rim, None]
    uv_px[rim] = _agreed(uv_px[rim], votes, likeness)
    other_purpose = (label[:, None] == label) & (purpose[:, None] != purpose)
    apart_px = torch.where(other_purpose, _PURPOSES_APART_PX, radius_cells * cell)
    apart_px[rim] = torch.where(other_purpose[rim], 0.0, apart_px[rim])
    clash = torch.cdist(uv_px, uv_px) < apart_px
    size = network.config.encoder.image_size
    uv_px = uv_px.clamp(0, size)
    point = frames.near_point_at(uv_px[None, None])
    intent = purpose if purposes > 1 else torch.full_like(purpose, UNKNOWN_INTENT)
    return Candidates(Peaks(uv_px / size, frames.to_camera(point)[0, 0], label, value, intent), clash)


def find_peaks(
    network: QuestNetwork,
    frames: FrameBatch,
    observed: Observation,
    *,
    radius_cells: float,
    prominence: float = 0.0,
    mirror: bool = True,
) -> Peaks:
    """Those of :func:`find_candidates` that do not clash, at most as many as the network has slots."""
    found = find_candidates(network, frames, observed, radius_cells=radius_cells, prominence=prominence, mirror=mirror)
    return found.peaks.select(found.apart()[: network.config.slots])


def _one_per_bar(
    network: QuestNetwork,
    frames: FrameBatch,
    scores: Float[Tensor, "N S S"],
    pointed_px: Float[Tensor, "C P 2"],
    peaks: torch.return_types.topk,
    *,
    prominence: float,
) -> tuple[Int[Tensor, " K"], dict[int, list[int]]]:
    """Peaks without those that are on the same handle as a better one.

    Args:
        network: whose map it is.
        frames: the frame.
        scores: logits of every label and purpose.
        pointed_px: where cells point to for every purpose.
        peaks: values and flat indices into the scores, best first.
        prominence: by how much the logit falls between two of them on one handle at least.

    Returns:
        Indices of those that are left, and for those of them that had company the cells of their handle.
    """
    cells, purposes = scores[0].numel(), pointed_px.shape[1]
    needless: set[int] = set()
    cells_of: dict[int, list[int]] = {}
    if prominence > 0 and len(peaks.values):
        floor, depth_m, scale = float(peaks.values[-1]), frames.depth_m[0, 0].float(), frames.scale[0].float()
        for purpose in range(purposes):
            channel = LABELS.index("handle") * purposes + purpose
            aims, score = pointed_px[:, purpose], scores[channel]
            for ridge in find_ridges(
                score, aims, floor, prominence=prominence, depth_m=depth_m, scale=scale, config=network.config
            ):
                best, *others = ridge.tops
                needless |= {channel * cells + top for top in others}
                if others:
                    likeness = score.flatten()[ridge.cells] - score.flatten()[best]
                    alike = torch.nonzero(likeness > -ALIKE)[:, 0].tolist()
                    cells_of[channel * cells + best] = [ridge.cells[n] for n in alike]
    kept = [i for i in peaks.indices.tolist() if i not in needless]
    company = {n: cells_of[i] for n, i in enumerate(kept) if i in cells_of}
    return peaks.indices.new_tensor(kept), company


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
    agree = (near & (likeness > -ALIKE)).unsqueeze(-1)
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
