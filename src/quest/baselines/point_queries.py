"""What baselines share: accepting point queries, lifting pixels by the clip's depth, answering."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int

from quest.data.cut import cut_clip
from quest.errors import ConfigError, InputError
from quest.geometry import invert, lift, project, transform
from quest.types import Clip, Query, State, Tracks

OCCLUDED_BY_M = 0.05
"""Depth that is nearer than a point by more than this is something in front of it."""

NO_DEPTH = "clip without depth: world points are missing"
NO_FIRST_DEPTH = "query {name!r}: no depth around its pixel at frame {frame}; world points are missing until there is"


def check_point_queries(
    clip: Clip, queries: Sequence[Query] | None, *, tracker: str
) -> tuple[Int[np.ndarray, " K"], Float32[np.ndarray, "K 2"]]:
    """Frame and pixel of each query.

    Raises:
        ConfigError: no queries (discovery), or a query that is not a point.
        InputError: a query's frame or pixel is outside the clip.
    """
    if queries is None or any(q.kind != "point" for q in queries):
        asked = "discovery (no query)" if queries is None else next(q.kind for q in queries if q.kind != "point")
        raise ConfigError(
            f"tracker {tracker!r}: expected point queries, got {asked}; this tracker follows given points"
        )
    w, h = clip.camera.width, clip.camera.height
    for q in queries:
        assert q.uv_px is not None  # a point query carries a pixel by construction
        if q.frame >= len(clip):
            raise InputError(f"query {q.name!r}: expected a frame below {len(clip)} of {clip.name!r}, got {q.frame}")
        if not (0 <= q.uv_px[0] <= w and 0 <= q.uv_px[1] <= h):
            raise InputError(f"query {q.name!r}: expected a pixel within {w} x {h}, got {q.uv_px}")
    frame = np.array([q.frame for q in queries], dtype=np.int64)
    uv_px = np.array([q.uv_px for q in queries], dtype=np.float32).reshape(-1, 2)
    return frame, uv_px


def answers(
    clip: Clip,
    queries: Sequence[Query],
    *,
    uv_px: Float[np.ndarray, "T K 2"],
    point_world: Float[np.ndarray, "T K 3"],
    visible: Bool[np.ndarray, "T K"],
    held: Bool[np.ndarray, "T K"] | bool = False,
    confidence: Float32[np.ndarray, "T K"],
    flags: tuple[str, ...] = (),
) -> Tracks:
    """Tracks of queries, whose names are made up where they have none.

    What is visible is being tracked; what is not is held where ``held`` says so, and lost elsewhere.
    """
    hidden = np.where(held, State.HELD.value, State.LOST.value)
    return Tracks(
        names=_names(queries),
        labels=tuple(q.label for q in queries),
        uv_px=uv_px.astype(np.float32),
        point_world=point_world.astype(np.float32),
        confidence=confidence,
        visible=visible,
        state=np.where(visible, State.TRACKING.value, hidden),
        stamp_s=clip.stamp_s,
        frame_flags=flags,
    )


def _names(queries: Sequence[Query]) -> tuple[str, ...]:
    return tuple(q.name or f"point-{i}" for i, q in enumerate(queries))


def lift_pixels(clip: Clip, uv_px: Float32[np.ndarray, "T K 2"], *, window_px: int = 3) -> Float32[np.ndarray, "T K 3"]:
    """World points of pixels, metres, by the median of the valid depths in a small window.

    The median keeps one stray pixel at a depth edge from throwing the point onto the background. NaN where the pixel is
    NaN or outside the image, or has no depth around it.
    """
    if clip.depth_m is None:
        return np.full((*uv_px.shape[:2], 3), np.nan, dtype=np.float32)
    height, width = clip.depth_m.shape[1:]
    column, row = np.floor(np.nan_to_num(uv_px, nan=-1e6)).astype(np.int64).transpose(2, 0, 1)
    # A pixel on the right or lower border belongs to the last column or row.
    column = np.where(uv_px[..., 0] == width, width - 1, column)
    row = np.where(uv_px[..., 1] == height, height - 1, row)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    reach = np.arange(window_px) - window_px // 2
    rows = row[..., None, None] + reach[:, None]
    columns = column[..., None, None] + reach[None, :]
    valid = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width) & inside[..., None, None]
    frames = np.arange(len(clip))[:, None, None, None]
    depth_m = clip.depth_m[frames, np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    depth_m = np.where(valid & np.isfinite(depth_m) & (depth_m > 0), depth_m, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=RuntimeWarning)  # a window without depth has a NaN median: wanted
        middle_m = np.nanmedian(depth_m, axis=(-2, -1)).astype(np.float32)
    point_cam = lift(torch.from_numpy(np.ascontiguousarray(uv_px)), torch.from_numpy(middle_m), clip.camera)
    world_from_cam = invert(torch.from_numpy(np.ascontiguousarray(clip.cam_from_world))).to(torch.float64)
    point_world = transform(world_from_cam[:, None], point_cam.to(torch.float64))
    return point_world.numpy().astype(np.float32)


def project_points(clip: Clip, point_world: Float32[np.ndarray, "T K 3"]) -> Float32[np.ndarray, "T K 2"]:
    """Pixels of world points in each frame; NaN where there is no point in front of the camera."""
    cam_from_world = torch.from_numpy(np.ascontiguousarray(clip.cam_from_world)).to(torch.float64)
    point_cam = transform(cam_from_world[:, None], torch.from_numpy(point_world).to(torch.float64))
    return project(point_cam, clip.camera).numpy().astype(np.float32)


def unoccluded(clip: Clip, point_world: Float32[np.ndarray, "T K 3"]) -> Bool[np.ndarray, "T K"]:
    """Whether world points are in the image and nothing is measured in front of them; False for NaN."""
    uv_px = project_points(clip, point_world)
    width, height = clip.camera.width, clip.camera.height
    inside = np.asarray(((uv_px >= 0) & (uv_px < (width, height))).all(axis=-1))
    if clip.depth_m is None:
        return inside
    column, row = np.where(inside[..., None], uv_px, 0).astype(np.int64).transpose(2, 0, 1)
    measured_m = clip.depth_m[np.arange(len(clip))[:, None], row, column]
    pose = clip.cam_from_world
    point_m = np.einsum("tc,tkc->tk", pose[:, 2, :3], point_world) + pose[:, 2, 3:]
    return inside & ~((measured_m > 0) & (measured_m < point_m - OCCLUDED_BY_M))


def depth_flags(clip: Clip, queries: Sequence[Query], point_world: Float32[np.ndarray, "T K 3"]) -> tuple[str, ...]:
    """In words, what missing depth does to the answers."""
    if clip.depth_m is None:
        return (NO_DEPTH,)
    return tuple(
        NO_FIRST_DEPTH.format(name=name, frame=q.frame)
        for k, (q, name) in enumerate(zip(queries, _names(queries), strict=True))
        if not np.isfinite(point_world[q.frame, k]).all()
    )


def hold_last(point: Float[np.ndarray, "T K C"], *, first: Int[np.ndarray, " K"]) -> Float[np.ndarray, "T K C"]:
    """Replace missing points by the last one before them; frames before ``first`` stay missing."""
    t, k = point.shape[:2]
    frames = np.arange(t)[:, None]
    known = np.isfinite(point).all(axis=-1) & (frames >= first)
    last = np.maximum.accumulate(np.where(known, frames, -1), axis=0)
    held = point[np.maximum(last, 0), np.arange(k)]
    return np.where((last >= 0)[..., None], held, np.nan).astype(point.dtype)


Followed = tuple[Float32[np.ndarray, "T K 2"], Bool[np.ndarray, "T K"], Float32[np.ndarray, "T K"]]
"""Pixels, whether they are visible, and how confident that is, from 0 to 1."""


class PointTracker(ABC):
    """Follows points forward from their frames through pictures.

    Pixels are lifted by the median of the valid depths in 3 x 3 pixels.
    """

    name: str
    protocols = ("point",)

    @abstractmethod
    def follow(self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]) -> Followed:
        """Where points go from their pixels (centres at half-integers) in their first frames, one of which is frame 0.

        What is said of a query's own frame and of earlier ones does not count.
        """

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Follow each point query forward from its frame.

        Returns:
            One track per query; NaN before its frame. World points are held where depth is missing or the point is
            not visible, because its pixel shows something else; ``frame_flags`` tell of missing depth.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip.
        """
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        t, k = len(clip), len(queries)
        uv_px, confidence = np.full((t, k, 2), np.nan, np.float32), np.zeros((t, k), np.float32)
        visible, start = np.zeros((t, k), dtype=bool), int(first.min(initial=t))
        if k:
            followed = self.follow(cut_clip(clip, slice(start, None)), first - start, uv_first)
            uv_px[start:], visible[start:], confidence[start:] = followed
        early, each = np.arange(t)[:, None] < first, np.arange(k)
        uv_px[early], visible[early], confidence[early] = np.nan, False, 0
        uv_px[first, each], visible[first, each], confidence[first, each] = uv_first, True, 1
        point_world = lift_pixels(clip, uv_px)
        held = hold_last(np.where(visible[..., None], point_world, np.float32(np.nan)), first=first)
        flags = depth_flags(clip, queries, point_world)
        return answers(
            clip, queries, uv_px=uv_px, point_world=held, visible=visible, confidence=confidence, flags=flags
        )
