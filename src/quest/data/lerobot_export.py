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
import shutil
import uuid
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, Shaped

from quest.data.lerobot import CAMERA_COLUMN, CAMERA_KEY, POSE, STAMP, VERSION, DepthRange
from quest.data.video import frame_rate, write_depth_video, write_video
from quest.depth import clean_depth
from quest.errors import InputError
from quest.types import Clip, State, Take, Tracks

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

_FRAMES = 100
_SIDE = 100

Stats = dict[str, np.ndarray]


def feature_stats(values: Shaped[np.ndarray, "T *n"]) -> Stats:
    """Of a number or a vector per frame; what is not finite is left out, and a place without a value has zeros."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    return _stats(rows) | {"count": np.array([len(rows)])}


def image_stats(pictures: Shaped[np.ndarray, "T H W *C"], scale: float) -> Stats:
    """Of up to a hundred pictures, thinned to about a hundred pixels a side, per channel and divided by ``scale``.

    All but the count have the shape (channels, 1, 1).
    """
    index = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _FRAMES)).round().astype(int))
    step = max(1, max(pictures.shape[1:3]) // _SIDE)
    sample = pictures[index][:, ::step, ::step]
    channels = sample.shape[3] if sample.ndim == 4 else 1
    found = _stats(sample.reshape(-1, channels).astype(np.float64) / scale)
    return {name: value.reshape(channels, 1, 1) for name, value in found.items()} | {"count": np.array([len(index)])}


def merge_stats(first: Stats | None, second: Stats) -> Stats:
    """Of two parts together. Quantiles cannot be merged: the outer of both is kept, which bounds them."""
    if first is None:
        return second
    counts = np.array([first["count"][0], second["count"][0]], dtype=np.float64)
    share = counts / counts.sum()
    mean = share[0] * first["mean"] + share[1] * second["mean"]
    variance = sum(
        weight * (part["std"] ** 2 + (part["mean"] - mean) ** 2)
        for weight, part in zip(share, (first, second), strict=True)
    )
    merged = {
        "min": np.minimum(first["min"], second["min"]),
        "max": np.maximum(first["max"], second["max"]),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": first["count"] + second["count"],
    }
    for name, q in QUANTILES.items():
        merged[name] = (np.minimum if q <= 0.5 else np.maximum)(first[name], second[name])
    return merged


def _stats(rows: np.ndarray) -> Stats:
    found = {name: np.zeros(rows.shape[1]) for name in ("min", "max", "mean", "std", *QUANTILES)}
    for column, values in enumerate(rows.T):
        finite = values[np.isfinite(values)]
        if finite.size == 0:
            continue
        found["min"][column], found["max"][column] = finite.min(), finite.max()
        found["mean"][column], found["std"][column] = finite.mean(), finite.std()
        for name, value in zip(QUANTILES, np.quantile(finite, list(QUANTILES.values())), strict=True):
            found[name][column] = value
    return found


STATE, TRACKS = "observation.state", "observation.tracks"

_VIEW_NAME = re.compile(r"[A-Za-z0-9_]+")
_COUNTERS = {"frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}


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
        tracks = {}
        for v, view in enumerate(take.views):
            visible = view.visible[:, kept]
            tracks[f"view_{v}"] = Tracks(
                names,
                labels,
                view.uv_px[:, kept].astype(np.float32),
                take.point_world[:, kept].astype(np.float32),
                np.ones(visible.shape, np.float32),
                visible,
                np.full(visible.shape, State.TRACKING.value),
                take.stamp_s,
            )
        return cls(
            {f"view_{v}": view.clip for v, view in enumerate(take.views)},
            task or f"open {take.info.category}",
            take.joint_position.astype(np.float32),
            tuple(joint.name for joint in take.info.joints),
            tracks,
        )


@dataclass(frozen=True)
class Layout:
    """What all episodes of a dataset share."""

    fps: int
    sizes: dict[str, tuple[int, int]]
    cameras: dict[str, dict[str, Any]]
    deep: frozenset[str]
    joints: int
    tracked: frozenset[str]
    entities: int
    depth_range: DepthRange

    @classmethod
    def of(
        cls, episode: Episode, fps: int | None, joints: int | None, entities: int | None, depth_range: DepthRange
    ) -> Layout:
        """The layout that an episode and what was asked for determine.

        Raises:
            InputError: no views, or a view whose name cannot be one of a feature.
        """
        bad = [name for name in episode.views if not _VIEW_NAME.fullmatch(name)]
        if bad or not episode.views:
            raise InputError(
                f"dataset: expected views named by letters, digits and underscores, got {bad or 'no view'}"
            )
        first = next(iter(episode.views.values()))
        own_joints = 0 if episode.joint_position is None else episode.joint_position.shape[1]
        own_entities = max((len(tracks.names) for tracks in episode.tracks.values()), default=0)
        return cls(
            fps=max(1, round(frame_rate(first.stamp_s))) if fps is None else fps,
            sizes={name: clip.rgb.shape[1:3] for name, clip in episode.views.items()},
            cameras={name: asdict(clip.camera) for name, clip in episode.views.items()},
            deep=frozenset(name for name, clip in episode.views.items() if clip.depth_m is not None),
            joints=own_joints if joints is None else joints,
            tracked=frozenset(episode.tracks),
            entities=own_entities if entities is None else entities,
            depth_range=depth_range,
        )

    def check(self, episode: Episode, index: int) -> int:
        """Number of frames of an episode; InputError if it does not fit."""
        where = f"dataset: episode {index}"
        lengths = {len(clip) for clip in episode.views.values()} | {len(tracks) for tracks in episode.tracks.values()}
        lengths |= set() if episode.joint_position is None else {len(episode.joint_position)}
        if len(lengths) != 1:
            raise InputError(f"{where}: views, joints and tracks are of {sorted(lengths)} frames, expected one number")
        sizes = {name: clip.rgb.shape[1:3] for name, clip in episode.views.items()}
        deep = {name for name, clip in episode.views.items() if clip.depth_m is not None}
        if sizes != self.sizes or deep != self.deep or set(episode.tracks) != self.tracked:
            raise InputError(
                f"{where}: views {sizes}, depth of {sorted(deep)}, tracks of {sorted(episode.tracks)}; expected those "
                f"of the first episode: {self.sizes}, {sorted(self.deep)}, {sorted(self.tracked)}"
            )
        own = 0 if episode.joint_position is None else episode.joint_position.shape[1]
        seen = max((len(tracks.names) for tracks in episode.tracks.values()), default=0)
        if own > self.joints or seen > self.entities or (self.joints and episode.joint_position is None):
            raise InputError(
                f"{where}: {own} joints and {seen} entities do not fit {self.joints} and {self.entities} places; say "
                "how many places the dataset needs"
            )
        return lengths.pop()

    def features(self) -> dict[str, Any]:
        """Features of ``meta/info.json``."""
        found: dict[str, Any] = {}
        for view, (height, width) in self.sizes.items():
            names = ["height", "width", "channels"]
            info = _video_info("h264", height, width, self.fps, 3) | {"is_depth_map": False}
            info[CAMERA_KEY] = self.cameras[view]
            found[image_key(view)] = {"dtype": "video", "shape": [height, width, 3], "names": names, "info": info}
            if view in self.deep:
                info = _video_info("hevc", height, width, self.fps, 1) | {"is_depth_map": True, "depth_unit": "m"}
                info |= {f"video.{name}": value for name, value in asdict(self.depth_range).items()}
                found[depth_key(view)] = {"dtype": "video", "shape": [height, width, 1], "names": names, "info": info}
        for key, (dtype, names) in self.columns().items():
            found[key] = {"dtype": dtype, "shape": [max(1, len(names or ()))], "names": names}
        return found

    def columns(self) -> dict[str, tuple[str, list[str] | None]]:
        """Element type and names of everything in the data files; None for single numbers."""
        found: dict[str, tuple[str, list[str] | None]] = {}
        if self.joints:
            found[STATE] = ("float32", [f"joint_{j}" for j in range(self.joints)])
        for view in self.sizes:
            if view in self.tracked and self.entities:
                places = [f"entity_{e}" for e in range(self.entities)]
                for what, axes in (("uv_px", "xy"), ("point_world", "xyz")):
                    names = [f"{place}.{axis}" for place in places for axis in axes]
                    found[f"{TRACKS}.{view}.{what}"] = ("float32", names)
                found[f"{TRACKS}.{view}.visible"] = ("bool", places)
                found[f"{TRACKS}.{view}.confidence"] = ("float32", places)
            found[f"{POSE}.{view}"] = ("float64", [f"m{row}{column}" for row in range(4) for column in range(4)])
        found[STAMP] = ("float64", None)
        found["timestamp"] = ("float32", None)
        return found | {name: (dtype, None) for name, dtype in _COUNTERS.items()}


def image_key(view: str) -> str:
    """Feature of a view's colours."""
    return f"observation.images.{view}"


def depth_key(view: str) -> str:
    """Feature of a view's depth."""
    return f"observation.images.{view}_depth"


def _video_info(codec: str, height: int, width: int, fps: int, channels: int) -> dict[str, Any]:
    odd = height % 2 or width % 2
    colour_format = "yuv444p" if odd else "yuv420p"
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": codec,
        "video.pix_fmt": colour_format if channels == 3 else "gray12le",
        "video.fps": fps,
        "video.channels": channels,
        "has_audio": False,
    }


__all__ = ["Episode", "export_lerobot"]

CHUNK_FILES = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

_CRF = 18
_KEYFRAME_EVERY = 2


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
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"dataset {target}: exists and is not an empty folder; choose another one")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex[:8]}")
    writer = None
    try:
        for episode in episodes:
            if writer is None:
                layout = Layout.of(episode, fps, joints, entities, depth_range or DepthRange())
                writer = _Writer(partial, layout)
            writer.add(episode)
        if writer is None:
            raise InputError(f"dataset {target}: expected at least one episode, got none")
        writer.finish(robot_type)
        if target.exists():
            target.rmdir()
        partial.rename(target)
        return len(writer.rows)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


class _Writer:
    """Writes episodes one after the other, and what describes them at the end."""

    def __init__(self, root: Path, layout: Layout) -> None:
        self.rows: list[dict[str, Any]] = []
        self._root, self._layout = root, layout
        self._tasks: dict[str, int] = {}
        self._frames = 0
        self._stats: dict[str, dict[str, np.ndarray]] = {}
        self._own_cameras: set[str] = set()

    def add(self, episode: Episode) -> None:
        index, layout = len(self.rows), self._layout
        frames = layout.check(episode, index)
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        place = {"chunk_index": index // CHUNK_FILES, "file_index": index % CHUNK_FILES}
        values = _values(episode, layout, frames)
        counters = {"episode_index": index, "task_index": task}
        values |= {name: np.full(frames, value, np.int64) for name, value in counters.items()}
        values |= {"frame_index": np.arange(frames), "index": self._frames + np.arange(frames)}
        stats = {key: feature_stats(value) for key, value in values.items()}
        self._write_rows(values, self._root / DATA_PATH.format(**place))
        row: dict[str, Any] = {"episode_index": index, "tasks": [episode.task], "length": frames}
        row |= {f"data/{name}": value for name, value in place.items()}
        row |= {"dataset_from_index": self._frames, "dataset_to_index": self._frames + frames}
        for view, clip in episode.views.items():
            self._write_videos(clip, view, place)
            camera = row[f"{CAMERA_COLUMN}/{view}"] = asdict(clip.camera)
            if camera != layout.cameras[view]:
                self._own_cameras.add(view)
            stats[image_key(view)] = image_stats(clip.rgb, 255.0)
            if clip.depth_m is not None:
                stats[depth_key(view)] = image_stats(clip.depth_m, 1.0)
            for key in (image_key(view), depth_key(view)) if view in layout.deep else (image_key(view),):
                row |= {f"videos/{key}/{name}": value for name, value in place.items()}
                row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": frames / layout.fps}
        row |= {"quest/joints": list(episode.joint_names), "quest/entities": _names(episode)}
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
        features = self._layout.features()
        for view in self._own_cameras:  # what is said of all episodes must hold for all
            del features[image_key(view)]["info"][CAMERA_KEY]
        info = {
            "codebase_version": VERSION,
            "fps": self._layout.fps,
            "features": features,
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

    def _write_rows(self, values: dict[str, np.ndarray], path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {}
        for key, (dtype, names) in self._layout.columns().items():
            kind = pa.bool_() if dtype == "bool" else pa.type_for_alias(dtype)
            flat = pa.array(values[key].ravel(), kind)
            single = names is None or len(names) == 1  # LeRobot keeps features of one number as numbers
            arrays[key] = flat if single else pa.FixedSizeListArray.from_arrays(flat, len(names or ()))
        pq.write_table(pa.table(arrays), path)

    def _write_videos(self, clip: Clip, view: str, place: dict[str, int]) -> None:
        fps = self._layout.fps
        path = self._root / VIDEO_PATH.format(video_key=image_key(view), **place)
        write_video(path, clip.rgb, frames_per_s=fps, crf=_CRF, keyframe_every=_KEYFRAME_EVERY)
        if clip.depth_m is not None:
            path = self._root / VIDEO_PATH.format(video_key=depth_key(view), **place)
            codes = (self._layout.depth_range.codes(clean_depth(depth_m)) for depth_m in clip.depth_m)
            write_depth_video(path, codes, frames_per_s=fps)


def _names(episode: Episode) -> list[str]:
    return list(next((tracks.names for tracks in episode.tracks.values()), ()))


def _values(episode: Episode, layout: Layout, frames: int) -> dict[str, np.ndarray]:
    """What the data file holds of an episode, by column, [T] or [T, n]; empty places are 0, NaN or False."""
    clips = list(episode.views.items())
    found = {STAMP: clips[0][1].stamp_s, "timestamp": (np.arange(frames) / layout.fps).astype(np.float32)}
    if episode.joint_position is not None and layout.joints:
        found[STATE] = _filled(episode.joint_position, layout.joints, 0.0)
    for view, clip in clips:
        found[f"{POSE}.{view}"] = clip.cam_from_world.reshape(frames, 16)
    for view, tracks in episode.tracks.items() if layout.entities else ():
        for what, value, empty in (
            ("uv_px", tracks.uv_px, np.nan),
            ("point_world", tracks.point_world, np.nan),
            ("visible", tracks.visible, False),
            ("confidence", tracks.confidence, 0.0),
        ):
            found[f"{TRACKS}.{view}.{what}"] = _filled(value, layout.entities, empty).reshape(frames, -1)
    return found


def _filled(value: np.ndarray, places: int, empty: float) -> np.ndarray:
    """The second axis at full length."""
    pad = [(0, 0)] * value.ndim
    pad[1] = (0, places - value.shape[1])
    return np.pad(value, pad, constant_values=empty)


def _write_tasks(tasks: dict[str, int], path: Path) -> None:
    """The table of tasks, indexed by their words, which lerobot learns by pandas from the metadata."""
    path.parent.mkdir(parents=True, exist_ok=True)

    def column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}

    words = {
        "index_columns": ["task"],
        "column_indexes": [
            {
                "name": None,
                "field_name": None,
                "pandas_type": "unicode",
                "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"},
            }
        ],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    table = pa.table({"task_index": pa.array(list(tasks.values()), pa.int64()), "task": pa.array(list(tasks))})
    pq.write_table(table.replace_schema_metadata({b"pandas": json.dumps(words).encode()}), path)
