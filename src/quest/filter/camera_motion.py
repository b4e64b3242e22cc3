"""Evidence of camera motion: the pose that takes the points of the still world to where they are seen.

Poses are not chained: points keep the world point of their birth, and a pose is fitted to all that are in view.

Reference: Lepetit et al., EPnP, IJCV 2009; Fischler and Bolles, Random sample consensus, 1981.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from quest.filter.view import View

INLIER_PX = 2.5
LEAST = 12
"""Fewer points that agree are no pose."""
_LEAST_PX = 0.7
"""Error of points that drift together, under which a camera is not said to move."""


def estimate_pose(
    point_world: Float[np.ndarray, "N 3"],
    uv_px: Float[np.ndarray, "N 2"],
    matrix: Float[np.ndarray, "3 3"],
    expected: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "4 4"], Bool[np.ndarray, " N"]] | None:
    """The camera's pose from where points of the still world are seen, and which of them agree with it.

    The search begins at ``expected``; None where fewer than :data:`LEAST` points agree.
    """
    if len(point_world) < LEAST:
        return None
    turn, shift = cv2.Rodrigues(expected[:3, :3])[0], expected[:3, 3:].copy()
    done, turn, shift, inliers = cv2.solvePnPRansac(
        point_world, uv_px, matrix, None, turn, shift, True, 300, INLIER_PX, 0.999, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not done or inliers is None or len(inliers) < LEAST:
        return None
    agree = np.asarray(inliers, dtype=np.int64)[:, 0]
    turn, shift = cv2.solvePnPRefineLM(point_world[agree], uv_px[agree], matrix, None, turn, shift)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    inlier = np.zeros(len(point_world), dtype=bool)
    inlier[agree] = True
    return pose, inlier


def stands_still(
    point_world: Float[np.ndarray, "N 3"],
    uv_px: Float[np.ndarray, "N 2"],
    before: View,
    after: View,
) -> bool:
    """Whether a new pose explains where points are seen no better than the old one.

    It must fit most points at least as well, and all of them by more than six parameters may (Schwarz, 1978).
    """
    off = [((view.project(point_world)[0] - uv_px) ** 2).sum(axis=-1) for view in (before, after)]
    kept = [np.nan_to_num(each, nan=np.inf).clip(max=INLIER_PX**2) for each in off]
    variance = max(float(np.median(kept[1])) / np.log(4), _LEAST_PX**2)
    # What fits most points worse follows something that moves.
    worse = float(np.median(kept[1])) > float(np.median(kept[0]))
    return worse or bool((kept[0].sum() - kept[1].sum()) / variance < 6 * np.log(len(uv_px)))


def apart_px(point_world: Float[np.ndarray, "N 3"], one: View, other: View) -> float:
    """How far apart points are in two views, the median in pixels."""
    apart = np.linalg.norm(one.project(point_world)[0] - other.project(point_world)[0], axis=-1)
    return float(np.median(np.nan_to_num(apart, nan=np.inf)))


def picture_motion(from_px: Float[np.ndarray, "N 2"], to_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "3 3"]:
    """The homography that most points agree on, where no depth says more; the identity where too few do."""
    if len(from_px) < LEAST:
        return np.eye(3)
    motion, _ = cv2.findHomography(from_px, to_px, cv2.RANSAC, INLIER_PX)
    return np.eye(3) if motion is None else np.asarray(motion, dtype=np.float64)
