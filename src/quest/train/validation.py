"""Quality on windows of validation objects, by which a checkpoint is chosen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from quest.model.config import DecoderConfig
from quest.model.discovery import RADIUS_CELLS, Peaks, find_peaks, match_peaks
from quest.model.network import QuestNetwork, WindowNetwork
from quest.model.observation import FrameBatch, Observation
from quest.train.objective import Answered, Rollout, has_moved, is_right
from quest.train.windows import WindowSampler, WindowTruth

_PEAK_LOGIT = -0.5


@dataclass(frozen=True)
class WindowScores:
    """Quality on fixed windows."""

    median_px: float
    """Median distance of visible answers, pixels of the input."""
    mean_distance: float
    """Mean 3D distance of all answers, normalised units, at most 1 each."""
    moved_distance: float | None
    """The same of entities that have left the place where they were asked for; None if none has."""
    still_distance: float | None
    """The same of the others."""
    right: float
    """Share of answers with the right identity."""
    discovery_f1: float | None
    """F1 of discovered slots against visible entities, same label and within 0.1; None for networks whose map has a
    stage of its own."""
    answers: int
    """How many answers were judged."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by; less is better.

        What moves is what a tracker is asked about, but most entities stand still in most windows, and a network can
        get better at these and worse at the others: either counts half.
        """
        known = [value for value in (self.moved_distance, self.still_distance) if value is not None]
        return sum(known) / len(known) if known else self.mean_distance

    def __str__(self) -> str:
        discovery = "" if self.discovery_f1 is None else f"discovery F1 {self.discovery_f1:.3f} "
        moved = "" if self.moved_distance is None else f" (moved {self.moved_distance:.4f})"
        return (
            f"median {self.median_px:.2f} px, 3D distance {self.mean_distance:.4f}{moved}, right {self.right:.1%}, "
            f"{discovery}(n = {self.answers})"
        )


def score_windows(
    network: WindowNetwork[DecoderConfig],
    answered: Callable[[FrameBatch, WindowTruth], Answered],
    sampler: WindowSampler,
    *,
    batches: int,
    device: torch.device,
) -> WindowScores:
    """Scores on the same windows at every call; the network is left in training mode.

    Args:
        network: what is judged.
        answered: what it answers on a batch.
        sampler: of windows.
        batches: how many.
        device: where the network is.
    """
    rng = np.random.default_rng(0)
    network.eval()
    px, distance, right, moved = [], [], [], []
    found, reads_map = np.zeros(3), False
    with torch.no_grad():
        for _ in range(batches):
            frames, truth = sampler.draw(rng, disturb=False)
            frames, truth = frames.to(device), truth.to(device)
            roll = answered(frames, truth)
            scores = _score(roll, network.config.encoder.image_size)
            for values, value in zip((px, distance, right, moved), scores, strict=True):
                values.append(value)
            if isinstance(roll, Rollout) and not roll.network.config.map_layers:
                reads_map = True
                found += _discovery(roll.network, frames.during(slice(0, 1)), roll.anchor_observed, truth)
    network.train()
    all_px, hits, proposed, present = torch.cat(px), *found
    all_distance, all_moved = torch.cat(distance), torch.cat(moved)
    return WindowScores(
        median_px=float(all_px.median()) if len(all_px) else math.inf,
        mean_distance=float(all_distance.mean()),
        moved_distance=mean_of(all_distance[all_moved]),
        still_distance=mean_of(all_distance[~all_moved]),
        right=float(torch.cat(right).mean()),
        discovery_f1=float(2 * hits / max(proposed + present, 1)) if reads_map else None,
        answers=sum(len(d) for d in distance),
    )


def mean_of(values: Float[Tensor, " N"]) -> float | None:
    """The mean of what was judged; None where nothing was."""
    return float(values.mean()) if len(values) else None


def _score(roll: Answered, image_size: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel distances of what is seen; distances, whether right and whether moved of all answers."""
    px = (roll.uv - roll.truth_uv).norm(dim=-1).float() * image_size
    distance = (roll.point - roll.truth_point).norm(dim=-1) / roll.truth.unit[:, None, None]
    right, _ = is_right(roll.point, roll.truth, px)
    distance = distance.nan_to_num(1.0).clamp(max=1.0)
    counted = roll.mask
    return px[roll.seen], distance[counted].float(), right[counted].float(), has_moved(roll.truth)[counted]


def _discovery(network: QuestNetwork, frames: FrameBatch, observed: Observation, truth: WindowTruth) -> np.ndarray:
    """Slots that hit an entity of their label, slots, and visible entities at the anchor frames."""
    counts = np.zeros(3)
    for b in range(len(truth.unit)):
        one = slice(b, b + 1)
        peaks = find_peaks(network, frames.of(one), observed.of(one), radius_cells=RADIUS_CELLS, mirror=False)
        keep = peaks.logit > _PEAK_LOGIT
        found, present = match_at_anchor(peaks, frames, truth, b)
        counts += (int((found[keep] >= 0).sum()), int(keep.sum()), len(present))
    return counts


def match_at_anchor(
    peaks: Peaks, frames: FrameBatch, truth: WindowTruth, b: int
) -> tuple[Int[Tensor, " K"], Int[Tensor, " E"]]:
    """What the peaks of an anchor frame are right about, and which entities are seen in it.

    Args:
        peaks: of window ``b``'s anchor frame, best first.
        frames: the batch.
        truth: of the batch.
        b: which window.

    Returns:
        Index into the seen entities, or -1, of every peak; index into the truth's entities of every one seen.
    """
    seen = torch.nonzero(truth.visible[b, 0] & truth.exists[b])[:, 0]
    one = frames.of(slice(b, b + 1)).during(slice(0, 1))
    found = match_peaks(
        peaks.point_m,
        peaks.label,
        one.to_camera(truth.point[b : b + 1, :1, seen])[0, 0],
        truth.label[b, seen],
        half_diagonal_m=float(truth.unit[b] * frames.scale[b]),
    )
    return found, seen
