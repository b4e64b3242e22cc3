"""The metrics: distances per frame, and sums whose ratio is the metric.

Every metric is first computed per record, the answer to one entity in one view of one take. ``N`` counts records,
``T`` frames, ``K`` queries, ``E`` the entities that can be confused with each other: those of the object that a tracker
may follow, hinges excluded. A metric over any set of records is the ratio of the summed totals and counts, so that
means, readings and bootstraps all come from one implementation.

A prediction that is missing or not finite is never dropped: it scores :data:`MISSING` in normalised units,
:data:`MISSING_PX` pixels, and no identity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.errors import InputError

INPUT_PX = 224
"""Side of the square input that frames are letterboxed to; pixel errors are given in its pixels."""

MISSING = 1.0
"""Distance of a missing prediction, normalised units."""

MISSING_PX = INPUT_PX * math.sqrt(2)
"""Pixel distance of a missing prediction: the diagonal of the input."""

GATE = 0.1
"""A prediction farther than this from every entity has no identity, normalised units."""

SWITCH_FRAMES = 3
"""A change of identity counts when it lasts at least this many frames."""

NO_IDENTITY = -1
"""Identity of a prediction that is missing or near no entity."""


@dataclass(frozen=True)
class Sums:
    """A metric before division, per record."""

    total: Float[np.ndarray, " N"]
    """What is averaged, summed over the record."""
    count: Float[np.ndarray, " N"]
    """How many terms the total has; 0 where the metric does not apply to the record."""

    def mean(self) -> float:
        """The metric over all records; NaN where nothing was counted."""
        count = self.count.sum()
        return float(self.total.sum() / count) if count > 0 else math.nan


def distance(
    point_world: Float[np.ndarray, "*B 3"], true_world: Float[np.ndarray, "*B 3"], *, half_diagonal_m: float
) -> Float[np.ndarray, "*B"]:
    """3D distance in normalised units; :data:`MISSING` where the prediction is not finite.

    Args:
        point_world: predictions, metres.
        true_world: truth, metres.
        half_diagonal_m: half the diagonal of the object's bounding box at rest, metres.

    Raises:
        InputError: the half diagonal is not positive.
    """
    if not half_diagonal_m > 0:
        raise InputError(
            f"metrics: expected half_diagonal_m > 0, got {half_diagonal_m}; distances need it as their unit"
        )
    gap = np.linalg.norm(point_world.astype(np.float64) - true_world, axis=-1) / half_diagonal_m
    return np.where(np.isfinite(point_world).all(axis=-1), gap, MISSING)


def distance_px(
    uv_px: Float[np.ndarray, "*B 2"], true_px: Float[np.ndarray, "*B 2"], *, width: int, height: int
) -> Float[np.ndarray, "*B"]:
    """Pixel distance after letterboxing the image to :data:`INPUT_PX` squared.

    Letterboxing scales both axes alike and shifts both points alike, so only the scale matters.

    Returns:
        :data:`MISSING_PX` where the prediction is not finite; NaN where the truth has no pixel (behind the camera).
    """
    gap = np.linalg.norm(uv_px.astype(np.float64) - true_px, axis=-1) * (INPUT_PX / max(width, height))
    gap = np.where(np.isfinite(uv_px).all(axis=-1), gap, MISSING_PX)
    return np.where(np.isfinite(true_px).all(axis=-1), gap, np.nan)


def identity(
    point_world: Float[np.ndarray, "T K 3"],
    entities_world: Float[np.ndarray, "T E 3"],
    own: Int[np.ndarray, " K"],
    *,
    half_diagonal_m: float,
) -> Int[np.ndarray, "T K"]:
    """Which entity each prediction follows: the nearest one within :data:`GATE`, else :data:`NO_IDENTITY`.

    Args:
        point_world: predictions, metres.
        entities_world: truth of every entity of the object that a tracker may follow, metres.
        own: index in ``entities_world`` of the entity that was asked for; it wins a tie.
        half_diagonal_m: metres per normalised unit.
    """
    gap = np.linalg.norm(point_world[:, :, None].astype(np.float64) - entities_world[:, None], axis=-1)
    gap = np.where(np.isfinite(gap), gap / half_diagonal_m, np.inf)
    nearest = gap.argmin(axis=-1)
    least = gap.min(axis=-1)
    own_gap = np.take_along_axis(gap, np.broadcast_to(own[None, :, None], (*gap.shape[:2], 1)), axis=-1)[..., 0]
    nearest = np.where(own_gap <= least, own, nearest)
    return np.where(least <= GATE, nearest, NO_IDENTITY)


def frame_mean(value: Float[np.ndarray, "N T"], counted: Bool[np.ndarray, "N T"]) -> Sums:
    """Sums for the mean over the counted frames: APE, APE_vis, APE_px and APE_2d differ in what they pass.

    Frames in which ``value`` is NaN (no true pixel) are not counted.
    """
    counted = counted & ~np.isnan(value)
    return Sums(np.where(counted, value, 0.0).sum(axis=-1, dtype=np.float64), counted.sum(axis=-1, dtype=np.float64))


def distance_at(gap: Float[np.ndarray, "N T"], share: float, counted: Bool[np.ndarray, "N T"]) -> Sums:
    """Sums for D@p: the distance at frame round(p (T - 1)), halves rounded up, of the records that count it."""
    frame = math.floor(share * (gap.shape[1] - 1) + 0.5)
    return frame_mean(gap[:, frame : frame + 1], counted[:, frame : frame + 1])


def accuracy(follows: Int[np.ndarray, "N T"], own: Int[np.ndarray, " N"], counted: Bool[np.ndarray, "N T"]) -> Sums:
    """Sums for Acc: the share of counted frames whose prediction follows its own entity (see :func:`identity`)."""
    return frame_mean((follows == own[:, None]).astype(np.float64), counted)


def switches(follows: Int[np.ndarray, "N T"], own: Int[np.ndarray, " N"], counted: Bool[np.ndarray, "N T"]) -> Sums:
    """Sums for switches per 1,000 counted frames.

    A switch is a change to another entity than the one followed so far (at first the one asked for) for at least
    :data:`SWITCH_FRAMES` frames in a row; the way back counts again. Frames without identity end a run and are no
    switch: they are a loss, which Acc sees.
    """
    total = np.array([_switch_count(f[c], int(o)) for f, o, c in zip(follows, own, counted, strict=True)], dtype=float)
    return Sums(1000.0 * total.reshape(len(follows)), counted.sum(axis=-1, dtype=np.float64))


def _switch_count(follows: np.ndarray, own: int) -> int:
    starts = np.flatnonzero(np.diff(follows, prepend=follows[:1] - 1)) if len(follows) else np.array([], dtype=int)
    lengths = np.diff(starts, append=len(follows))
    now, count = own, 0
    for start, length in zip(starts, lengths, strict=True):
        there = int(follows[start])
        if length >= SWITCH_FRAMES and there not in (NO_IDENTITY, now):
            now, count = there, count + 1
    return count


def slope(gap: Float[np.ndarray, "N T"], counted: Bool[np.ndarray, "N T"]) -> Sums:
    """Sums for the least-squares growth of the distance per 100 frames, one slope per record.

    A record with fewer than two counted frames has no slope and is not counted.
    """
    weight = counted.astype(np.float64)
    n = np.maximum(weight.sum(axis=-1, keepdims=True), 1.0)
    frame = np.arange(gap.shape[1], dtype=np.float64)[None]
    centred = (frame - (weight * frame).sum(axis=-1, keepdims=True) / n) * weight
    spread = (centred * centred).sum(axis=-1)
    rise = (centred * gap).sum(axis=-1)
    known = spread > 0
    return Sums(np.where(known, 100.0 * rise / np.where(known, spread, 1.0), 0.0), known.astype(np.float64))
