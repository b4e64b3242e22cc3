"""The filter by itself: local motion, rigid bodies, and likeness to the anchor by dense features."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from jaxtyping import UInt8

from quest.baselines.chained import grey_of
from quest.baselines.point_queries import check_point_queries, depth_flags, hold_last, query_names
from quest.filter.noise import Noise
from quest.filter.picture import Picture
from quest.filter.step import ask, begin, read_off, step
from quest.filter.view import View
from quest.model.xfeat import XFeat
from quest.types import Clip, Query, State, Tracks


class Filtered:
    """Follows points by the filter; given poses are used if they move, and estimated from the picture if not.

    Args:
        noise: its parameters.
    """

    name = "quest-filter"
    protocols = ("point",)

    def __init__(self, noise: Noise | None = None) -> None:
        self.noise = Noise() if noise is None else noise

    @cached_property
    def network(self) -> XFeat:
        """Loaded when it is first needed."""
        return XFeat.from_package()

    @torch.no_grad()
    def picture(self, rgb: UInt8[np.ndarray, "H W 3"]) -> Picture:
        """What the filter reads of a frame."""
        grey = grey_of(rgb)
        return Picture(grey, self.network.features(torch.from_numpy(grey))[0].numpy())

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Track each point query forward from its frame.

        Args:
            clip: frames; depth is needed for world points.
            queries: point queries.

        Returns:
            One track per query; NaN before its frame. Missing depth is told in ``frame_flags``.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip, or pictures with a side below 32 pixels.
        """
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        t, k = len(clip), len(queries)
        uv_px, point = np.full((t, k, 2), np.nan, np.float32), np.full((t, k, 3), np.nan, np.float32)
        lost_p = np.full((t, k), np.nan, np.float32)
        visible, order = np.zeros((t, k), dtype=bool), np.argsort(first, kind="stable")
        posed = bool(np.ptp(clip.cam_from_world, axis=0).any())
        state = None
        for i in range(t):
            picture, frame = self.picture(clip.rgb[i]), clip.frame(i)
            if state is None:
                view = View(clip.camera.matrix.astype(np.float64), frame.cam_from_world, frame.depth_m)
                state = begin(picture, view, frame.stamp_s, self.noise)
            else:
                pose = frame.cam_from_world if posed else None
                state = step(state, picture, frame.depth_m, frame.stamp_s, pose, self.noise)
            asked = np.flatnonzero(first == i)
            if len(asked):
                state = ask(state, uv_first[np.sort(asked)].astype(np.float64), self.noise)
            known, answer = order[: len(state.queries)], read_off(state, self.noise)
            uv_px[i, known], point[i, known], visible[i, known] = answer.uv_px, answer.point_world, answer.visible
            lost_p[i, known] = answer.lost_p
        lost = ~(lost_p <= 0.5)
        return Tracks(
            names=query_names(queries),
            labels=tuple(q.label for q in queries),
            uv_px=uv_px,
            point_world=hold_last(point, first=first),
            confidence=np.nan_to_num(1 - lost_p),
            visible=visible,
            state=np.where(lost, State.LOST.value, np.where(visible, State.TRACKING.value, State.HELD.value)),
            stamp_s=clip.stamp_s,
            lost_p=lost_p,
            frame_flags=depth_flags(clip, queries, point),
        )
