"""Evidence of local motion: where small patches of one frame are in the next one.

Each point is followed by pyramidal Lucas-Kanade and followed back again. Its covariance is that of least squares on the
patch, the noise of a grey value squared times the inverse structure tensor, plus the squared forward-backward error.

Reference: Lucas and Kanade, An iterative image registration technique, 1981; Bouguet, Pyramidal implementation of the
Lucas Kanade feature tracker, 2001; Kalal et al., Forward-backward error, ICPR 2010; Shi and Tomasi, Good features to
track, CVPR 1994.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from quest.filter.picture import WINDOW_PX, GreyPicture
from quest.filter.view import in_image

_LEVELS = 4
_ENOUGH = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
"""Steps on each level of the pyramid, and pixels below which one is the last."""
_BACK_PX = 1.5
_LEAST_LIKE = 0.3
"""Correlation of the patch in both frames below which it is noise that was followed."""
_GREY_NOISE = 4.0
"""Standard deviation of a grey value against that of the same place in the next frame."""


@dataclass(frozen=True)
class LocalMotion:
    """Where N points went."""

    uv_px: Float[np.ndarray, "N 2"]
    """Pixels in the new frame; where nothing was found, those of the guess."""
    found: Bool[np.ndarray, " N"]
    """Whether a point came back to where it began when followed backwards, and is in the image."""
    covariance: Float[np.ndarray, "N 2 2"]
    """Of ``uv_px``, pixels squared."""


def follow(
    previous: GreyPicture,
    picture: GreyPicture,
    uv_px: Float[np.ndarray, "N 2"],
    guess_px: Float[np.ndarray, "N 2"],
) -> LocalMotion:
    """Follow points of one frame to the next, where ``guess_px`` expects them; pixel centres are at half-integers."""
    if not len(uv_px):
        return LocalMotion(guess_px, np.zeros(0, dtype=bool), np.zeros((0, 2, 2)))
    there, found, off = _flow(previous.grey, picture.grey, uv_px, guess_px)
    back, found_back, _ = _flow(picture.grey, previous.grey, there, uv_px)
    found &= (off / 0.8) ** 2 < 2 * (1 - _LEAST_LIKE) * previous.variance(uv_px)
    error_px = np.linalg.norm(back - uv_px, axis=-1)
    found &= found_back & (error_px < _BACK_PX) & in_image(there, picture.size)
    covariance = _covariance(previous, uv_px) + (error_px**2)[:, None, None] * np.eye(2)
    return LocalMotion(np.where(found[:, None], there, guess_px), found, covariance)


def _flow(
    previous: UInt8[np.ndarray, "H W"],
    grey: UInt8[np.ndarray, "H W"],
    uv_px: Float[np.ndarray, "N 2"],
    guess_px: Float[np.ndarray, "N 2"],
) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    start, guess = ((x - 0.5).astype(np.float32).reshape(-1, 1, 2) for x in (uv_px, guess_px))
    there, status, off = cv2.calcOpticalFlowPyrLK(
        previous,
        grey,
        start,
        guess,
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=_ENOUGH,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    end = np.asarray(there, dtype=np.float64)[:, 0] + 0.5
    found = (np.asarray(status)[:, 0] == 1) & np.isfinite(end).all(axis=-1)
    differ = np.where(found, np.asarray(off)[:, 0], np.float32(0))  # undefined where the point was not found
    return np.where(found[:, None], end, guess_px), found, differ.astype(np.float64)


def _covariance(picture: GreyPicture, uv_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2 2"]:
    """Noise over structure: the inverse of the summed products of gradients in the window."""
    xx, xy, yy = picture.structure(uv_px).T
    xx, yy = xx + 1.0, yy + 1.0  # a flat patch is nowhere, not at infinity
    inverse = np.stack([np.stack([yy, -xy], axis=-1), np.stack([-xy, xx], axis=-1)], axis=-2)
    return _GREY_NOISE**2 * inverse / (xx * yy - xy**2)[:, None, None]


def corners(
    picture: GreyPicture, allowed: Bool[np.ndarray, "H W"], *, cell_px: int, count: int
) -> Float[np.ndarray, "N 2"]:
    """The best corners where they are allowed, at most ``count``, no two nearer than a cell is wide."""
    mask = allowed.astype(np.uint8)
    found = None if count < 1 else cv2.goodFeaturesToTrack(picture.grey, count, 0.003, cell_px, mask=mask)
    if found is None:
        return np.zeros((0, 2))
    uv_px = np.asarray(found, dtype=np.float64)[:, 0] + 0.5
    return uv_px[picture.variance(uv_px) > _GREY_NOISE**2]
