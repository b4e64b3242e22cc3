"""Following points from frame to frame, for trackers that know nothing but the newest position.

References: Lucas and Kanade, An iterative image registration technique, 1981; Bouguet, Pyramidal implementation of the
Lucas Kanade feature tracker, 2001 (OpenCV's ``calcOpticalFlowPyrLK``); Kalal et al., Forward-backward error, 2010;
Kroeger et al., Fast optical flow using dense inverse search, ECCV 2016 (OpenCV's ``DISOpticalFlow``).
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from quest.baselines.point_queries import Followed, PointTracker
from quest.track.preprocess import grey_of
from quest.types import Clip

Picture = TypeVar("Picture")
"""What a tracker looks at of a frame."""
Grey = UInt8[np.ndarray, "H W"]
Points = Float32[np.ndarray, "M 2"]
Point = Float32[np.ndarray, " 2"]
Stepped = tuple[Points, Bool[np.ndarray, " M"]]
"""Where points are in the next frame, and which of them were found there."""

WINDOW_PX, LEVELS = 21, 3
"""Of Lucas-Kanade: the window, and the levels of the pyramid above the image itself."""
BACK_PX = 1.5
"""A point that comes back no nearer than this to where it began was not followed."""
PATCH_PX = 41
"""Side of the patch of its own frame by which a point is found again."""
SEARCH_PX = 48
"""How far from where the point was last seen that patch is looked for, to the left, right, up and down."""
LEAST_MATCH = 0.8
"""Correlation above which the patch is the point again; set beforehand, not tuned on any recording."""
_GRID_PX, _LEAST_OF_GRID = 16.0, 3


class Chained(PointTracker, Generic[Picture]):
    """Chains a step from frame to frame.

    A point that is not found stays where it was, and is looked for from there in the next frame; one that leaves the
    image is lost for good. Confidence is 1 while tracking, 0 when lost.
    """

    @abstractmethod
    def picture(self, clip: Clip, t: int) -> Picture:
        """What the step looks at of frame ``t``."""

    @abstractmethod
    def step(self, previous: Picture, picture: Picture, uv_px: Points) -> Stepped:
        """Where points of one frame are in the next one, in pixels with centres at half-integers."""

    def resume(
        self, picture: Picture, origin: tuple[Picture, Point], uv_px: Point, stepped: tuple[Point, bool]
    ) -> tuple[Point, bool]:
        """Where a point is that was not found in the previous frame; where the step says, if no tracker knows better.

        ``origin`` is the picture of the query's own frame, and its pixel there; ``uv_px`` is where the point is held.
        """
        return stepped

    def follow(self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]) -> Followed:
        """Step by step."""
        t, k = len(clip), len(first)
        size = (clip.camera.width, clip.camera.height)
        uv_px = np.full((t, k, 2), np.nan, dtype=np.float32)
        alive, gone = np.zeros((t, k), dtype=bool), np.zeros(k, dtype=bool)
        previous, origins = None, dict[int, tuple[Picture, Point]]()
        for frame in range(t):
            picture = self.picture(clip, frame)
            if previous is not None:
                uv_px[frame] = uv_px[frame - 1]
                asked = np.flatnonzero((first < frame) & ~gone)
                if len(asked):
                    found, seen = self.step(previous, picture, uv_px[frame, asked])
                    for i in np.flatnonzero(~alive[frame - 1, asked]):
                        held = uv_px[frame, asked[i]]
                        found[i], seen[i] = self.resume(picture, origins[asked[i]], held, (found[i], bool(seen[i])))
                    inside = ((found >= 0) & (found <= size)).all(axis=-1)
                    gone[asked] = seen & ~inside
                    kept = seen & inside
                    uv_px[frame, asked[kept]], alive[frame, asked] = found[kept], kept
            born = np.flatnonzero(first == frame)
            uv_px[frame, born], alive[frame, born] = uv_first[born], True
            origins.update((int(which), (picture, uv_first[which])) for which in born)
            previous = picture
        return uv_px, alive, alive.astype(np.float32)


class ChainedGrey(Chained[Grey]):
    """Chains a step that looks at grey values."""

    def picture(self, clip: Clip, t: int) -> Grey:
        """Luminance."""
        return grey_of(clip.rgb[t])


class DenseFlow(ChainedGrey):
    """Follows by DIS flow, medium preset; it never says that it lost anything that is in the image."""

    name = "dis"

    def step(self, previous: Grey, picture: Grey, uv_px: Points) -> Stepped:
        """The flow at the point."""
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        flow_px = dis.calc(previous, picture, np.zeros((*picture.shape, 2), np.float32))
        return moved(np.asarray(flow_px, dtype=np.float32), uv_px)


def moved(flow_px: Float32[np.ndarray, "H W 2"], uv_px: Points) -> Stepped:
    """Where a field of motions in pixels takes points, all of them found; bilinear, centres at half-integers."""
    x, y = (uv_px - np.float32(0.5)).T[..., None]
    motion = cv2.remap(flow_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    return (uv_px + motion).astype(np.float32), np.ones(len(uv_px), dtype=bool)


def flow(previous: Grey, grey: Grey, uv_px: Points) -> Stepped:
    """Where Lucas-Kanade has points, and whether it found them."""
    start = np.ascontiguousarray(uv_px - 0.5, dtype=np.float32)[:, None]
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        previous, grey, start, np.empty_like(start), winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS
    )
    end = np.asarray(found, dtype=np.float32)[:, 0] + np.float32(0.5)
    return end, (np.asarray(status)[:, 0] == 1) & np.isfinite(end).all(axis=-1)


def checked_flow(previous: Grey, grey: Grey, uv_px: Points) -> Stepped:
    """As :func:`flow`; found is what, followed backwards, also comes back to within :data:`BACK_PX`."""
    end, found = flow(previous, grey, uv_px)
    again, found_again = flow(grey, previous, np.where(found[:, None], end, uv_px))
    return end, found & found_again & (np.linalg.norm(again - uv_px, axis=-1) < BACK_PX)


class LucasKanade(ChainedGrey):
    """Follows the point itself."""

    name = "lk"

    def step(self, previous: Grey, picture: Grey, uv_px: Points) -> Stepped:
        """The flow at the point."""
        return flow(previous, picture, uv_px)


class LucasKanadeGrid(ChainedGrey):
    """Follows by the median motion of 5 x 5 points, 16 pixels wide, of those that come back when followed backwards."""

    name = "lk-grid"

    def step(self, previous: Grey, picture: Grey, uv_px: Points) -> Stepped:
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

    def step(self, previous: Grey, picture: Grey, uv_px: Points) -> Stepped:
        """As that one; what is outside the image was not followed."""
        found, seen = super().step(previous, picture, uv_px)
        return found, seen & ((found >= 0) & (found <= picture.shape[::-1])).all(axis=-1)

    def resume(
        self, picture: Grey, origin: tuple[Grey, Point], uv_px: Point, stepped: tuple[Point, bool]
    ) -> tuple[Point, bool]:
        """Where the patch matches best, to a pixel; found if that is well enough, and the patch is not of one grey."""
        patch = _around(*origin, PATCH_PX)
        area = _around(picture, uv_px, PATCH_PX + 2 * SEARCH_PX)
        _, best, _, at = cv2.minMaxLoc(cv2.matchTemplate(area, patch, cv2.TM_CCOEFF_NORMED))
        return uv_px + np.asarray(at, dtype=np.float32) - SEARCH_PX, bool(best > LEAST_MATCH and np.ptp(patch) > 0)


def _around(picture: Grey, uv_px: Point, side_px: int) -> UInt8[np.ndarray, "S S"]:
    """The square around a point, between pixels bilinear, beyond the border as at it."""
    return np.asarray(cv2.getRectSubPix(picture, (side_px, side_px), (uv_px - 0.5).tolist()), dtype=np.uint8)
