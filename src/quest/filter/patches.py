"""Evidence of a query's own patch: the motion that most of what is near the query agrees on.

A patch at a seam has two layers. Points near the query count more, and the heaviest motion is taken, not the mean.

Reference: Comaniciu and Meer, Mean shift, PAMI 2002.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from quest.filter.local_motion import follow
from quest.filter.picture import GreyPicture

_SIDE = 5
_WIDTH_PX = 24.0
_NEAR_PX = 5.0
_TILE_PX = 97
_LOOK_PX = 25
_LEAST_SUPPORT = 0.15
_KERNEL_PX2 = 1.0

_LINE = np.linspace(-_WIDTH_PX / 2, _WIDTH_PX / 2, _SIDE)
GRID_PX: Float[np.ndarray, "P 2"] = np.stack(np.meshgrid(_LINE, _LINE), axis=-1).reshape(-1, 2)
"""Where the points of a patch are, from its middle."""
_WEIGHT = np.exp(-(GRID_PX**2).sum(axis=1) / (2 * _NEAR_PX**2))
_WEIGHT /= _WEIGHT.sum()


@dataclass(frozen=True)
class PatchMotion:
    """How the patches around K places moved."""

    step_px: Float[np.ndarray, "K 2"]
    """Pixels; 0 where not found."""
    variance: Float[np.ndarray, " K"]
    """Of it, pixels squared; infinite where not found."""


def patch_motion(
    previous: GreyPicture,
    picture: GreyPicture,
    uv_px: Float[np.ndarray, "K 2"],
    guess_px: Float[np.ndarray, "K 2"],
    share: Float[np.ndarray, "K P"] | None = None,
) -> PatchMotion:
    """Follow the patch around each place of ``previous`` to ``picture``, where ``guess_px`` expects it.

    ``share`` says how far each point of :data:`GRID_PX` belongs to what is followed, 0 to 1; all do by default.
    """
    start, guess = ((each[:, None] + GRID_PX).reshape(-1, 2) for each in (uv_px, guess_px))
    motion = follow(previous, picture, start, guess)
    step = (motion.uv_px - start).reshape(len(uv_px), -1, 2)
    weight = _WEIGHT * motion.found.reshape(len(uv_px), -1)
    weight = weight if share is None else weight * share
    variance = np.trace(motion.covariance, axis1=1, axis2=2).reshape(weight.shape) / 2
    return _heaviest(step, weight, variance)


def _heaviest(
    step: Float[np.ndarray, "K P 2"], weight: Float[np.ndarray, "K P"], variance: Float[np.ndarray, "K P"]
) -> PatchMotion:
    """The mode of the weighted steps, by mean shift from the step that most others support."""
    apart = ((step[:, :, None] - step[:, None]) ** 2).sum(axis=-1)
    both = variance[:, :, None] + variance[:, None] + _KERNEL_PX2
    support = (weight[:, None] * np.exp(-apart / (2 * both))).sum(axis=-1) * (weight > 0)
    best = np.take_along_axis(step, support.argmax(axis=1)[:, None, None], axis=1)[:, 0]
    spread = variance + _KERNEL_PX2
    agreed = precise = np.zeros_like(weight)
    for _ in range(4):
        agreed = weight * np.exp(-((step - best[:, None]) ** 2).sum(axis=-1) / (2 * spread))
        precise = agreed / spread
        best = (precise[..., None] * step).sum(axis=1) / np.maximum(precise.sum(axis=1), 1e-12)[:, None]
    found = agreed.sum(axis=1) > _LEAST_SUPPORT
    return PatchMotion(
        np.where(found[:, None], best, 0.0), np.where(found, 1 / np.maximum(precise.sum(axis=1), 1e-12), np.inf)
    )


def tiles(picture: GreyPicture, uv_px: Float[np.ndarray, "K 2"]) -> UInt8[np.ndarray, "K S S"]:
    """What is around each place, with the place in the middle."""
    return np.rint(picture.patches(uv_px, _TILE_PX)).astype(np.uint8)


def tile_motion(
    tile: UInt8[np.ndarray, "K S S"], picture: GreyPicture, guess_px: Float[np.ndarray, "K 2"]
) -> PatchMotion:
    """Find the middle of each tile, which may be of any frame, again: how far it is from where it is expected."""
    middle = np.stack([(np.arange(len(tile)) + 0.5) * _TILE_PX, np.full(len(tile), _TILE_PX / 2)], axis=-1)
    both = (tile, tiles(picture, guess_px))
    before, now = (GreyPicture(np.hstack(tuple(each))) for each in both)
    return patch_motion(before, now, middle, middle)


def look(tile: UInt8[np.ndarray, "K S S"]) -> Float[np.ndarray, "K P"]:
    """Grey values in the middle, of mean 0 and length 1: their products are normalised cross-correlations."""
    inner = slice((_TILE_PX - _LOOK_PX) // 2, (_TILE_PX + _LOOK_PX) // 2)
    values = tile[:, inner, inner].reshape(len(tile), _LOOK_PX**2).astype(np.float64)
    values -= values.mean(axis=1, keepdims=True)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)
