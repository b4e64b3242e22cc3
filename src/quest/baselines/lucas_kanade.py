"""Pyramidal Lucas-Kanade, chained from frame to frame: one point, or the median motion of a grid around it.

Reference: Lucas and Kanade, An iterative image registration technique, 1981; Bouguet, Pyramidal implementation of the
Lucas Kanade feature tracker, 2001 (OpenCV's ``calcOpticalFlowPyrLK``); Kalal et al., Forward-backward error, 2010.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from quest.baselines.chained import ChainedGrey

WINDOW_PX = 21
LEVELS = 3
"""Pyramid levels above the image itself."""

BACK_PX = 1.5
"""A point that comes back no nearer than this to where it began was not followed."""

PATCH_PX = 41
"""Side of the patch of its own frame by which a point is found again."""
SEARCH_PX = 48
"""How far from where the point was last seen that patch is looked for, to the left, right, up and down."""
LEAST_MATCH = 0.8
"""Correlation above which the patch is the point again; set beforehand, not tuned on any recording."""

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


class LucasKanade(ChainedGrey):
    """Follows the point itself."""

    name = "lk"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], picture: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """The flow at the point."""
        return flow(previous, picture, uv_px)


class LucasKanadeGrid(ChainedGrey):
    """Follows by the median motion of 5 x 5 points, 16 pixels wide, of those that come back when followed backwards."""

    name = "lk-grid"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], picture: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """The median motion around each point; not found where fewer than three points of its grid were followed."""
        side = np.linspace(-_GRID_PX / 2, _GRID_PX / 2, 5, dtype=np.float32)
        grid = (uv_px[:, None] + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)).astype(np.float32)
        end, good = (
            a.reshape(grid.shape[:2] + a.shape[1:]) for a in checked_flow(previous, picture, grid.reshape(-1, 2))
        )
        seen = good.sum(axis=1) >= _LEAST_OF_GRID
        found = uv_px.copy()
        for k in np.flatnonzero(seen):
            found[k] += np.median((end - grid)[k, good[k]], axis=0)
        return found, seen


class LucasKanadeAgain(LucasKanadeGrid):
    """Follows as :class:`LucasKanadeGrid`, and after each occlusion begins anew from its first frame.

    A point that was not followed is held. It is followed again from where the patch of the query's own frame is found,
    by normalised cross-correlation, around where the point was last seen; also after it left the image.
    """

    name = "lk-reinit"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], picture: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """As that one; what is outside the image was not followed."""
        found, seen = super().step(previous, picture, uv_px)
        return found, seen & ((found >= 0) & (found <= picture.shape[::-1])).all(axis=-1)

    def resume(
        self,
        picture: UInt8[np.ndarray, "H W"],
        origin: tuple[UInt8[np.ndarray, "H W"], Float32[np.ndarray, " 2"]],
        uv_px: Float32[np.ndarray, " 2"],
        stepped: tuple[Float32[np.ndarray, " 2"], bool],
    ) -> tuple[Float32[np.ndarray, " 2"], bool]:
        """Where the patch matches best, to a pixel; found if that is well enough, and the patch is not of one grey."""
        patch = _around(*origin, PATCH_PX)
        area = _around(picture, uv_px, PATCH_PX + 2 * SEARCH_PX)
        score = cv2.matchTemplate(area, patch, cv2.TM_CCOEFF_NORMED)
        _, best, _, at = cv2.minMaxLoc(score)
        return uv_px + np.asarray(at, dtype=np.float32) - SEARCH_PX, bool(best > LEAST_MATCH and np.ptp(patch) > 0)


def _around(
    picture: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, " 2"], side_px: int
) -> UInt8[np.ndarray, "S S"]:
    """The square around a point, between pixels bilinear, beyond the border as at it."""
    return np.asarray(cv2.getRectSubPix(picture, (side_px, side_px), (uv_px - 0.5).tolist()), dtype=np.uint8)
