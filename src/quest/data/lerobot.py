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
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, UInt16
from PIL import Image

from quest.data.camera_file import CameraFile, find_setup
from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions, naming
from quest.data.pictures import TURNED, colours_of, is_turned, upright
from quest.data.video import play_video, probe_video
from quest.depth import metres
from quest.errors import InputError, QuestError, RecordingError
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
    info: dict[str, Any]
    """The dataset's ``meta/info.json``."""
    index: int
    row: dict[str, Any]
    """Its row of ``meta/episodes``."""

    def feature(self, key: str) -> dict[str, Any]:
        return self.info["features"][key]

    @property
    def visual(self) -> list[str]:
        """Features of pictures."""
        return [key for key, feature in self.info["features"].items() if feature.get("dtype") in ("video", "image")]

    def details(self, key: str) -> list[dict[str, Any]]:
        """What a feature says of its pictures, under the name of today and an older one."""
        return [self.feature(key).get(name) or {} for name in ("info", "video_info")]

    def is_depth(self, key: str) -> bool:
        return any(told.get("is_depth_map") or told.get("video.is_depth_map") for told in self.details(key))

    def error(self, words: str) -> RecordingError:
        return RecordingError(f"dataset {self.root}: {words}")

    def path(self, template: str, of: str, **names: str) -> Path:
        """Where files of the episode are: a template's fields filled in, below the dataset."""
        where = f"{template} {self.info.get(template)!r:.120} of meta/info.json"
        values: dict[str, Any] = dict(names)
        for part in ("chunk_index", "file_index"):
            values[part] = self.row.get(f"{of}/{part}")
            if type(values[part]) is not int or not 0 <= values[part] < 10**6:
                raise self.error(f"episode {self.index}: {of}/{part} is {values[part]!r}")

        def filled(found: re.Match[str]) -> str:
            value = values.get(found["name"])
            if value is None or (found["width"] and not isinstance(value, int)):
                raise self.error(f"{where}: expected fields {', '.join(values)}, got {found[0]}")
            return f"{value:0{int(found['width'] or 0)}d}" if isinstance(value, int) else value

        path = _FIELD.sub(filled, str(self.info.get(template)))
        if re.search(r"[{}]", path) or not is_inside(path):
            raise self.error(f"{where}: expected a path below the dataset, with fields {', '.join(values)}")
        return self.root / path


def _accepts(where: str) -> bool:
    return (Path(where) / "meta" / "info.json").is_file()


def _open(where: str, options: ReadOptions) -> FrameSource:
    """One camera of an episode; depth images are in millimetres, but floats in metres, unless it is said otherwise."""
    notes, episode = Notes(), _read_episode(Path(where), options.episode)
    key = _colour_key(episode, options.camera_key, notes)
    depth_key = _depth_key(episode, key)
    if depth_key is None:
        notes.say(f"no depth feature beside {key}: colours only")
    setup = find_setup(
        where, options, _own_setup(episode, key), size=_size(episode, key), depth=depth_key is not None, notes=notes
    )
    given_m, feature = options.depth_scale_m, {} if depth_key is None else episode.feature(depth_key)
    if feature.get("dtype") == "video" and given_m is not None:
        raise episode.error(f"{depth_key} is a video, whose metres info.json gives; omit --depth-scale-m")
    in_metres = feature.get("dtype") == "video" or (feature.get("info") or {}).get("depth_unit") == "m"
    unit_m = given_m or (1.0 if in_metres else setup.unit_m)
    shot = _Shot(episode, key, depth_key, setup, *_read_rows(episode, _view(key)), (unit_m, given_m or 1.0))
    if shot.pose is None and setup.cam_from_world is None:
        notes.say("the dataset has no camera poses: the world is the camera")
    for what, number in setup.lengths:
        if number != len(shot.timestamp):
            raise episode.error(
                f"{what} of the camera is for {number} frames, expected {len(shot.timestamp)} of episode "
                f"{episode.index}"
            )
    return FrameSource(
        f"{episode.root.resolve().name}-{episode.index:06d}-{_view(key)}",
        setup.camera,
        shot.frames,
        length=len(shot.timestamp),
        notes=notes,
        units=(f"{episode.root} {depth_key}", unit_m),
    )


_OPTIONS = ("episode", "camera_key", "camera", "depth_scale_m", "fov_deg")
READERS = (Reader("a LeRobot v3 dataset", "a folder with meta/info.json", _accepts, _open, _OPTIONS),)


def _view(key: str) -> str:
    return key.rpartition(".")[2]


def _read_episode(root: Path, episode: int) -> _Episode:
    info, seen = _read_info(root), 0
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
        build(str, info["data_path"], "data_path")
        if not 0 < build(float, info["fps"], "fps") < 1e6:
            raise ValueError(f"fps: expected frames per second, got {info['fps']}")
        for name, feature in build(dict[str, dict], info["features"], "features").items():
            for part in ("info", "video_info"):
                build(dict[str, Any] | None, feature.get(part), f"features.{name}.{part}")
    return info


def _colour_key(episode: _Episode, camera_key: str | None, notes: Notes) -> str:
    keys = [key for key in episode.visual if not episode.is_depth(key)]
    if camera_key is not None:
        full = [key for key in keys if camera_key in (key, _view(key))]
        if not full:
            raise episode.error(f"no camera {camera_key!r}; its cameras are {', '.join(keys)}")
        return full[0]
    if not keys:
        raise episode.error(f"no feature of images; its features are {', '.join(episode.info['features'])}")
    if len(keys) > 1:
        notes.say(f"camera {keys[0]} of {', '.join(keys)}; choose another with --camera-key")
    return keys[0]


def _depth_key(episode: _Episode, key: str) -> str | None:
    """The depth of a camera: named like it, or the only one of a dataset with one camera."""
    depths = [name for name in episode.visual if episode.is_depth(name)]
    for name in (f"{key}_depth", key.replace("images.", "depth."), f"{key}.depth"):
        if name in depths:
            return name
    return depths[0] if len(depths) == 1 and len(episode.visual) == 2 else None


def _own_setup(episode: _Episode, key: str) -> CameraFile | None:
    """The intrinsics that this project wrote into the dataset; LeRobot itself keeps none."""
    kept = episode.row.get(f"{CAMERA_COLUMN}/{_view(key)}")
    if kept is None:
        kept = (episode.feature(key).get("info") or {}).get(CAMERA_KEY)
    if kept is None:
        return None
    try:
        return CameraFile(build(Camera, kept, CAMERA_KEY))
    except (ValueError, TypeError) as error:
        raise episode.error(f"{CAMERA_KEY} of {key} makes no sense ({error})") from error


def _size(episode: _Episode, key: str) -> tuple[int, int]:
    """Width and height of a feature's images; channels are first or last."""
    shape = [int(n) for n in episode.feature(key).get("shape", ())]
    if len(shape) != 3:
        raise episode.error(f"{key} has shape {shape}, expected height, width and channels")
    height, width = shape[1:] if shape[0] in (1, 3) else shape[:2]
    return width, height


@dataclass(frozen=True)
class _Shot:
    """The frames of one camera in one episode."""

    episode: _Episode
    key: str
    """Feature of the colours."""
    depth_key: str | None
    setup: CameraFile
    timestamp: np.ndarray
    """As LeRobot counts it, by which frames of videos are found."""
    stamp_s: np.ndarray
    pose: np.ndarray | None
    units_m: tuple[float, float]
    """Metres per unit of depth images in integers, and in floats."""

    def frames(self) -> Iterator[Frame]:
        setup = self.setup
        colours = self._pictures(self.key, paired=self.depth_key is not None)
        depths = None if self.depth_key is None else self._pictures(self.depth_key, paired=False)
        with naming(f"dataset {self.episode.root}: episode {self.episode.index}"):
            for t, picture in enumerate(colours):
                depth_m = None if depths is None else setup.depth(next(depths))
                pose = setup.pose(t) if self.pose is None or setup.cam_from_world is not None else self.pose[t]
                yield Frame(setup.rgb(picture), depth_m, setup.stamp(t, fallback_s=float(self.stamp_s[t])), pose)

    def _pictures(self, key: str, *, paired: bool) -> Iterator[np.ndarray]:
        """Colours of uint8, or depth in metres, one per row; ``paired`` are colours that depth goes with."""
        read = self._stored if self.episode.feature(key)["dtype"] == "image" else self._filmed
        return read(key, paired)

    def _filmed(self, key: str, paired: bool) -> Iterator[np.ndarray]:
        """Frames of a video at the times of the rows."""
        episode, path = self.episode, self.episode.path("video_path", f"videos/{key}", video_key=key)
        if paired and probe_video(path).turns:
            raise episode.error(f"video {path.name} of {key}: {TURNED}")
        half_s = 0.5 / float(episode.info["fps"])
        times = float(episode.row[f"videos/{key}/from_timestamp"]) + self.timestamp
        scale = None
        if episode.is_depth(key):
            told = {name: value for details in episode.details(key) for name, value in details.items()}
            named = {f.name: told.get(f"video.{f.name}") for f in fields(DepthRange)}
            scale = DepthRange(**{name: value for name, value in named.items() if value is not None})
        pixel_format, number = "rgb24" if scale is None else "gray12le", 0
        for picture, time_s in play_video(path, pixel_format=pixel_format, start_s=times[0] - half_s):
            if number < len(times) and abs(time_s - times[number]) < half_s:
                yield picture if scale is None else scale.depth(picture)
                number += 1
            if number == len(times):
                return
        raise episode.error(
            f"{path.name} of {key} has {number} of the {len(times)} frames of episode {episode.index}; the file is "
            "corrupt, copy it again"
        )

    def _stored(self, key: str, paired: bool) -> Iterator[np.ndarray]:
        """Pictures in the rows themselves, a few in memory at a time."""
        episode, path = self.episode, self.episode.path("data_path", "data")
        where = f"dataset {episode.root}: a picture of {key} in {path.name}"
        with reading(f"dataset file {path}", RecordingError, known=QuestError), pq.ParquetFile(path) as file:
            for batch in file.iter_batches(batch_size=8, columns=["episode_index", key]):
                for row in batch.to_pylist():
                    if row["episode_index"] == episode.index:
                        yield self._decoded(row[key]["bytes"], key, where, paired)

    def _decoded(self, data: bytes, key: str, where: str, paired: bool) -> np.ndarray:
        with reading(where, RecordingError), Image.open(io.BytesIO(data)) as image:
            if paired and is_turned(image):
                raise RecordingError(f"{where}: {TURNED}")
            if not self.episode.is_depth(key):
                return colours_of(upright(image), where)
            pixels = np.asarray(image)
        return metres(pixels, self.units_m[pixels.dtype.kind == "f"])


def _read_rows(episode: _Episode, view: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Timestamps, true times, and poses of a view if there are any, of all frames of an episode."""
    path, pose = episode.path("data_path", "data"), f"{POSE}.{view}"
    wanted = [name for name in _columns(path) if name in ("episode_index", "timestamp", STAMP, pose)]
    table = _read_table(path, wanted, filters=[("episode_index", "=", episode.index)])
    if table.num_rows == 0:
        raise episode.error(f"{path.name} has no rows of episode {episode.index}")
    length = episode.row.get("length", table.num_rows)
    if length != table.num_rows:
        raise episode.error(
            f"{path.name} has {table.num_rows} rows of episode {episode.index}, expected {length}; the file is "
            "corrupt, copy it again"
        )
    timestamp = table["timestamp"].to_numpy().astype(np.float64)
    stamp_s = table[STAMP].to_numpy().astype(np.float64) if STAMP in wanted else timestamp
    poses = np.array(table[pose].to_pylist(), np.float64).reshape(-1, 4, 4) if pose in wanted else None
    return timestamp, stamp_s, poses


def _columns(path: Path) -> list[str]:
    require_file(path, RecordingError)
    with reading(f"dataset file {path}", RecordingError):
        return list(pq.read_schema(path).names)


def _read_table(path: Path, columns: list[str], *, filters: list[tuple[str, str, int]] | None = None) -> pa.Table:
    require_table(path, RecordingError)
    with reading(f"dataset file {path}", RecordingError):
        return pq.read_table(path, columns=columns, filters=filters)
