"""Pyramidal Lucas-Kanade, chained from frame to frame and lifted by depth.

Reference: Lucas and Kanade, An iterative image registration technique, 1981; Bouguet, Pyramidal implementation of the
Lucas Kanade feature tracker, 2001 (OpenCV's ``calcOpticalFlowPyrLK``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from quest.baselines.point_queries import check_point_queries, depth_flags, hold_last, lift_pixels, query_names
from quest.types import Clip, Query, State, Tracks


@dataclass(frozen=True)
class LucasKanade:
    """Chains sparse optical flow; a point that the flow loses stays where it was last seen.

    Attributes:
        window_px: side of the matched window, pixels.
        levels: pyramid levels above the image itself.
        depth_window_px: odd side of the window whose median depth lifts a pixel.
    """

    window_px: int = 21
    levels: int = 3
    depth_window_px: int = 3

    # Without annotations these are attributes of the class, not fields.
    name = "lk"
    protocols = ("point",)

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Track each point query forward from its frame.

        Args:
            clip: frames; depth is needed for world points.
            queries: point queries.

        Returns:
            One track per query; NaN before its frame. Where depth is missing the last world point is held; where it
            is missing from the start this is told in ``frame_flags``. Confidence is 1 while tracking, 0 when lost.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip.
        """
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        uv_px, alive = self._chain(clip.rgb, first, uv_first)
        point_world = lift_pixels(clip, uv_px, window_px=self.depth_window_px)
        flags = depth_flags(clip, queries, point_world)
        # A lost point is held in the world too: its pixel may by now show something else.
        point_world = hold_last(np.where(alive[..., None], point_world, np.nan).astype(np.float32), first=first)
        asked = np.arange(len(clip))[:, None] >= first
        state = np.where(alive, State.TRACKING.value, State.LOST.value)
        return Tracks(
            names=query_names(queries),
            labels=tuple(q.label for q in queries),
            uv_px=uv_px,
            point_world=point_world,
            confidence=alive.astype(np.float32),
            visible=alive & asked,
            state=state,
            stamp_s=clip.stamp_s,
            frame_flags=flags,
        )

    def _chain(
        self, rgb: UInt8[np.ndarray, "T H W 3"], first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]
    ) -> tuple[Float32[np.ndarray, "T K 2"], Bool[np.ndarray, "T K"]]:
        """Pixels per frame, and whether the point is still being tracked."""
        t, k = len(rgb), len(first)
        height, width = rgb.shape[1:3]
        uv_px = np.full((t, k, 2), np.nan, dtype=np.float32)
        alive = np.zeros((t, k), dtype=bool)
        previous = None
        for frame in range(t if k else 0):
            grey = cv2.cvtColor(np.ascontiguousarray(rgb[frame]), cv2.COLOR_RGB2GRAY)
            if frame > 0:
                uv_px[frame] = uv_px[frame - 1]
                moving = np.flatnonzero(alive[frame - 1])
                if len(moving) and previous is not None:
                    found, seen = self._step(previous, grey, uv_px[frame - 1, moving])
                    seen &= ((found >= 0) & (found <= (width, height))).all(axis=-1)
                    uv_px[frame, moving[seen]] = found[seen]
                    alive[frame, moving] = seen
            born = first == frame
            uv_px[frame, born], alive[frame, born] = uv_first[born], True
            previous = grey
        return uv_px, alive

    def _step(
        self, previous: np.ndarray, grey: np.ndarray, uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """Where points went in one frame, and whether the flow found them. OpenCV's pixel centres are at integers."""
        start = np.ascontiguousarray(uv_px - 0.5, dtype=np.float32)[:, None]
        window = (self.window_px, self.window_px)
        guess = np.empty_like(start)
        found, status, _ = cv2.calcOpticalFlowPyrLK(previous, grey, start, guess, winSize=window, maxLevel=self.levels)
        end = np.asarray(found, dtype=np.float32)[:, 0] + np.float32(0.5)
        return end, (np.asarray(status)[:, 0] == 1) & np.isfinite(end).all(axis=-1)
