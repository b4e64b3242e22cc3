"""Points of the still world, from which the camera's motion is told.

Each keeps the world point of its birth as long as it is followed; where they run out new ones are sown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from quest.filter.camera_motion import estimate_pose, picture_motion
from quest.filter.local_motion import corners, follow
from quest.filter.view import View

_CELL_PX = 20
_COUNT = 400


@dataclass(frozen=True)
class Landmarks:
    """N points of the newest frame."""

    uv_px: Float[np.ndarray, "N 2"]
    point_world: Float[np.ndarray, "N 3"]
    """Metres; NaN without depth."""

    @classmethod
    def none(cls) -> Landmarks:
        """Before the first frame."""
        return cls(np.zeros((0, 2)), np.zeros((0, 3)))

    def _kept(self, which: np.ndarray) -> Landmarks:
        return Landmarks(self.uv_px[which], self.point_world[which])


@dataclass(frozen=True)
class CameraMotion:
    """How the camera moved from one frame to the next."""

    cam_from_world: Float[np.ndarray, "4 4"]
    """The new pose."""
    picture: Float[np.ndarray, "3 3"]
    """Homography of the picture, for places without depth."""


def observe_camera(
    landmarks: Landmarks,
    previous: UInt8[np.ndarray, "H W"],
    grey: UInt8[np.ndarray, "H W"],
    old: View,
    given: Float[np.ndarray, "4 4"] | None,
) -> tuple[Landmarks, CameraMotion]:
    """Follow the landmarks into a new frame, and tell the camera's motion from them.

    Args:
        landmarks: of the previous frame.
        previous: its grey values.
        grey: those of the new one.
        old: view of the previous frame.
        given: the new pose, where it is known.
    """
    expected = old if given is None else replace(old, cam_from_world=given)
    guess, _ = expected.project(landmarks.point_world)
    guess = np.where(np.isfinite(guess), guess, landmarks.uv_px)
    motion = follow(previous, grey, landmarks.uv_px, guess)
    picture = picture_motion(landmarks.uv_px[motion.found], motion.uv_px[motion.found])
    moved = replace(landmarks, uv_px=motion.uv_px)._kept(motion.found)
    pose = old.cam_from_world if given is None else given
    known = np.asarray(np.isfinite(moved.point_world).all(axis=-1))
    if given is None and known.any():
        moved = moved._kept(known)
        estimate = estimate_pose(moved.point_world, moved.uv_px, old.matrix, pose)
        if estimate is None:
            return Landmarks.none(), CameraMotion(pose, picture)
        moved, pose = moved._kept(estimate.inlier), estimate.cam_from_world
    return moved, CameraMotion(pose, picture)


def sow(landmarks: Landmarks, grey: UInt8[np.ndarray, "H W"], view: View) -> Landmarks:
    """Add corners where there are none; with depth only where it has no edge."""
    free = np.ones(grey.shape, dtype=np.uint8)
    for x, y in landmarks.uv_px:
        cv2.circle(free, (int(x), int(y)), _CELL_PX, 0, -1)
    new = corners(grey, free > 0, cell_px=_CELL_PX, count=_COUNT - len(landmarks.uv_px))
    depth_m, flat = view.depth_at(new)
    if view.depth_m is not None:
        new, depth_m = new[flat], depth_m[flat]
    point = view.lift(new, depth_m)
    return Landmarks(np.concatenate([landmarks.uv_px, new]), np.concatenate([landmarks.point_world, point]))
