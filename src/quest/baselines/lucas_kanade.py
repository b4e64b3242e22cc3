"""Pyramidal Lucas-Kanade, chained from frame to frame: one point, or the median motion of a grid around it.

Reference: Lucas and Kanade, An iterative image registration technique, 1981; Bouguet, Pyramidal implementation of the
Lucas Kanade feature tracker, 2001 (OpenCV's ``calcOpticalFlowPyrLK``); Kalal et al., Forward-backward error, 2010.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from quest.baselines.chained import Chained

WINDOW_PX = 21
LEVELS = 3
"""Pyramid levels above the image itself."""

BACK_PX = 1.5
"""A point that comes back no nearer than this to where it began was not followed."""

_GRID_PX = 16.0
_LEAST_OF_GRID = 3


def flow(
    previous: UInt8[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
    """Where points went from one frame to the next, and whether the flow found them; centres at half-integers."""
    start = np.ascontiguousarray(uv_px - 0.5, dtype=np.float32)[:, None]
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        previous, grey, start, np.empty_like(start), winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS
    )
    end = np.asarray(found, dtype=np.float32)[:, 0] + np.float32(0.5)
    return end, (np.asarray(status)[:, 0] == 1) & np.isfinite(end).all(axis=-1)


def checked_flow(
    previous: UInt8[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
    """As :func:`flow`; found is what, followed backwards, also comes back to within :data:`BACK_PX`."""
    end, found = flow(previous, grey, uv_px)
    again, found_again = flow(grey, previous, np.where(found[:, None], end, uv_px))
    return end, found & found_again & (np.linalg.norm(again - uv_px, axis=-1) < BACK_PX)


class LucasKanade(Chained):
    """Follows the point itself."""

    name = "lk"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """The flow at the point."""
        return flow(previous, grey, uv_px)


class LucasKanadeGrid(Chained):
    """Follows by the median motion of 5 x 5 points, 16 pixels wide, of those that come back when followed backwards."""

    name = "lk-grid"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """The median motion around each point; not found where fewer than three points of its grid were followed."""
        side = np.linspace(-_GRID_PX / 2, _GRID_PX / 2, 5, dtype=np.float32)
        grid = (uv_px[:, None] + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)).astype(np.float32)
        end, good = (a.reshape(grid.shape[:2] + a.shape[1:]) for a in checked_flow(previous, grey, grid.reshape(-1, 2)))
        seen = good.sum(axis=1) >= _LEAST_OF_GRID
        found = uv_px.copy()
        for k in np.flatnonzero(seen):
            found[k] += np.median((end - grid)[k, good[k]], axis=0)
        return found, seen
