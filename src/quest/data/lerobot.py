"""Episodes of LeRobot v3 datasets as RGB-D recordings.

A dataset is a folder of ``meta/info.json`` (features and where files lie), ``meta/episodes/`` (which file and which
seconds of a video belong to an episode), ``data/`` (one row per frame) and ``videos/``. It has no place for
intrinsics: give a camera file, or a dataset that :mod:`quest.data.lerobot_export` wrote.

Reference: lerobot 0.6.2, ``lerobot/datasets`` (``dataset_metadata.py``, ``dataset_reader.py``, ``depth_utils.py``).
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, UInt16
from PIL import Image

from quest.data.camera_file import CameraFile, find_setup
from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions
from quest.data.pictures import TURNED, colours_of, is_turned, upright
from quest.data.video import play_video, probe_video
from quest.depth import metres
from quest.errors import InputError, RecordingError
from quest.types import Camera, Frame
from quest.untrusted import build, is_inside, read_json, reading, require_file, require_table

VERSION = "v3.0"
CAMERA_KEY = "quest.camera"
"""Where in a feature's ``info`` this project keeps intrinsics; other readers pass over it."""
CAMERA_COLUMN = "quest/camera"
"""Before the name of a view: column of ``meta/episodes`` with the intrinsics of each episode, which come first."""
POSE, STAMP = "observation.cam_from_world", "observation.stamp_s"
DEPTH_CODES = 4095
"""Depth videos have twelve bits."""

_VISUAL = ("video", "image")
_FIELD = re.compile(r"\{(?P<name>\w+)(:0?(?P<width>\d)d)?\}")
"""A field of a path's template, such as ``{chunk_index:03d}``."""


@dataclass(frozen=True)
class DepthRange:
    """How depth is quantised to twelve bits: evenly, or evenly in the logarithm of depth plus a shift."""

    depth_min: float = 0.01
    """Metres of code 0, which also stands for missing."""
    depth_max: float = 10.0
    """Metres of the highest code."""
    shift: float = 3.5
    """Metres added before the logarithm."""
    use_log: bool = True
    """Whether the logarithm is taken."""

    def __post_init__(self) -> None:
        if not 0 < self.depth_min < self.depth_max or self.depth_min + self.shift <= 0:
            raise InputError(
                f"depth range {self.depth_min} to {self.depth_max} m with shift {self.shift}: expected 0 < min < max "
                "and min + shift > 0"
            )

    def codes(self, depth_m: Float32[np.ndarray, "*S"]) -> UInt16[np.ndarray, "*S"]:
        """Twelve-bit codes; missing depth, and depth outside the range, is code 0."""
        low, high = self._scaled(self.depth_min), self._scaled(self.depth_max)
        valid = (depth_m > 0) & (depth_m <= self.depth_max)
        share = (self._scaled(np.where(valid, depth_m, self.depth_min)) - low) / (high - low)
        return np.where(valid, np.rint(share * DEPTH_CODES), 0).clip(0, DEPTH_CODES).astype(np.uint16)

    def depth(self, codes: UInt16[np.ndarray, "*S"]) -> Float32[np.ndarray, "*S"]:
        """Metres of twelve-bit codes; 0, missing, for code 0."""
        low, high = self._scaled(self.depth_min), self._scaled(self.depth_max)
        scaled = low + codes.astype(np.float64) / DEPTH_CODES * (high - low)
        depth_m = np.exp(scaled) - self.shift if self.use_log else scaled
        return np.where(codes > 0, depth_m, 0).astype(np.float32)

    def _scaled(self, depth_m: Any) -> Any:
        return np.log(depth_m + self.shift) if self.use_log else depth_m


@dataclass(frozen=True)
class _Episode:
    """One episode of a dataset."""

    root: Path
    """Of the dataset."""
    info: dict[str, Any]
    """Its ``meta/info.json``."""
    index: int
    """Of the episode."""
    row: dict[str, Any]
    """Its row of ``meta/episodes``."""

    def feature(self, key: str) -> dict[str, Any]:
        return self.info["features"][key]

    @property
    def visual(self) -> list[str]:
        return [key for key, feature in self.info["features"].items() if feature.get("dtype") in _VISUAL]

    @property
    def data_path(self) -> Path:
        return self._path("data_path", "data")

    def video_path(self, key: str) -> Path:
        return self._path("video_path", f"videos/{key}", video_key=key)

    def _path(self, template: str, of: str, **names: str) -> Path:
        """Where files of the episode are: the template's fields filled in, below the dataset."""
        where = f"dataset {self.root}: {template} {self.info.get(template)!r:.120} of meta/info.json"
        values: dict[str, Any] = dict(names)
        for part in ("chunk_index", "file_index"):
            values[part] = self.row.get(f"{of}/{part}")
            if type(values[part]) is not int or not 0 <= values[part] < 10**6:
                raise RecordingError(f"dataset {self.root}: episode {self.index}: {of}/{part} is {values[part]!r}")

        def filled(found: re.Match[str]) -> str:
            value = values.get(found["name"])
            if value is None or (found["width"] and not isinstance(value, int)):
                raise RecordingError(f"{where}: expected fields {', '.join(values)}, got {found[0]}")
            return f"{value:0{int(found['width'] or 0)}d}" if isinstance(value, int) else value

        path = _FIELD.sub(filled, str(self.info.get(template)))
        if re.search(r"[{}]", path) or not is_inside(path):
            raise RecordingError(f"{where}: expected a path below the dataset, with fields {', '.join(values)}")
        return self.root / path


def _accepts(where: str) -> bool:
    return (Path(where) / "meta" / "info.json").is_file()


def _open(where: str, options: ReadOptions) -> FrameSource:
    """One camera of an episode; depth images are in millimetres, but floats in metres, unless it is said otherwise."""
    root, episode = Path(where), options.episode
    notes = Notes()
    found = _read_episode(root, episode)
    key = _colour_key(found, options.camera_key, notes)
    depth_key = _depth_key(found, key)
    if depth_key is None:
        notes.say(f"no depth feature beside {key}: colours only")
    setup = find_setup(
        where, options, _own_setup(found, key), size=_size(found, key), depth=depth_key is not None, notes=notes
    )
    units_m = _units_m(found, depth_key, setup, options.depth_scale_m)
    rows = _Rows(found, key)
    if not rows.posed and setup.cam_from_world is None:
        notes.say("the dataset has no camera poses: the world is the camera")
    for what, number in setup.lengths:
        if number != rows.number:
            raise RecordingError(
                f"dataset {root}: {what} of the camera is for {number} frames, expected {rows.number} of "
                f"episode {episode}"
            )
    return FrameSource(
        f"{root.resolve().name}-{episode:06d}-{key.rpartition('.')[2]}",
        setup.camera,
        lambda: _frames(found, rows, setup, key, depth_key, units_m),
        length=rows.number,
        notes=notes,
        units=(f"{root} {depth_key}", units_m.integers),
    )


def _read_episode(root: Path, episode: int) -> _Episode:
    info = _read_info(root)
    seen = 0
    for file in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        table = _read_table(file, [name for name in _columns(file) if not name.startswith("stats/")])
        with reading(file, RecordingError):
            index = table["episode_index"].to_numpy()
        seen += len(index)
        if episode in index:
            row = table.slice(int(np.flatnonzero(index == episode)[0]), 1).to_pylist()[0]
            return _Episode(root, info, episode, row)
    raise RecordingError(f"dataset {root}: no episode {episode}; it has {seen}, counted from 0")


def _read_info(root: Path) -> dict[str, Any]:
    path = root / "meta" / "info.json"
    info = read_json(path, RecordingError)
    if not isinstance(info, dict):
        raise RecordingError(f"dataset {root}: {path.name} is no object; expected a LeRobot v3 dataset")
    missing = [name for name in ("codebase_version", "features", "data_path", "fps") if name not in info]
    if missing:
        raise RecordingError(f"dataset {root}: {path.name} lacks {', '.join(missing)}; expected a LeRobot v3 dataset")
    if not str(info["codebase_version"]).startswith("v3."):
        raise RecordingError(
            f"dataset {root}: format {info['codebase_version']}, expected {VERSION}; convert it with lerobot's "
            "convert_dataset_v21_to_v30"
        )
    with reading(f"dataset {root}: {path.name}", RecordingError, "restore it"):
        build(_Info, {name: info[name] for name in ("features", "data_path", "fps")}, "it")
        for name, feature in info["features"].items():
            for part in ("info", "video_info"):
                build(dict[str, Any] | None, feature.get(part), f"features.{name}.{part}")
    return info


@dataclass(frozen=True)
class _Info:
    """What of ``meta/info.json`` is relied on."""

    features: dict[str, dict]
    data_path: str
    fps: float

    def __post_init__(self) -> None:
        if not 0 < self.fps < 1e6:
            raise ValueError(f"fps: expected frames per second, got {self.fps}")


def _colour_key(episode: _Episode, camera_key: str | None, notes: Notes) -> str:
    keys = [key for key in episode.visual if not _is_depth(episode.feature(key))]
    if camera_key is not None:
        full = [key for key in keys if camera_key in (key, key.rpartition(".")[2])]
        if not full:
            raise RecordingError(f"dataset {episode.root}: no camera {camera_key!r}; its cameras are {', '.join(keys)}")
        return full[0]
    if not keys:
        raise RecordingError(
            f"dataset {episode.root}: no feature of images; its features are {', '.join(episode.info['features'])}"
        )
    if len(keys) > 1:
        notes.say(f"camera {keys[0]} of {', '.join(keys)}; choose another with --camera-key")
    return keys[0]


def _depth_key(episode: _Episode, key: str) -> str | None:
    """The depth of a camera: named like it, or the only one of a dataset with one camera."""
    depths = [name for name in episode.visual if _is_depth(episode.feature(name))]
    for name in (f"{key}_depth", key.replace("images.", "depth."), f"{key}.depth"):
        if name in depths:
            return name
    return depths[0] if len(depths) == 1 and len(episode.visual) == 2 else None


def _is_depth(feature: dict[str, Any]) -> bool:
    info, older = feature.get("info") or {}, feature.get("video_info") or {}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map") or older.get("video.is_depth_map"))


def _own_setup(episode: _Episode, key: str) -> CameraFile | None:
    """The intrinsics that this project wrote into the dataset; LeRobot itself keeps none."""
    kept = episode.row.get(f"{CAMERA_COLUMN}/{key.rpartition('.')[2]}")
    if kept is None:
        kept = (episode.feature(key).get("info") or {}).get(CAMERA_KEY)
    if kept is None:
        return None
    try:
        return CameraFile(build(Camera, kept, CAMERA_KEY))
    except (ValueError, TypeError) as error:
        raise RecordingError(f"dataset {episode.root}: {CAMERA_KEY} of {key} makes no sense ({error})") from error


def _size(episode: _Episode, key: str) -> tuple[int, int]:
    """Width and height of a feature's images; channels are first or last."""
    shape = [int(n) for n in episode.feature(key).get("shape", ())]
    if len(shape) != 3:
        raise RecordingError(f"dataset {episode.root}: {key} has shape {shape}, expected height, width and channels")
    height, width = shape[1:] if shape[0] in (1, 3) else shape[:2]
    return width, height


@dataclass(frozen=True)
class _Units:
    """Metres per unit of depth images in integers and in floats."""

    integers: float = 1.0
    floats: float = 1.0


def _units_m(episode: _Episode, key: str | None, setup: CameraFile, depth_scale_m: float | None) -> _Units:
    feature = {} if key is None else episode.feature(key)
    if depth_scale_m is not None:
        if feature.get("dtype") == "video":
            raise RecordingError(
                f"dataset {episode.root}: {key} is a video, whose metres info.json gives; omit --depth-scale-m"
            )
        return _Units(depth_scale_m, depth_scale_m)
    in_metres = feature.get("dtype") == "video" or (feature.get("info") or {}).get("depth_unit") == "m"
    return _Units() if in_metres else _Units(setup.unit_m)


class _Rows:
    """The rows of one episode, without its pictures."""

    def __init__(self, episode: _Episode, key: str) -> None:
        path = episode.data_path
        present = _columns(path)
        pose = f"{POSE}.{key.rpartition('.')[2]}"
        wanted = [name for name in ("episode_index", "timestamp", STAMP, pose) if name in present]
        table = _read_table(path, wanted, filters=[("episode_index", "=", episode.index)])
        self.number = table.num_rows
        if self.number == 0:
            raise RecordingError(f"dataset {episode.root}: {path.name} has no rows of episode {episode.index}")
        length = episode.row.get("length", self.number)
        if length != self.number:
            raise RecordingError(
                f"dataset {episode.root}: {path.name} has {self.number} rows of episode {episode.index}, expected "
                f"{length}; the file is corrupt, copy it again"
            )
        self.timestamp = table["timestamp"].to_numpy().astype(np.float64)
        self.stamp_s = table[STAMP].to_numpy().astype(np.float64) if STAMP in wanted else self.timestamp
        self.posed = pose in wanted
        self.pose = np.tile(np.eye(4), (self.number, 1, 1))
        if self.posed:
            self.pose = np.array(table[pose].to_pylist(), dtype=np.float64).reshape(-1, 4, 4)


def _frames(
    episode: _Episode, rows: _Rows, setup: CameraFile, key: str, depth_key: str | None, units_m: _Units
) -> Iterator[Frame]:
    rig = setup.rig
    colours = _pictures(episode, rows, key, units_m, paired=depth_key is not None)
    depths = None if depth_key is None else _pictures(episode, rows, depth_key, units_m)
    try:
        for t, picture in enumerate(colours):
            depth_m = None if depths is None else rig.depth(next(depths))
            pose = rows.pose[t] if setup.cam_from_world is None else setup.pose(t)
            yield Frame(rig.rgb(picture), depth_m, setup.stamp(t, fallback_s=float(rows.stamp_s[t])), pose)
    except RecordingError:
        raise
    except InputError as error:
        raise RecordingError(f"dataset {episode.root}: episode {episode.index}: {error}") from error


def _pictures(
    episode: _Episode, rows: _Rows, key: str, units_m: _Units, *, paired: bool = False
) -> Iterator[np.ndarray]:
    """Colours of uint8, or depth in metres, one per row; ``paired`` are colours that depth goes with."""
    feature = episode.feature(key)
    if feature["dtype"] == "image":
        yield from _stored_images(episode, key, units_m, paired=paired)
        return
    info = (feature.get("info") or {}) | (feature.get("video_info") or {})
    path = episode.video_path(key)
    if paired and probe_video(path).turns:
        raise RecordingError(f"dataset {episode.root}: video {path.name} of {key}: {TURNED}")
    begin_s = float(episode.row[f"videos/{key}/from_timestamp"])
    half_s = 0.5 / float(episode.info["fps"])
    times = begin_s + rows.timestamp
    if _is_depth(feature):
        named = {name: info[f"video.{name}"] for name in DepthRange.__dataclass_fields__ if f"video.{name}" in info}
        scale, video = DepthRange(**named), play_video(path, pixel_format="gray12le", start_s=times[0] - half_s)
    else:
        scale, video = None, play_video(path, start_s=times[0] - half_s)
    number = 0
    for picture, time_s in video:
        if number < len(times) and abs(time_s - times[number]) < half_s:
            yield picture if scale is None else scale.depth(picture)
            number += 1
        if number == len(times):
            return
    raise RecordingError(
        f"dataset {episode.root}: {path.name} of {key} has {number} of the {len(times)} frames of episode "
        f"{episode.index}; the file is corrupt, copy it again"
    )


def _stored_images(episode: _Episode, key: str, units_m: _Units, *, paired: bool) -> Iterator[np.ndarray]:
    """Pictures in the rows themselves."""
    depth, path = _is_depth(episode.feature(key)), episode.data_path
    where = f"dataset {episode.root}: a picture of {key} in {path.name}"
    for row in _read_rows(path, ["episode_index", key]):
        if row["episode_index"] != episode.index:
            continue
        with reading(where, RecordingError), Image.open(io.BytesIO(row[key]["bytes"])) as image:
            if paired and is_turned(image):
                raise RecordingError(f"{where}: {TURNED}")
            pixels = np.asarray(image) if depth else colours_of(upright(image), where)
        if depth:
            unit_m = units_m.floats if np.issubdtype(pixels.dtype, np.floating) else units_m.integers
            pixels = metres(pixels, unit_m)
        yield pixels


def _read_rows(path: Path, columns: list[str]) -> Iterator[dict[str, Any]]:
    """Rows one by one, a few in memory at a time."""
    with reading(f"dataset file {path}", RecordingError), pq.ParquetFile(path) as file:
        for batch in file.iter_batches(batch_size=8, columns=columns):
            yield from batch.to_pylist()


def _columns(path: Path) -> list[str]:
    require_file(path, RecordingError)
    with reading(f"dataset file {path}", RecordingError):
        return list(pq.read_schema(path).names)


def _read_table(path: Path, columns: list[str], *, filters: list[tuple[str, str, int]] | None = None) -> pa.Table:
    require_table(path, RecordingError)
    with reading(f"dataset file {path}", RecordingError):
        return pq.read_table(path, columns=columns, filters=filters)


READER = Reader(
    "a LeRobot v3 dataset",
    "a folder with meta/info.json",
    _accepts,
    _open,
    options=("episode", "camera_key", "camera", "depth_scale_m", "fov_deg"),
)
