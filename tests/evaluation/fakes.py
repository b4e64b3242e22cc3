"""Trackers that know the truth, so that the right score is known, and one that is stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from quest.baselines.hold_still import HoldStill
from quest.types import Clip, Query, State, Take, Tracks, View


class Oracle:
    """Answers with the truth of one take, changed by a function of the true pixels and world points.

    Without queries it answers one slot per entity of ``slots``.
    """

    def __init__(
        self,
        take: Take,
        *,
        name: str = "oracle",
        change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] = lambda uv, xyz: (uv, xyz),
        slots: Sequence[int] = (),
        labels: Sequence[str | None] | None = None,
        confidence: Sequence[float] | None = None,
    ) -> None:
        self.take = take
        self.name = name
        self.change = change
        self.slots = list(slots)
        self.labels = labels
        self.confidence = confidence
        self.asked: list[Query] = []
        self.network: object = None

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        view = next(v for v in self.take.views if v.clip.name == clip.name)
        if queries is None:
            entities, first = self.slots, [0] * len(self.slots)
            labels = [self.take.info.entities[e].label for e in entities] if self.labels is None else self.labels
        else:
            self.asked += queries
            entities, first = [self._entity(view, q) for q in queries], [q.frame for q in queries]
            labels = [None] * len(queries)
        t, k = len(clip), len(entities)
        uv, xyz = self.change(view.uv_px[:, entities].copy(), self.take.point_world[:, entities].copy())
        before = np.arange(t)[:, None] < np.array(first, dtype=int)
        uv[before], xyz[before] = np.nan, np.nan
        confidence = np.ones(k) if self.confidence is None else np.array(self.confidence)
        return Tracks(
            names=tuple(f"a{i}" for i in range(k)),
            labels=tuple(labels),
            uv_px=uv.astype(np.float32),
            point_world=xyz.astype(np.float32),
            confidence=np.broadcast_to(confidence, (t, k)).astype(np.float32),
            visible=np.ones((t, k), dtype=bool),
            state=np.full((t, k), State.TRACKING.value),
            stamp_s=clip.stamp_s,
        )

    def _entity(self, view: View, query: Query) -> int:
        gap = np.linalg.norm(view.uv_px[query.frame] - np.array(query.uv_px), axis=-1)
        return int(np.nanargmin(gap))


class Stopped(HoldStill):
    """Notes the clips that it is asked about, and is stopped after so many."""

    def __init__(self, after: int | None = None) -> None:
        super().__init__()
        self.clips: list[str] = []
        self._after = after

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        if len(self.clips) == self._after:
            raise KeyboardInterrupt
        self.clips.append(clip.name)
        return super().track(clip, queries)
