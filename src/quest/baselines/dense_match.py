"""Every frame matched to the query's own by dense features; nothing is chained."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from quest.baselines.point_queries import check_point_queries, depth_flags, hold_last, lift_pixels, query_names
from quest.model.xfeat import XFeat, sample
from quest.types import Clip, Query, State, Tracks

LEAST_SIMILARITY = 0.6
"""Cosine above which the best match is said to be the point; set beforehand, not tuned on any recording."""


class DenseMatch:
    """Answers with the most similar place of the whole picture, be it similar or not; visible is what is similar."""

    name = "xfeat"
    protocols = ("point",)

    @cached_property
    def network(self) -> XFeat:
        """Loaded when it is first needed."""
        return XFeat.from_package()

    @torch.no_grad()
    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Match each point query in every frame after its own.

        Args:
            clip: frames; depth is needed for world points.
            queries: point queries.

        Returns:
            One track per query; NaN before its frame. World points are held where depth is missing or the point is
            not visible; ``frame_flags`` tell of missing depth. Confidence is the similarity, from 0 to 1.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip, or pictures with a side below 32 pixels.
        """
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        t, k = len(clip), len(queries)
        size = (clip.camera.width, clip.camera.height)
        uv_px, confidence = np.full((t, k, 2), np.nan, np.float32), np.zeros((t, k), np.float32)
        wanted = torch.zeros(k, 64)
        for i in range(int(first.min()) if k else t, t):
            grey = clip.rgb[i].mean(axis=-1, dtype=np.float32).astype(np.uint8)
            features, _ = self.network.features(torch.from_numpy(grey))
            known, born = np.flatnonzero(first < i), np.flatnonzero(first == i)
            uv_px[i, known], confidence[i, known] = best_match(features, wanted[known], size)
            uv_px[i, born], confidence[i, born] = uv_first[born], 1.0
            wanted[born] = sample(features, torch.from_numpy(uv_first[born]), size)
        visible = confidence > LEAST_SIMILARITY
        point_world = lift_pixels(clip, uv_px)
        return Tracks(
            names=query_names(queries),
            labels=tuple(q.label for q in queries),
            uv_px=uv_px,
            point_world=hold_last(np.where(visible[..., None], point_world, np.float32(np.nan)), first=first),
            confidence=confidence,
            visible=visible,
            state=np.where(visible, State.TRACKING.value, State.LOST.value),
            stamp_s=clip.stamp_s,
            frame_flags=depth_flags(clip, queries, point_world),
        )


def best_match(
    features: Float[Tensor, "D h w"], wanted: Float[Tensor, "M D"], size: tuple[int, int]
) -> tuple[Float32[np.ndarray, "M 2"], Float32[np.ndarray, " M"]]:
    """Pixel of the most similar cell, refined by a parabola along each axis, and its similarity from 0 to 1."""
    height, width = features.shape[1:]
    flat = (wanted @ features.flatten(1)).numpy()
    each, (rows, columns) = np.arange(len(flat)), np.divmod(flat.argmax(axis=1), width)
    # Mirrored, so that nothing is refined across a border.
    padded, best = np.pad(flat.reshape(-1, height, width), ((0, 0), (1, 1), (1, 1)), mode="reflect"), flat.max(axis=1)
    before = np.stack((padded[each, rows + 1, columns], padded[each, rows, columns + 1]), axis=-1)
    after = np.stack((padded[each, rows + 1, columns + 2], padded[each, rows + 2, columns + 1]), axis=-1)
    bend = np.maximum(2 * best[:, None] - before - after, 1e-9)
    cell = np.stack((columns, rows), axis=-1) + 0.5 + (after - before) / (2 * bend)
    return (cell * np.divide(size, (width, height))).astype(np.float32), best.clip(0, 1)
