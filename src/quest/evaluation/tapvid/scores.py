"""The metrics of TAP-Vid and TAPVid-3D, re-detection and survival; ``docs/metrics.md`` defines them.

``N`` counts tracks (a point that is asked for in several frames is as many tracks), ``T`` frames, ``B`` videos; what
is 5 long goes by :data:`PIXELS`. A predicted point that is NaN is near nothing; a score of no frames is NaN.

Reference: Doersch et al. (2022), TAP-Vid: A Benchmark for Tracking Any Point in a Video, section 3; Koppula et al.
(2024), TAPVid-3D, section 4; Jung et al. (2026), TAPNext++, arXiv 2604.10582 (re-detection); Zheng et al. (2023),
PointOdyssey (survival).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.errors import InputError

Queries = Literal["first", "strided"]
"""Every track is asked for once, at its first visible frame, or in every fifth frame that shows it."""

Scaling = Literal["median", "per_trajectory", "local_neighborhood", "none"]
"""How predictions get the scale of the truth: by the medians of distances from the camera, one factor a video; by the
depth at the query, one factor a track; the same, and a track is judged by all points near its own; not at all."""

PIXELS = (1, 2, 4, 8, 16)
"""Distances below which a point is near, pixels of a 256 x 256 picture."""

METRES = (0.01, 0.04, 0.16, 0.64, 2.56)
"""The fixed distances of TAPVid-3D."""

LEAST_HIDDEN = (1, 4, 16, 64, 256)
"""Re-detection is the mean over returns after at least so many frames."""

_NEIGHBOUR_M = 0.05
_LEAST = 1e-12


@dataclass(frozen=True)
class Answered:
    """Tracks and a tracker's answers.

    Points are pixels of a picture scaled to 256 x 256, or metres in the axes of each frame's camera; any where it is
    occluded.
    """

    query_frame: Int[np.ndarray, "*B N"]
    """Frame in which each track is asked for."""
    occluded: Bool[np.ndarray, "*B N T"]
    points: Float[np.ndarray, "*B N T C"]
    said_occluded: Bool[np.ndarray, "*B N T"]
    said_points: Float[np.ndarray, "*B N T C"]
    """The answer; in space of any scale."""

    @property
    def since_query(self) -> Int[np.ndarray, "*B N T"]:
        """Frames since the query, negative ahead of it."""
        return np.arange(self.occluded.shape[-1]) - self.query_frame[..., None]

    @property
    def gap(self) -> Float[np.ndarray, "*B N T"]:
        """Distance of the answer from the truth."""
        return np.sqrt(np.square(self.said_points - self.points).sum(axis=-1))


@dataclass(frozen=True)
class PointScores:
    """Of each video, or of each track."""

    occlusion_accuracy: Float[np.ndarray, "*B"]
    """Share of frames in which occluded is called occluded, and visible visible."""
    within: Float[np.ndarray, "5 *B"]
    """Share of visible points that are near, called visible or not."""
    jaccard: Float[np.ndarray, "5 *B"]
    """Points that are visible, called so and near, by all that are visible or wrongly called so."""

    def named(self) -> dict[str, Float[np.ndarray, "*B"]]:
        """By the benchmark's own names."""
        near = {f"pts_within_{d}": share for d, share in zip(PIXELS, self.within, strict=True)}
        jaccard = {f"jaccard_{d}": share for d, share in zip(PIXELS, self.jaccard, strict=True)}
        means = {"average_jaccard": self.jaccard.mean(0), "average_pts_within_thresh": self.within.mean(0)}
        scores = {**means, "occlusion_accuracy": self.occlusion_accuracy, **near, **jaccard}
        return {name: np.asarray(values) for name, values in scores.items()}


def tapvid_scores(a: Answered, *, queries: Queries, per_track: bool = False) -> PointScores:
    """The metrics of TAP-Vid, in pixels: of the frames after the query (``first``), or of all but it (``strided``)."""
    judged = a.since_query > 0 if queries == "first" else a.since_query != 0
    inside = _inside(a.said_points - a.points, PIXELS)
    return _scores(_counts(a.occluded, a.said_occluded, inside, judged), per_track=per_track)


def tapvid3d_scores(
    a: Answered,
    intrinsics: Float[np.ndarray, "*B 4"],
    *,
    scaling: Scaling = "median",
    fixed: bool = False,
    per_track: bool = False,
) -> PointScores:
    """The metrics of TAPVid-3D, in metres, of all frames; near is below what so many pixels measure at the true depth.

    Args:
        a: tracks and answers.
        intrinsics: fx, fy, cx, cy of pictures whose shorter side is 256 pixels.
        scaling: of the answers.
        fixed: near is below each of :data:`METRES` instead.
        per_track: scores of every track, and not of every video.

    Raises:
        InputError: several videos with ``local_neighborhood``.
    """
    points, said, occluded = a.points, a.said_points, a.occluded
    pixel_m = points[..., 2] / np.sqrt(intrinsics[..., 0] * intrinsics[..., 1])[..., None, None]
    reach = [np.full(occluded.shape, d) if fixed else p * pixel_m for p, d in zip(PIXELS, METRES, strict=True)]
    scale = np.ones((1, 1, 1), said.dtype)
    if scaling == "median":
        hidden = occluded | a.said_occluded
        scale = _median_norm(points, hidden) / _median_norm(said, hidden)
    elif scaling != "none":
        frame = a.query_frame[..., None]
        true_z, said_z = (np.maximum(np.take_along_axis(p[..., 2], frame, axis=-1), _LEAST) for p in (points, said))
        scale = true_z[..., None] / said_z[..., None]
    if scaling != "local_neighborhood":
        inside = _inside(said * scale - points, reach)
        return _scores(_counts(occluded, a.said_occluded, inside, np.ones_like(occluded)), per_track=per_track)
    if points.ndim != 3:
        raise InputError(f"local_neighborhood: expected one video, points [N, T, 3], got {points.shape}")
    tracks = []
    for i, own in enumerate(points):
        near = np.square(points - own).sum(axis=-1) < _NEIGHBOUR_M**2
        inside = _inside(said[near] * scale[i, 0] - points[near], [distance[near] for distance in reach])
        counts = _counts(occluded[near], a.said_occluded[near], inside, np.ones_like(occluded[near]))
        tracks.append(counts * ((~occluded[i]).sum() / max(1.0, (~occluded[near]).sum())))
    return _scores(np.stack(tracks, axis=-1), per_track=per_track)


def redetection(a: Answered) -> Float[np.ndarray, " 5"]:
    """Average Jaccard from a track's return to the end; of returns after :data:`LEAST_HIDDEN` frames, NaN without any.

    Of a track those returns count that come after a longer occlusion than all of its earlier ones. None is ahead of the
    query. The mean over what is not NaN is AJ_RD. One video, in pixels.
    """
    frame, away = np.arange(a.occluded.shape[1]), a.occluded & (a.since_query >= 0)
    seen_last = np.maximum.accumulate(np.where(away, -1, frame), axis=1)
    hidden, back = np.zeros(away.shape, int), np.zeros(away.shape, bool)
    hidden[:, 1:] = np.where(away[:, 1:], 0, (frame - seen_last)[:, :-1])  # frames that a return ends
    back[:, 1:] = hidden[:, 1:] > np.maximum.accumulate(hidden, axis=1)[:, :-1]
    hit = ~a.occluded & (a.gap <= np.reshape(PIXELS, (5, 1, 1)))  # here, at the distance is near
    true, seen, false = (
        what[..., ::-1].cumsum(axis=-1)[..., ::-1][..., back]
        for what in (hit & ~a.said_occluded, ~a.occluded, ~hit & ~a.said_occluded)
    )
    jaccard = (true / (seen + false)).mean(axis=0)
    counted = [jaccard[hidden[back] >= least] for least in LEAST_HIDDEN]
    return np.array([values.mean() if len(values) else np.nan for values in counted])


def survival(a: Answered, *, beyond_px: float = 50.0) -> Float[np.ndarray, "*B N"]:
    """Share of the frames from the query on until a visible point is first missed by more than so many pixels."""
    asked = a.since_query >= 0
    lost = np.maximum.accumulate(asked & ~a.occluded & ~(a.gap <= beyond_px), axis=-1)
    return (asked & ~lost).sum(axis=-1) / asked.sum(axis=-1)


def _inside(gap: Float[np.ndarray, "*P C"], reach: list[np.ndarray] | tuple[int, ...]) -> Bool[np.ndarray, "5 *P"]:
    squared = np.square(gap).sum(axis=-1)
    return np.stack([squared < np.square(distance) for distance in reach])


def _counts(
    occluded: Bool[np.ndarray, "*P T"],
    said_occluded: Bool[np.ndarray, "*P T"],
    inside: Bool[np.ndarray, "5 *P T"],
    judged: Bool[np.ndarray, "*P T"],
) -> Float[np.ndarray, "18 *P"]:
    """Of each track the judged frames, those that agree, the visible ones; near, true positive, false positive ones."""
    hit = inside & ~occluded
    plain = np.stack([judged, occluded == said_occluded, ~occluded])
    return (np.concatenate([plain, hit, hit & ~said_occluded, ~hit & ~said_occluded]) & judged).sum(axis=-1) * 1.0


def _scores(counts: Float[np.ndarray, "18 *B N"], *, per_track: bool) -> PointScores:
    judged, agree, seen, *by_distance = counts if per_track else counts.sum(axis=-1)
    near, true, false = np.reshape(by_distance, (3, len(PIXELS), *seen.shape))
    with np.errstate(divide="ignore", invalid="ignore"):  # nothing visible is NaN: wanted
        return PointScores(np.asarray(agree / judged), near / seen, true / (seen + false))


def _median_norm(points: Float[np.ndarray, "*B N T 3"], hidden: Bool[np.ndarray, "*B N T"]) -> np.ndarray:
    norm = np.where(hidden, np.nan, np.sqrt(np.maximum(_LEAST, np.square(points).sum(axis=-1))))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=RuntimeWarning)  # nothing visible is NaN: wanted
        return np.nanmedian(norm, axis=(-2, -1), keepdims=True)[..., None]
