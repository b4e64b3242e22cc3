"""QueST without 3D: it is shown colours only, and its pixels are lifted afterwards, for the metric alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from quest.baselines.point_queries import hold_last, lift_pixels
from quest.geometry.letterbox import Letterbox
from quest.model.discovery import Peaks
from quest.track.tracker import DEFAULT_ALPHA, Tracker
from quest.types import Camera, Clip, Frame, Query, Tracks


class PixelsOnly(Tracker):
    """A tracker that never sees depth; made by :meth:`without_depth`."""

    name = "quest-pixels"

    @classmethod
    def without_depth(cls, tracker: Tracker, *, name: str = "quest-pixels") -> PixelsOnly:
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

    def candidates(self, camera: Camera, frame: Frame) -> Peaks:
        """As :meth:`quest.track.Tracker.candidates`, by colours alone; their points are lifted as those of tracks."""
        peaks = super().candidates(camera, replace(frame, depth_m=None))
        if frame.depth_m is None:
            return peaks
        size = self.network.config.encoder.image_size
        uv_px = Letterbox(camera, size).to_source(peaks.uv.float().cpu().numpy() * size)
        alone = Clip("", camera, frame.rgb[None], frame.depth_m[None], np.zeros(1), np.eye(4, dtype=np.float32)[None])
        point = lift_pixels(alone, uv_px.astype(np.float32)[None])[0]
        return replace(peaks, point_m=torch.from_numpy(point).to(peaks.point_m))

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
