"""The filter by itself: local motion, camera motion and what rests in the world, without any network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quest.baselines.chained import grey_of
from quest.baselines.point_queries import check_point_queries, depth_flags, hold_last, query_names
from quest.filter.noise import Noise
from quest.filter.step import ask, begin, read_off, step
from quest.filter.view import View
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

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Track each point query forward from its frame.

        Args:
            clip: frames; depth is needed for world points.
            queries: point queries.

        Returns:
            One track per query; NaN before its frame. Missing depth is told in ``frame_flags``.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip.
        """
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        t, k = len(clip), len(queries)
        uv_px, point = np.full((t, k, 2), np.nan, np.float32), np.full((t, k, 3), np.nan, np.float32)
        visible, order = np.zeros((t, k), dtype=bool), np.argsort(first, kind="stable")
        posed = bool(np.ptp(clip.cam_from_world, axis=0).any())
        state = None
        for i in range(t):
            grey, frame = grey_of(clip.rgb[i]), clip.frame(i)
            if state is None:
                view = View(clip.camera.matrix.astype(np.float64), frame.cam_from_world, frame.depth_m)
                state = begin(grey, view, frame.stamp_s, self.noise)
            else:
                pose = frame.cam_from_world if posed else None
                state = step(state, grey, frame.depth_m, frame.stamp_s, pose, self.noise)
            asked = np.flatnonzero(first == i)
            if len(asked):
                state = ask(state, uv_first[np.sort(asked)].astype(np.float64), self.noise)
            known, answer = order[: len(state.queries)], read_off(state, self.noise)
            uv_px[i, known], point[i, known], visible[i, known] = answer.uv_px, answer.point_world, answer.visible
        asked_at = np.arange(t)[:, None] >= first
        return Tracks(
            names=query_names(queries),
            labels=tuple(q.label for q in queries),
            uv_px=uv_px,
            point_world=hold_last(point, first=first),
            confidence=visible.astype(np.float32),
            visible=visible,
            state=np.where(visible, State.TRACKING.value, np.where(asked_at, State.HELD.value, State.LOST.value)),
            stamp_s=clip.stamp_s,
            frame_flags=depth_flags(clip, queries, point),
        )
