"""The baseline that any tracker has to beat: the first position for ever."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quest.baselines.point_queries import (
    check_point_queries,
    depth_flags,
    lift_pixels,
    project_points,
    query_names,
    unoccluded,
)
from quest.types import Clip, Query, State, Tracks


class HoldStill:
    """Answers every frame with the position of the query.

    The pixel is lifted once, at the query's frame; the world point then stays, and a moving camera sees it elsewhere.
    It is seen unless it is out of view or something is in front of it. Without depth the pixel stays, and is seen.

    Args:
        name: what tables call it; the name of the class by default.
    """

    name = "hold-still"
    protocols = ("point",)

    def __init__(self, name: str = "") -> None:
        self.name = name or self.name

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Hold the position of each point query.

        Args:
            clip: frames; depth is needed at the queries' frames for world points.
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
        asked = np.arange(t)[:, None] >= first
        uv_px = np.broadcast_to(uv_first, (t, k, 2)).astype(np.float32)
        at_first = lift_pixels(clip, uv_px)[first, np.arange(k)]
        point_world = np.where(asked[..., None], at_first, np.nan).astype(np.float32)
        flags = depth_flags(clip, queries, point_world)
        seen = project_points(clip, point_world)
        uv_px = np.where(np.isfinite(seen), seen, uv_px)
        visible = asked & (unoccluded(clip, point_world) | np.isnan(point_world).any(axis=-1))
        return Tracks(
            names=query_names(queries),
            labels=tuple(q.label for q in queries),
            uv_px=np.where(asked[..., None], uv_px, np.nan).astype(np.float32),
            point_world=point_world,
            confidence=asked.astype(np.float32),
            visible=visible,
            state=np.where(visible, State.TRACKING.value, np.where(asked, State.HELD.value, State.LOST.value)),
            stamp_s=clip.stamp_s,
            frame_flags=flags,
        )
