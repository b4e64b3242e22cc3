"""Ask trackers about videos with labelled points as TAP-Vid and TAPVid-3D do, and make rows of their answers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from quest.baselines import ClipTracker, Inputs
from quest.baselines.point_queries import lift_pixels
from quest.evaluation.bootstrap import Pool
from quest.evaluation.metrics import Sums
from quest.evaluation.real.run import KeptAnswers, RealRow, asked, kept_or_asked, rows_of, shown
from quest.evaluation.tables import Column
from quest.evaluation.tapvid.scores import (
    PIXELS,
    Answered,
    Queries,
    Scaling,
    redetection,
    survival,
    tapvid3d_scores,
    tapvid_scores,
)
from quest.evaluation.tapvid.videos import SIDE_PX, PointVideo, read_video
from quest.types import Clip, Query

COLUMNS = (
    Column("average_jaccard", "AJ", 1, 100.0, 0),
    Column("average_pts_within_thresh", "<δ avg", 1, 100.0, 1),
    Column("occlusion_accuracy", "OA", 1, 100.0, 2),
    Column("redetection", "AJ_RD", 1, 100.0, 3),
    Column("survival", "survival", 1, 100.0, 3),
    *(Column(f"pts_within_{d}", f"<{d} px", 1, 100.0, 4) for d in PIXELS),
)
"""What is shown of a row, in this order; the result file has everything."""

LEGEND = "percent; below each number the 95 % bootstrap interval over videos. n: videos/tracks/queries"


@dataclass(frozen=True)
class Setting:
    """How trackers are asked and judged."""

    queries: Queries = "first"
    """In which frames."""
    scaling: Scaling = "median"
    """Of answers in space."""
    square: bool = True
    """Whether videos of TAP-Vid are scaled to 256 x 256."""
    alone: bool = False
    """Whether each query has a run of its own."""


@dataclass(frozen=True)
class _Scored:
    """One tracker in one video."""

    tracks: int
    queries: int
    scores: Mapping[str, float]


def evaluate_videos(
    files: Mapping[str, Path],
    trackers: Sequence[ClipTracker],
    setting: Setting,
    *,
    resamples: int,
    seed: int,
    kept: KeptAnswers | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[list[RealRow], list[RealRow]]:
    """Score trackers on videos.

    Answers are kept as they come in ``kept``; ``progress`` is told after each video how many are done.

    Returns:
        Rows of the table, and rows of each video.

    Raises:
        InputError: a file cannot be used.
    """
    found: dict[tuple[str, str, Inputs], dict[str, _Scored]] = {}
    for number, (name, path) in enumerate(files.items(), 1):
        video = read_video(path, name=name, square=setting.square)
        track, frame, uv_px = video.queries(setting.queries)
        ways, both_ways = shown(video.clip), setting.queries == "strided" or video.point_cam is not None
        for tracker, inputs in asked(trackers, ways):
            ask = partial(follow, tracker, ways[inputs], frame, uv_px, both_ways=both_ways, alone=setting.alone)
            answers = kept_or_asked(kept, name, tracker.name, inputs, ask)
            for of, scores in _scores(video, track, frame, answers, setting):
                scored = _Scored(len(np.unique(track)), len(track), scores)
                found.setdefault((of, tracker.name, inputs), {})[f"{name}, {of}"] = scored
        progress(number)
    by_table = dict(sorted(found.items(), key=lambda item: item[0][0]))
    return rows_of(by_table, partial(_row, seed=seed), resamples)


def follow(
    tracker: ClipTracker,
    clip: Clip,
    frame: Int[np.ndarray, " Q"],
    uv_px: Float[np.ndarray, "Q 2"],
    *,
    both_ways: bool,
    alone: bool = False,
) -> dict[str, np.ndarray]:
    """A tracker's answers to point queries.

    Args:
        tracker: whom to ask.
        clip: what it is shown.
        frame: of each query.
        uv_px: its pixel; what is out of the image is asked for at the border.
        both_ways: answers in frames ahead of the query are those in the reversed clip.
        alone: ask for each query in a run of its own.

    Returns:
        ``uv_px`` [T, Q, 2], ``point_cam`` [T, Q, 3] in the axes of each frame's camera, and ``visible`` [T, Q].
    """
    if alone:
        each = [follow(tracker, clip, frame[[i]], uv_px[[i]], both_ways=both_ways) for i in range(len(frame))]
        return {key: np.concatenate([answers[key] for answers in each], axis=1) for key in each[0]}
    size, pose = (clip.camera.width, clip.camera.height), clip.cam_from_world
    points = [Query.point(int(t), *map(float, np.clip(uv, 0, size))) for t, uv in zip(frame, uv_px, strict=True)]
    tracks = tracker.track(clip, points)
    point_cam = np.einsum("tij,tqj->tqi", pose[:, :3, :3], tracks.point_world) + pose[:, None, :3, 3]
    answers = {"uv_px": tracks.uv_px, "point_cam": point_cam.astype(np.float32), "visible": tracks.visible}
    if not both_ways or not frame.any():
        return answers
    turned = replace(
        clip,
        rgb=np.ascontiguousarray(clip.rgb[::-1]),
        depth_m=None if clip.depth_m is None else np.ascontiguousarray(clip.depth_m[::-1]),
        cam_from_world=np.ascontiguousarray(pose[::-1]),
    )
    other = follow(tracker, turned, len(clip) - 1 - frame, uv_px, both_ways=False)
    ahead = np.arange(len(clip))[:, None] < frame
    return {k: np.where(ahead if a.ndim == 2 else ahead[..., None], other[k][::-1], a) for k, a in answers.items()}


def _scores(
    video: PointVideo, track: np.ndarray, frame: np.ndarray, answers: Mapping[str, np.ndarray], setting: Setting
) -> Iterator[tuple[str, dict[str, float]]]:
    """By the title of the table: in pictures; and in space, of videos with points and depth there."""
    camera, occluded, said_occluded = video.clip.camera, video.occluded[track], ~answers["visible"].T
    scale = SIDE_PX / np.array([camera.width, camera.height])
    flat = Answered(frame, occluded, video.uv_px[track] * scale, said_occluded, answers["uv_px"].swapaxes(0, 1) * scale)
    returns = redetection(flat)
    more = {
        "redetection": np.nan if np.isnan(returns).all() else np.nanmean(returns),
        "survival": survival(flat).mean(),
    }
    scores = {**tapvid_scores(flat, queries=setting.queries).named(), **more}
    yield f"2D, {setting.queries}", {key: float(value) for key, value in scores.items()}
    still = shown(video.clip).get("depth")
    if video.point_cam is not None and still is not None:
        lifted, said = lift_pixels(still, answers["uv_px"].astype(np.float32)), answers["point_cam"]
        said = np.where(np.isfinite(said), said, lifted).swapaxes(0, 1)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) * scale.max()
        space = Answered(frame, occluded, video.point_cam[track], said_occluded, said.astype(float))
        scores = tapvid3d_scores(space, intrinsics, scaling=setting.scaling).named()
        yield f"3D, {setting.queries}, scale: {setting.scaling}", {key: float(v) for key, v in scores.items()}


def _row(of: str, tracker: str, inputs: Inputs, scored: Sequence[_Scored], resamples: int, *, seed: int) -> RealRow:
    """Means over videos; those in which nothing is counted are left out."""
    pool = Pool(scored, resamples=resamples, seed=seed)
    values = {name: np.array([s.scores[name] for s in scored]) for name in scored[0].scores}
    measures = {name: pool.ratio(Sums(np.nan_to_num(v), (~np.isnan(v)).astype(float))) for name, v in values.items()}
    tracks, queries = sum(s.tracks for s in scored), sum(s.queries for s in scored)
    return RealRow(of, tracker, inputs, len(scored), tracks, queries, measures)
