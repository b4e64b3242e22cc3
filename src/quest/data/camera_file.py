"""The camera file of a recording: intrinsics, units, times and poses as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.errors import InputError, RecordingError
from quest.types import Camera

DEFAULT_DEPTH_SCALE_M = 1e-3
EXAMPLE = '{"fx": 600, "fy": 600, "cx": 320, "cy": 240, "width": 640, "height": 480, "depth_scale_m": 0.001, "fps": 30}'

_INTRINSICS = ("fx", "fy", "cx", "cy", "width", "height")
_OPTIONAL = ("pixel_centre", "depth_scale_m", "fps", "stamp_s", "cam_from_world")
_RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class CameraFile:
    """What ``camera.json`` says.

    Attributes:
        camera: intrinsics, pixel centres at half-integers whatever the file's convention.
        depth_scale_m: metres per unit of the depth images.
        frames_per_s: frame rate, or None if the file does not tell.
        stamp_s: time of every frame in seconds, or None.
        cam_from_world: one pose, or one per frame; None if unknown. Numbers of frames are checked by the reader.
    """

    camera: Camera
    depth_scale_m: float = DEFAULT_DEPTH_SCALE_M
    frames_per_s: float | None = None
    stamp_s: Float[np.ndarray, " S"] | None = None
    cam_from_world: Float[np.ndarray, "4 4"] | Float[np.ndarray, "P 4 4"] | None = None

    def stamps(self, frames: int, *, fallback: np.ndarray) -> np.ndarray:
        """Time of each of ``frames`` frames in seconds: the file's own, else from its rate, else ``fallback``."""
        if self.stamp_s is not None:
            return self.stamp_s
        return fallback if self.frames_per_s is None else np.arange(frames) / self.frames_per_s

    def poses(self, frames: int) -> np.ndarray:
        """``cam_from_world`` of each of ``frames`` frames; identities if unknown."""
        pose = np.eye(4) if self.cam_from_world is None else self.cam_from_world
        return np.tile(pose, (frames, 1, 1)) if pose.ndim == 2 else pose


def read_camera(path: Path) -> CameraFile:
    """Read a camera file.

    Intrinsics are in pixels with pixel centres at integers (OpenCV, ROS) unless ``pixel_centre`` is ``half-integer``.

    Raises:
        RecordingError: the file is missing, is not JSON, lacks or misspells a field, or a value makes no sense.
    """
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordingError(
            f"camera file {path}: no such file; write one such as {EXAMPLE}, or name another one"
        ) from None
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"camera file {path}: cannot be read as JSON ({error}); expected such as {EXAMPLE}"
        ) from error
    if not isinstance(fields, dict):
        raise RecordingError(f"camera file {path}: expected an object such as {EXAMPLE}, got {type(fields).__name__}")
    missing = [name for name in _INTRINSICS if name not in fields]
    unknown = sorted(set(fields) - {*_INTRINSICS, *_OPTIONAL})
    if missing or unknown:
        said = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has unknown {', '.join(unknown)}"] * bool(unknown)
        raise RecordingError(
            f"camera file {path}: {' and '.join(said)}; known are {', '.join((*_INTRINSICS, *_OPTIONAL))}, "
            f"for example {EXAMPLE}"
        )
    try:
        return _parse(fields)
    except (InputError, TypeError, ValueError) as error:
        raise RecordingError(f"camera file {path}: {error}; expected such as {EXAMPLE}") from error


def write_camera(file: CameraFile, path: Path) -> None:
    """Write a camera file that :func:`read_camera` reads."""
    camera = file.camera
    fields: dict[str, Any] = {name: getattr(camera, name) for name in _INTRINSICS}
    fields |= {"pixel_centre": "half-integer", "depth_scale_m": file.depth_scale_m}
    if file.frames_per_s is not None:
        fields["fps"] = file.frames_per_s
    if file.stamp_s is not None:
        fields["stamp_s"] = file.stamp_s.tolist()
    if file.cam_from_world is not None:
        fields["cam_from_world"] = file.cam_from_world.tolist()
    path.write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def _parse(fields: dict[str, Any]) -> CameraFile:
    convention = fields.get("pixel_centre", "integer")
    if convention not in ("integer", "half-integer"):
        raise ValueError(f"pixel_centre is {convention!r}, expected 'integer' (OpenCV, ROS) or 'half-integer'")
    shift = 0.5 if convention == "integer" else 0.0
    fx, fy, cx, cy = (float(fields[name]) for name in _INTRINSICS[:4])
    width, height = fields["width"], fields["height"]
    if width != int(width) or height != int(height):
        raise ValueError(f"width and height are {width} and {height}, expected whole pixels")
    return CameraFile(
        camera=Camera(fx, fy, cx + shift, cy + shift, int(width), int(height)),
        depth_scale_m=check_depth_scale(fields.get("depth_scale_m", DEFAULT_DEPTH_SCALE_M)),
        frames_per_s=None if "fps" not in fields else _positive("fps", fields["fps"]),
        stamp_s=None if "stamp_s" not in fields else _parse_stamps(fields["stamp_s"]),
        cam_from_world=None if "cam_from_world" not in fields else _parse_poses(fields["cam_from_world"]),
    )


def check_depth_scale(value: Any) -> float:
    """A scale of depth in metres per unit; ValueError unless it is a positive number."""
    return _positive("depth_scale_m", value)


def _positive(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value) or value <= 0:
        raise ValueError(f"{name} is {value!r}, expected a positive number")
    return float(value)


def _parse_stamps(value: Any) -> np.ndarray:
    stamps = np.asarray(value, dtype=np.float64)
    if stamps.ndim != 1 or not np.isfinite(stamps).all() or (np.diff(stamps) < 0).any():
        raise ValueError("stamp_s must be a list of finite seconds that do not decrease, one per frame")
    return stamps


def _parse_poses(value: Any) -> np.ndarray:
    poses = np.asarray(value, dtype=np.float64)
    if poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3):
        raise ValueError(f"cam_from_world has shape {poses.shape}, expected one 4 x 4 matrix or one per frame")
    rotation = poses[..., :3, :3]
    off = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    rigid = off < _RIGID_TOLERANCE and (np.linalg.det(rotation) > 0).all()  # a NaN compares false
    if not rigid or not np.isfinite(poses).all() or not np.allclose(poses[..., 3, :], [0, 0, 0, 1]):
        raise ValueError("cam_from_world is not a rigid transform (rotation, translation in metres, last row 0 0 0 1)")
    return poses
