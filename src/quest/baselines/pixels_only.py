"""QueST without 3D: it is shown colours only, and its pixels are lifted afterwards, for the metric alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quest.baselines.point_queries import hold_last, lift_pixels
from quest.track.tracker import DEFAULT_ALPHA, Tracker
from quest.types import Clip, Query, Tracks


class PixelsOnly(Tracker):
    """A tracker that never sees depth; made by :meth:`without_depth`."""

    name = "quest-pixels"

    @classmethod
    def without_depth(cls, name: str, tracker: Tracker) -> PixelsOnly:
        """A tracker's networks and settings without depth."""
        other = cls(
            tracker.network,
            tracker.config,
            device=tracker.device,
            weights_hash=tracker.weights_hash,
            calibrations=tracker.calibrations,
            noise=tracker.noise,
        )
        other.name = name
        return other

    def track(
        self, clip: Clip, queries: Sequence[Query] | None = None, *, alpha: float | None = DEFAULT_ALPHA
    ) -> Tracks:
        """As :meth:`quest.track.Tracker.track`, by colours alone.

        Returns:
            Pixels of the tracker. World points are these pixels lifted by the median of the valid depths in 3 x 3
            pixels; where there are none, the last world point.
        """
        tracks = super().track(replace(clip, depth_m=None), queries, alpha=alpha)
        begun = np.isfinite(tracks.uv_px).all(axis=-1)
        first = np.where(begun.any(axis=0), begun.argmax(axis=0), len(clip))
        lifted = hold_last(lift_pixels(clip, tracks.uv_px), first=first)
        return replace(tracks, point_world=lifted.astype(np.float32))
