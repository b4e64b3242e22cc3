"""Following points from frame to frame: what all trackers share that know nothing but the newest position."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from quest.baselines.point_queries import check_point_queries, depth_flags, hold_last, lift_pixels, query_names
from quest.track.preprocess import grey_of
from quest.types import Clip, Query, State, Tracks


class Chained(ABC):
    """Chains a step from frame to frame.

    A point that is not found stays where it was, and is looked for from there in the next frame; one that leaves the
    image is lost for good. Pixels are lifted by the median of the valid depths in 3 x 3 pixels.
    """

    name: str
    protocols = ("point",)

    @abstractmethod
    def step(
        self, previous: UInt8[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """Where points of one frame are in the next one, and which of them were found there.

        Args:
            previous: grey values of the frame in which the points are.
            grey: grey values of the next one.
            uv_px: pixels, centres at half-integers.
        """

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
        point_world = lift_pixels(clip, uv_px)
        flags = depth_flags(clip, queries, point_world)
        # A lost point is held in the world too: its pixel may by now show something else.
        point_world = hold_last(np.where(alive[..., None], point_world, np.nan).astype(np.float32), first=first)
        return Tracks(
            names=query_names(queries),
            labels=tuple(q.label for q in queries),
            uv_px=uv_px,
            point_world=point_world,
            confidence=alive.astype(np.float32),
            visible=alive,
            state=np.where(alive, State.TRACKING.value, State.LOST.value),
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
        alive, gone = np.zeros((t, k), dtype=bool), np.zeros(k, dtype=bool)
        previous = None
        for frame in range(t if k else 0):
            grey = grey_of(rgb[frame])
            if previous is not None:
                uv_px[frame] = uv_px[frame - 1]
                asked = np.flatnonzero((first < frame) & ~gone)
                if len(asked):
                    found, seen = self.step(previous, grey, uv_px[frame, asked])
                    inside = ((found >= 0) & (found <= (width, height))).all(axis=-1)
                    gone[asked] = seen & ~inside
                    kept = seen & inside
                    uv_px[frame, asked[kept]], alive[frame, asked] = found[kept], kept
            born = first == frame
            uv_px[frame, born], alive[frame, born] = uv_first[born], True
            previous = grey
        return uv_px, alive
