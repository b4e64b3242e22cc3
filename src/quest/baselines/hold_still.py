"""What any tracker has to beat: nothing moves, or nothing but the camera, whose poses are chained from its own frames.

Reference: Lepetit et al., EPnP, IJCV 2009, and Fischler and Bolles, Random sample consensus, 1981 (OpenCV's
``solvePnPRansac``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from quest.baselines.chained import checked_flow
from quest.baselines.point_queries import (
    answers,
    check_point_queries,
    depth_flags,
    lift_pixels,
    project_points,
    unoccluded,
)
from quest.data.cut import cut_clip
from quest.track.preprocess import grey_of
from quest.types import Clip, Query, Tracks

_CORNERS, _LEAST_CORNERS = 500, 12
_INLIER_PX = 2.0


class HoldStill:
    """Answers every frame with the first position of the query.

    The pixel is lifted once, at the query's frame; the world point then stays, and a moving camera sees it elsewhere.
    It is seen unless it is out of view or something is in front of it. Without depth the pixel stays, and is seen.
    """

    name = "hold-still"
    protocols = ("point",)

    def __init__(self, name: str = "") -> None:
        self.name = name or self.name

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Hold the position of each point query; as :meth:`quest.baselines.point_queries.PointTracker.track`."""
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        t, k = len(clip), len(queries)
        asked = np.arange(t)[:, None] >= first
        uv_px = np.broadcast_to(uv_first, (t, k, 2)).astype(np.float32)
        at_first = lift_pixels(clip, uv_px)[first, np.arange(k)]
        point_world = np.where(asked[..., None], at_first, np.nan).astype(np.float32)
        seen = project_points(clip, point_world)
        uv_px = np.where(np.isfinite(seen), seen, uv_px)
        visible = asked & (unoccluded(clip, point_world) | np.isnan(point_world).any(axis=-1))
        return answers(
            clip,
            queries,
            uv_px=np.where(asked[..., None], uv_px, np.nan),
            point_world=point_world,
            visible=visible,
            held=asked,
            confidence=asked.astype(np.float32),
            flags=depth_flags(clip, queries, point_world),
        )


class StillWorld(HoldStill):
    """Holds the query's world point and estimates how the camera moves; the poses of the clip are not used."""

    name = "world-pnp"

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """As :meth:`HoldStill.track`; without depth nothing is known of the camera, and pixels stay."""
        poses = np.tile(clip.cam_from_world[:1], (len(clip), 1, 1)) if clip.depth_m is None else camera_poses(clip)
        return super().track(replace(clip, cam_from_world=poses), queries)


def camera_poses(clip: Clip) -> Float[np.ndarray, "T 4 4"]:
    """``cam_from_world`` by Lucas-Kanade and PnP with RANSAC from frame to frame, chained from the clip's first pose.

    The clip needs depth. A step in which too few corners are followed repeats the pose.
    """
    poses = [clip.cam_from_world[0]]
    previous = grey_of(clip.rgb[0])
    for t in range(1, len(clip)):
        grey, step = grey_of(clip.rgb[t]), np.eye(4)
        corners = cv2.goodFeaturesToTrack(previous, _CORNERS, 0.005, 8)
        if corners is not None:
            uv_px = np.asarray(corners, dtype=np.float32)[:, 0] + np.float32(0.5)
            found, good = checked_flow(previous, grey, uv_px)
            alone = replace(cut_clip(clip, slice(t - 1, t)), cam_from_world=np.eye(4)[None])
            point = lift_pixels(alone, uv_px[None])[0]
            good &= np.isfinite(point).all(axis=-1)
            step = _motion(point[good], found[good], clip.camera.matrix)
        poses.append(step @ poses[-1])
        previous = grey
    return np.stack(poses)


def _motion(
    point: Float[np.ndarray, "N 3"], uv_px: Float[np.ndarray, "N 2"], matrix: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "4 4"]:
    """The camera's motion that takes points of its frame, metres, to pixels; none where too few agree."""
    motion = np.eye(4)
    if len(point) < _LEAST_CORNERS:
        return motion
    done, turn, shift, inliers = cv2.solvePnPRansac(
        point, uv_px, matrix, None, reprojectionError=_INLIER_PX, iterationsCount=300
    )
    if done and inliers is not None and len(inliers) >= _LEAST_CORNERS:
        motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return motion
