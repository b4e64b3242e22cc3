"""Clips, takes and tracks as a LeRobot v3 dataset that lerobot's own loader reads.

Each episode has its own data file and one video per view, which the format allows. Every episode of a dataset has the
same features, so joints and entities have numbered places: an episode with fewer leaves the last ones empty, and which
is which stands in the columns ``quest/joints`` and ``quest/entities`` of ``meta/episodes``, intrinsics of each view in
``quest/camera/VIEW``. Statistics of features, by which policies normalise, are those that LeRobot keeps.

References: lerobot 0.6.2, ``lerobot/datasets`` (``utils.py``, ``feature_utils.py``, ``dataset_metadata.py``,
``compute_stats.py``); Chan, Golub and LeVeque 1979 for merging variances.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, Shaped

from quest.data.lerobot import CAMERA_COLUMN, CAMERA_KEY, POSE, STAMP, VERSION, DepthRange
from quest.data.recording import whole_folder
from quest.data.video import frame_rate, write_depth_video, write_video
from quest.depth import clean_depth
from quest.errors import InputError
from quest.types import Clip, State, Take, Tracks

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATE, TRACKS = "observation.state", "observation.tracks"
CHUNK_FILES = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
Stats = dict[str, np.ndarray]

_TRACKED = (
    ("uv_px", "float32", (".x", ".y"), np.nan),
    ("point_world", "float32", (".x", ".y", ".z"), np.nan),
    ("visible", "bool", ("",), False),
    ("confidence", "float32", ("",), 0.0),
)
"""Of tracks: field, element type, what is behind the name of each place, and the value of empty places."""
_VIEW_NAME = re.compile(r"[A-Za-z0-9_]+")
_CRF = 18
_KEYFRAME_EVERY = 2
_FRAMES = 100
_SIDE = 100


def feature_stats(values: Shaped[np.ndarray, "T *n"]) -> Stats:
    """Of a number or a vector per frame; what is not finite is left out, and a place without a value has zeros."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    columns = [column[np.isfinite(column)] for column in rows.T]
    columns = [column if column.size else np.zeros(1) for column in columns]
    measures = {"min": np.min, "max": np.max, "mean": np.mean, "std": np.std}
    found = {name: np.array([measure(column) for column in columns]) for name, measure in measures.items()}
    found |= {name: np.array([np.quantile(column, q) for column in columns]) for name, q in QUANTILES.items()}
    return found | {"count": np.array([len(rows)])}


def image_stats(pictures: Shaped[np.ndarray, "T H W *C"], scale: float) -> Stats:
    """Of up to a hundred pictures, thinned to about a hundred pixels a side, per channel and divided by ``scale``.

    All but the count have the shape (channels, 1, 1).
    """
    index = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _FRAMES)).round().astype(int))
    step = max(1, max(pictures.shape[1:3]) // _SIDE)
    sample = pictures[index][:, ::step, ::step]
    channels = sample.shape[3] if sample.ndim == 4 else 1
    found = feature_stats(sample.reshape(-1, channels).astype(np.float64) / scale)
    return {name: value.reshape(-1, 1, 1) for name, value in found.items()} | {"count": np.array([len(index)])}


def merge_stats(first: Stats | None, second: Stats) -> Stats:
    """Of two parts together. Quantiles cannot be merged: the outer of both is kept, which bounds them."""
    if first is None:
        return second
    counts = np.array([first["count"][0], second["count"][0]], dtype=np.float64)
    share = counts / counts.sum()
    mean = share[0] * first["mean"] + share[1] * second["mean"]
    parts = zip(share, (first, second), strict=True)
    variance = sum(weight * (part["std"] ** 2 + (part["mean"] - mean) ** 2) for weight, part in parts)
    outer = {"min": np.minimum, "max": np.maximum}
    outer |= {name: np.minimum if q <= 0.5 else np.maximum for name, q in QUANTILES.items()}
    known = {"mean": mean, "std": np.sqrt(variance), "count": first["count"] + second["count"]}
    names = ("min", "max", *known, *QUANTILES)
    return {name: known[name] if name in known else outer[name](first[name], second[name]) for name in names}


@dataclass(frozen=True)
class Episode:
    """One episode to write."""

    views: dict[str, Clip]
    """Clips of the same moments, by the name of their camera: letters, digits and underscores."""
    task: str
    """What is done, in words."""
    joint_position: Float32[np.ndarray, "T J"] | None = None
    """Radians or metres per frame; None without a state."""
    joint_names: tuple[str, ...] = ()
    """Of its columns."""
    tracks: dict[str, Tracks] = field(default_factory=dict)
    """Answers or truth per view, all of the same entities; empty without."""

    @classmethod
    def of_take(cls, take: Take, *, task: str | None = None) -> Episode:
        """A simulated take with its truth: joint positions, and the tracks of its entities but the hinges."""
        kept = take.tracked
        names = tuple(take.info.entities[i].name for i in kept)
        labels = tuple(take.info.entities[i].label for i in kept)
        point, shape = take.point_world[:, kept].astype(np.float32), (len(take), len(kept))
        sure, state = np.ones(shape, np.float32), np.full(shape, State.TRACKING.value)
        tracks = {}
        for v, view in enumerate(take.views):
            uv_px, visible = view.uv_px[:, kept].astype(np.float32), view.visible[:, kept]
            tracks[f"view_{v}"] = Tracks(names, labels, uv_px, point, sure, visible, state, take.stamp_s)
        return cls(
            {f"view_{v}": view.clip for v, view in enumerate(take.views)},
            task or f"open {take.info.category}",
            take.joint_position.astype(np.float32),
            tuple(joint.name for joint in take.info.joints),
            tracks,
        )


def export_lerobot(
    episodes: Iterable[Episode],
    folder: str | Path,
    *,
    fps: int | None = None,
    joints: int | None = None,
    entities: int | None = None,
    depth_range: DepthRange | None = None,
    robot_type: str | None = None,
) -> int:
    """Write a LeRobot v3.0 dataset, all or nothing; returns the number of episodes.

    Features: ``observation.images.VIEW`` (H.264), ``observation.images.VIEW_depth`` (HEVC, twelve bits),
    ``observation.state`` (joint positions), ``observation.tracks.VIEW.uv_px``, ``.point_world``, ``.visible`` and
    ``.confidence``, ``observation.cam_from_world.VIEW``, ``observation.stamp_s``, and those that LeRobot always has.
    Its ``timestamp`` is the frame's index over ``fps``, as LeRobot requires; the true time is ``observation.stamp_s``.

    Args:
        episodes: read one after the other; all have the same views, sizes and kinds of content.
        folder: where to; must not exist, or be empty.
        fps: frames per second; by default that of the first clip, rounded.
        joints: places for joints; by default as many as the first episode has.
        entities: places for tracks; likewise.
        depth_range: how depth is quantised; by default as lerobot does, which ends at 10 m.
        robot_type: for ``meta/info.json``.

    Raises:
        InputError: the folder has something in it, there are no episodes, or an episode is unlike the first.
    """
    writer = None
    with whole_folder(folder, "dataset") as partial:
        for episode in episodes:
            if writer is None:
                writer = _Writer(partial, episode, fps, joints, entities, depth_range or DepthRange())
            writer.add(episode)
        if writer is None:
            raise InputError(f"dataset {folder}: expected at least one episode, got none")
        writer.finish(robot_type)
    return len(writer.rows)


Column = tuple[str, list[str] | None, np.ndarray]
"""Element type, names of the elements or None for a single number, and the values of every frame."""


class _Writer:
    """Writes episodes that are like the first one after the other, and what describes them at the end."""

    def __init__(
        self,
        root: Path,
        first: Episode,
        fps: int | None,
        joints: int | None,
        entities: int | None,
        depth_range: DepthRange,
    ) -> None:
        bad = [name for name in first.views if not _VIEW_NAME.fullmatch(name)]
        if bad or not first.views:
            raise InputError(
                f"dataset: expected views named by letters, digits and underscores, got {bad or 'no view'}"
            )
        self.rows: list[dict[str, Any]] = []
        self._root, self._depth_range, self._contents = root, depth_range, _contents(first)
        self._fps = max(1, round(frame_rate(next(iter(first.views.values())).stamp_s))) if fps is None else fps
        own_joints, own_entities = _places(first)
        self._joints = own_joints if joints is None else joints
        self._entities = own_entities if entities is None else entities
        self._cameras = {view: asdict(clip.camera) for view, clip in first.views.items()}
        self._features: dict[str, Any] = {}
        self._tasks: dict[str, int] = {}
        self._frames = 0
        self._stats: dict[str, Stats] = {}

    def add(self, episode: Episode) -> None:
        index, frames = len(self.rows), self._check(episode)
        columns = self._columns(episode, frames)
        place = {"chunk_index": index // CHUNK_FILES, "file_index": index % CHUNK_FILES}
        _write_rows(columns, self._root / DATA_PATH.format(**place))
        stats = {key: feature_stats(values) for key, (_, _, values) in columns.items()}
        row: dict[str, Any] = {"episode_index": index, "tasks": [episode.task], "length": frames}
        row |= {f"data/{name}": value for name, value in place.items()}
        row |= {"dataset_from_index": self._frames, "dataset_to_index": self._frames + frames}
        for view, clip in episode.views.items():
            camera = row[f"{CAMERA_COLUMN}/{view}"] = asdict(clip.camera)
            if camera != self._cameras.get(view):
                self._cameras.pop(view, None)  # what is said of all episodes must hold for all
            for key, info, pictures, scale in self._films(view, clip, place):
                shape, names = [*clip.rgb.shape[1:3], info["video.channels"]], ["height", "width", "channels"]
                self._features[key] = {"dtype": "video", "shape": shape, "names": names, "info": info}
                stats[key] = image_stats(pictures, scale)
                row |= {f"videos/{key}/{name}": value for name, value in place.items()}
                row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": frames / self._fps}
        for key, (dtype, names, _) in columns.items():
            self._features[key] = {"dtype": dtype, "shape": [len(names or [""])], "names": names}
        row |= {"quest/joints": list(episode.joint_names)}
        row |= {"quest/entities": list(next((tracks.names for tracks in episode.tracks.values()), ()))}
        row |= {f"stats/{key}/{name}": v.tolist() for key, found in stats.items() for name, v in found.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._stats = {key: merge_stats(self._stats.get(key), found) for key, found in stats.items()}
        self.rows.append(row)
        self._frames += frames

    def finish(self, robot_type: str | None) -> None:
        meta = self._root / "meta"
        episodes = meta / "episodes" / "chunk-000" / "file-000.parquet"
        episodes.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self.rows), episodes)
        _write_tasks(self._tasks, meta / "tasks.parquet")
        for view, camera in self._cameras.items():
            self._features[f"observation.images.{view}"]["info"][CAMERA_KEY] = camera
        info = {
            "codebase_version": VERSION,
            "fps": self._fps,
            "features": self._features,
            "total_episodes": len(self.rows),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "robot_type": robot_type,
            "splits": {"train": f"0:{len(self.rows)}"},
        }
        stats = {key: {name: v.tolist() for name, v in found.items()} for key, found in self._stats.items()}
        for name, content in (("info.json", info), ("stats.json", stats)):
            (meta / name).write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")

    def _check(self, episode: Episode) -> int:
        """Number of frames of an episode; InputError if it does not fit."""
        where, joint_position = f"dataset: episode {len(self.rows)}", episode.joint_position
        lengths = {len(clip) for clip in episode.views.values()} | {len(tracks) for tracks in episode.tracks.values()}
        lengths |= set() if joint_position is None else {len(joint_position)}
        if len(lengths) != 1:
            raise InputError(f"{where}: views, joints and tracks are of {sorted(lengths)} frames, expected one number")
        if (found := _contents(episode)) != self._contents:
            raise InputError(f"{where}: {found}; expected those of the first episode: {self._contents}")
        joints, entities = _places(episode)
        if joints > self._joints or entities > self._entities or (self._joints and joint_position is None):
            raise InputError(
                f"{where}: {joints} joints and {entities} entities do not fit {self._joints} and {self._entities} "
                "places; say how many places the dataset needs"
            )
        return lengths.pop()

    def _columns(self, episode: Episode, frames: int) -> dict[str, Column]:
        """What the data file holds of an episode; empty places are 0, NaN or False."""
        found: dict[str, Column] = {}
        if self._joints and episode.joint_position is not None:
            names = [f"joint_{j}" for j in range(self._joints)]
            found[STATE] = "float32", names, _filled(episode.joint_position, self._joints, 0.0)
        places = [f"entity_{e}" for e in range(self._entities)]
        for view, clip in episode.views.items():
            for what, dtype, axes, empty in _TRACKED if view in episode.tracks and places else ():
                values = _filled(getattr(episode.tracks[view], what), len(places), empty).reshape(frames, -1)
                names = [f"{place}{axis}" for place in places for axis in axes]
                found[f"{TRACKS}.{view}.{what}"] = dtype, names, values
            names = [f"m{row}{column}" for row in range(4) for column in range(4)]
            found[f"{POSE}.{view}"] = "float64", names, clip.cam_from_world.reshape(frames, 16)
        found[STAMP] = "float64", None, next(iter(episode.views.values())).stamp_s
        found["timestamp"] = "float32", None, (np.arange(frames) / self._fps).astype(np.float32)
        counters: dict[str, Any] = {"frame_index": np.arange(frames), "episode_index": len(self.rows)}
        counters |= {"index": self._frames + np.arange(frames)}
        counters |= {"task_index": self._tasks.setdefault(episode.task, len(self._tasks))}
        return found | {key: ("int64", None, np.full(frames, value, np.int64)) for key, value in counters.items()}

    def _films(
        self, view: str, clip: Clip, place: dict[str, int]
    ) -> Iterator[tuple[str, dict[str, Any], np.ndarray, float]]:
        """Write the videos of a view; feature, what describes it, pictures, and what divides them in statistics."""
        height, width = clip.rgb.shape[1:3]
        info = {"video.height": height, "video.width": width, "video.fps": self._fps, "has_audio": False}
        key, odd = f"observation.images.{view}", height % 2 or width % 2
        path = self._root / VIDEO_PATH.format(video_key=key, **place)
        write_video(path, clip.rgb, frames_per_s=self._fps, crf=_CRF, keyframe_every=_KEYFRAME_EVERY)
        colours = {"video.codec": "h264", "video.pix_fmt": "yuv444p" if odd else "yuv420p", "video.channels": 3}
        yield key, info | colours | {"is_depth_map": False}, clip.rgb, 255.0
        if clip.depth_m is None:
            return
        key += "_depth"
        path = self._root / VIDEO_PATH.format(video_key=key, **place)
        codes = (self._depth_range.codes(clean_depth(depth_m)) for depth_m in clip.depth_m)
        write_depth_video(path, codes, frames_per_s=self._fps)
        depth = {"video.codec": "hevc", "video.pix_fmt": "gray12le", "video.channels": 1}
        depth |= {"is_depth_map": True, "depth_unit": "m"}
        depth |= {f"video.{name}": value for name, value in asdict(self._depth_range).items()}
        yield key, info | depth, clip.depth_m, 1.0


def _contents(episode: Episode) -> str:
    """What all episodes of a dataset have alike, in words."""
    sizes = {name: clip.rgb.shape[1:3] for name, clip in sorted(episode.views.items())}
    deep = sorted(name for name, clip in episode.views.items() if clip.depth_m is not None)
    return f"views {sizes}, depth of {deep}, tracks of {sorted(episode.tracks)}"


def _places(episode: Episode) -> tuple[int, int]:
    """How many joints and entities an episode has."""
    joints = 0 if episode.joint_position is None else episode.joint_position.shape[1]
    return joints, max((len(tracks.names) for tracks in episode.tracks.values()), default=0)


def _filled(value: np.ndarray, places: int, empty: float) -> np.ndarray:
    """The second axis at full length."""
    pad = [(0, 0), (0, places - value.shape[1]), *[(0, 0)] * (value.ndim - 2)]
    return np.pad(value, pad, constant_values=empty)


def _write_rows(columns: dict[str, Column], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {}
    for key, (dtype, names, values) in columns.items():
        flat = pa.array(values.ravel(), pa.bool_() if dtype == "bool" else pa.type_for_alias(dtype))
        size = len(names or [""])  # LeRobot keeps features of one number as numbers
        arrays[key] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    pq.write_table(pa.table(arrays), path)


def _write_tasks(tasks: dict[str, int], path: Path) -> None:
    """The table of tasks, indexed by their words, which lerobot learns by pandas from the metadata."""

    def column(name: str | None, kind: str, numpy_kind: str, metadata: dict[str, str] | None = None) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": metadata}

    words = {
        "index_columns": ["task"],
        "column_indexes": [column(None, "unicode", "object", {"encoding": "UTF-8"})],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": pa.array(list(tasks))})
    pq.write_table(table.replace_schema_metadata({b"pandas": json.dumps(words).encode()}), path)
