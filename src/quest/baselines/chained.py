"""Following points from frame to frame: what all trackers share that know nothing but the newest position."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from quest.baselines.point_queries import check_point_queries, tracks_of
from quest.track.preprocess import grey_of
from quest.types import Clip, Query, Tracks

Picture = TypeVar("Picture")
"""What a tracker looks at of a frame."""


class Chained(ABC, Generic[Picture]):
    """Chains a step from frame to frame.

    A point that is not found stays where it was, and is looked for from there in the next frame; one that leaves the
    image is lost for good. Pixels are lifted by the median of the valid depths in 3 x 3 pixels.
    """

    name: str
    protocols = ("point",)

    @abstractmethod
    def picture(self, clip: Clip, t: int) -> Picture:
        """What the step looks at of frame ``t``."""

    @abstractmethod
    def step(
        self, previous: Picture, picture: Picture, uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """Where points of one frame are in the next one, and which of them were found there.

        Args:
            previous: of the frame in which the points are.
            picture: of the next one.
            uv_px: pixels, centres at half-integers.
        """

    def resume(
        self,
        picture: Picture,
        origin: tuple[Picture, Float32[np.ndarray, " 2"]],
        uv_px: Float32[np.ndarray, " 2"],
        stepped: tuple[Float32[np.ndarray, " 2"], bool],
    ) -> tuple[Float32[np.ndarray, " 2"], bool]:
        """Where a point is that was not found in the previous frame; where the step says, if no tracker knows better.

        Args:
            picture: of this frame.
            origin: picture of the query's own frame, and its pixel there.
            uv_px: where the point is held.
            stepped: where the step has it now, and whether it found it.
        """
        return stepped

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
        uv_px, alive = self._chain(clip, first, uv_first)
        return tracks_of(clip, queries, uv_px, alive, alive.astype(np.float32))

    def _chain(
        self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]
    ) -> tuple[Float32[np.ndarray, "T K 2"], Bool[np.ndarray, "T K"]]:
        """Pixels per frame, and whether the point is still being tracked."""
        t, k = len(clip), len(first)
        size = (clip.camera.width, clip.camera.height)
        uv_px = np.full((t, k, 2), np.nan, dtype=np.float32)
        alive, gone = np.zeros((t, k), dtype=bool), np.zeros(k, dtype=bool)
        previous, origins = None, dict[int, tuple[Picture, Float32[np.ndarray, " 2"]]]()
        for frame in range(int(first.min(initial=t)), t):
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
        return uv_px, alive


class ChainedGrey(Chained[UInt8[np.ndarray, "H W"]]):
    """Chains a step that looks at grey values."""

    def picture(self, clip: Clip, t: int) -> UInt8[np.ndarray, "H W"]:
        """Luminance."""
        return grey_of(clip.rgb[t])
