"""Quality on windows of validation objects, by which a checkpoint is chosen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.frames import FrameBatch
from quest.train.answers import Answered, has_moved, is_right
from quest.train.windows import WindowSampler, WindowTruth


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
        moved = "" if self.moved_distance is None else f" (moved {self.moved_distance:.4f})"
        return (
            f"median {self.median_px:.2f} px, 3D distance {self.mean_distance:.4f}{moved}, right {self.right:.1%} "
            f"(n = {self.answers})"
        )


def score_windows(
    network: nn.Module,
    answered: Callable[[FrameBatch, WindowTruth], Answered],
    sampler: WindowSampler,
    *,
    batches: int,
    device: torch.device,
) -> WindowScores:
    """Scores of what a network answers on the same windows at every call; it is left in training mode."""
    rng = np.random.default_rng(0)
    network.eval()
    scores = []
    with torch.no_grad():
        for _ in range(batches):
            frames, truth = sampler.draw(rng, disturb=False)
            scores.append(_score(answered(frames.to(device), truth.to(device)), sampler.shape.encoder.image_size))
    network.train()
    px, distance, right, moved = (torch.cat(values) for values in zip(*scores, strict=True))
    return WindowScores(
        median_px=float(px.median()) if len(px) else math.inf,
        mean_distance=float(distance.mean()),
        moved_distance=mean_of(distance[moved]),
        still_distance=mean_of(distance[~moved]),
        right=float(right.mean()),
        answers=len(distance),
    )


def mean_of(values: Float[Tensor, " N"]) -> float | None:
    """The mean of what was judged; None where nothing was."""
    return float(values.mean()) if len(values) else None


def _score(answers: Answered, image_size: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel distances of what is seen; distances, whether right and whether moved of all answers."""
    px = (answers.uv - answers.truth_uv).norm(dim=-1).float() * image_size
    distance = (answers.point - answers.truth_point).norm(dim=-1) / answers.truth.unit[:, None, None]
    right = is_right(answers.point, answers.truth, px)
    distance = distance.nan_to_num(1.0).clamp(max=1.0)
    counted = answers.mask
    return px[answers.seen], distance[counted].float(), right[counted].float(), has_moved(answers.truth)[counted]
