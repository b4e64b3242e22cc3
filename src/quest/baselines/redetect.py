"""No queries: entities are detected anew in every window and linked to the nearest previous one.

The ablation of persistent queries. Detections are what the tracker's finder finds, by the threshold of discovery;
nothing of an entity is remembered but where it was.

Reference: Bewley et al., Simple Online and Realtime Tracking, ICIP 2016, for linking detections by place alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import linear_sum_assignment

from quest.baselines.point_queries import NO_DEPTH, answers, check_point_queries, lift_pixels, project_points
from quest.data.cut import cut_clip
from quest.track import Tracker
from quest.types import LABELS, Clip, Query, Tracks

REACH = 0.25
"""Farthest that a detection is linked, in half widths of the view at the depth of what is linked, and at which a point
query binds, in half widths of the image."""
NOTHING_FOUND = "nothing was detected in the first frame"


@dataclass(frozen=True)
class Detections:
    """What is found in one frame, best first."""

    uv_px: Float32[np.ndarray, "N 2"]
    """Pixels of the source image."""
    point_world: Float32[np.ndarray, "N 3"]
    """Lifted points, metres; NaN without depth."""
    label: tuple[str, ...]
    confidence: Float32[np.ndarray, " N"]


class Redetect:
    """Tracks by detection.

    A point query binds to the nearest detection at its frame, without queries everything that is detected in frame 0 is
    followed. From then on, in every ``every``-th frame, detections are linked to tracks one to one, nearest first in
    all (Hungarian), by the distance of their points, or of their pixels where depth is missing. A track that nothing is
    linked to stays where it was, and so do all of them between detections. Nothing is random.
    """

    protocols = ("point", "semantic")

    def __init__(self, name: str, tracker: Tracker, *, every: int = 4) -> None:
        self.tracker = tracker
        self.weights_hash = tracker.weights_hash
        self.every = every
        self.name = name

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Track point queries, or all that is detected in frame 0; visible means linked at the newest detection.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip.
        """
        flags = (NO_DEPTH,) if clip.depth_m is None else ()
        start = self.detect(clip, 0)
        if queries is None:
            inside = start.uv_px.clip(0, (clip.camera.width, clip.camera.height))
            at = zip(inside.tolist(), start.label, strict=True)
            queries = [Query.point(0, x, y, name=f"{label} {k}", label=label) for k, ((x, y), label) in enumerate(at)]
            flags += () if queries else (NOTHING_FOUND,)
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        rows = _Rows(len(clip), len(queries))
        for t in range(len(clip)):
            rows.hold(t)
            born, alive = np.flatnonzero(first == t), np.flatnonzero(first < t)
            if len(born) or t % self.every == 0:
                seen = self.detect(clip, t) if t > 0 else start
                if t % self.every == 0:
                    self._link(rows, alive, seen, clip, t)
                self._bind(rows, born, uv_first[born], seen, clip, t)
        return rows.tracks(clip, queries, flags)

    def detect(self, clip: Clip, t: int) -> Detections:
        """What is found in frame ``t``."""
        found = self.tracker.find(clip.rgb[t])
        kept = np.flatnonzero((found.p > self.tracker.config.threshold) & np.isin(found.labels, LABELS))
        found, uv_px = found.select(kept), found.uv_px[kept].astype(np.float32)
        point = lift_pixels(cut_clip(clip, slice(t, t + 1)), uv_px[None])[0]
        return Detections(uv_px, point, found.labels, found.p.astype(np.float32))

    def _bind(
        self, rows: _Rows, born: np.ndarray, uv_px: Float32[np.ndarray, "B 2"], seen: Detections, clip: Clip, t: int
    ) -> None:
        """Point queries begin at the nearest detection; one that has none in reach begins, and stays, at its pixel."""
        rows.uv_px[t, born] = uv_px
        rows.point_world[t, born] = lift_pixels(cut_clip(clip, slice(t, t + 1)), uv_px[None])[0]
        which, detection = link(_gap_in_image(uv_px, seen, clip))
        rows.set(t, born[which], seen, detection)

    def _link(self, rows: _Rows, alive: np.ndarray, seen: Detections, clip: Clip, t: int) -> None:
        rows.visible[t, alive] = False
        point, pose = rows.point_world[t, alive], clip.cam_from_world[t]
        in_space = np.linalg.norm(point[:, None] - seen.point_world[None], axis=-1)
        half_m = (point @ pose[2, :3] + pose[2, 3]) * max(clip.camera.width, clip.camera.height) / 2 / clip.camera.fx
        in_image = _gap_in_image(rows.uv_px[t, alive], seen, clip)
        which, detection = link(np.where(np.isfinite(in_space), in_space / np.maximum(half_m, 1e-6)[:, None], in_image))
        rows.set(t, alive[which], seen, detection)


def _gap_in_image(uv_px: Float32[np.ndarray, "K 2"], seen: Detections, clip: Clip) -> Float[np.ndarray, "K N"]:
    """Distances of pixels from detections, in half widths of the image."""
    gap_px = np.linalg.norm(uv_px[:, None] - seen.uv_px[None], axis=-1)
    return gap_px / (max(clip.camera.width, clip.camera.height) / 2)


def link(gap: Float[np.ndarray, "K N"], reach: float = REACH) -> tuple[np.ndarray, np.ndarray]:
    """Tracks and detections that belong together: as many pairs within reach as possible, then the least distance.

    Returns:
        Indices of tracks and, beside them, of detections.
    """
    allowed = gap <= reach
    # One forbidden pair costs more than all allowed ones together.
    cost = np.where(allowed, gap, 1.0 + reach * max(gap.shape, default=0))
    rows, columns = linear_sum_assignment(cost)
    kept = allowed[rows, columns]
    return rows[kept], columns[kept]


class _Rows:
    """The answers of K tracks as they are filled in."""

    def __init__(self, frames: int, tracks: int) -> None:
        self.uv_px = np.full((frames, tracks, 2), np.nan, np.float32)
        self.point_world = np.full((frames, tracks, 3), np.nan, np.float32)
        self.confidence = np.zeros((frames, tracks), np.float32)
        self.visible = np.zeros((frames, tracks), bool)

    def hold(self, t: int) -> None:
        """Begin a frame with the answers of the one before."""
        if t > 0:
            for values in (self.uv_px, self.point_world, self.confidence, self.visible):
                values[t] = values[t - 1]

    def set(self, t: int, tracks: np.ndarray, seen: Detections, detections: np.ndarray) -> None:
        """Move tracks to detections; where depth is missing the last world point stays."""
        self.uv_px[t, tracks] = seen.uv_px[detections]
        point = seen.point_world[detections]
        known = np.isfinite(point).all(axis=-1)
        self.point_world[t, tracks[known]] = point[known]
        self.confidence[t, tracks] = seen.confidence[detections]
        self.visible[t, tracks] = True

    def tracks(self, clip: Clip, queries: Sequence[Query], flags: tuple[str, ...]) -> Tracks:
        """The answers; a held world point is seen where the camera is by now."""
        held = np.zeros(self.visible.shape, bool)
        held[1:] = (self.point_world[1:] == self.point_world[:-1]).all(axis=-1)
        projected = project_points(clip, self.point_world)
        return answers(
            clip,
            queries,
            uv_px=np.where((held & np.isfinite(projected).all(axis=-1))[..., None], projected, self.uv_px),
            point_world=self.point_world,
            visible=self.visible,
            held=np.asarray(np.isfinite(self.uv_px).all(axis=-1)),
            confidence=self.confidence,
            flags=flags,
        )
