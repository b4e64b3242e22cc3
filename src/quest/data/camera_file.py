"""The camera file of a recording: intrinsics, units, times and poses as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.data.frame_source import Notes, ReadOptions, naming
from quest.data.registration import Distortion, Rig
from quest.errors import RecordingError
from quest.geometry.poses import is_rigid
from quest.types import Camera
from quest.untrusted import read_json, reading

DEFAULT_DEPTH_SCALE_M = 1e-3
EXAMPLE = '{"fx": 600, "fy": 600, "cx": 320, "cy": 240, "width": 640, "height": 480, "depth_scale_m": 0.001, "fps": 30}'

_INTRINSICS = ("fx", "fy", "cx", "cy", "width", "height")
_LENS = ("distortion_model", "distortion")
_SCALES = ("pixel_centre", "depth_scale_m", "fps", "stamp_s", "cam_from_world")
_KNOWN = (*_INTRINSICS, *_SCALES, *_LENS, "depth_camera", "colour_from_depth")


@dataclass(frozen=True)
class CameraFile(Rig):
    """The content of ``camera.json``; pixel centres at half-integers whatever the file's convention."""

    depth_scale_m: float | None = None
    """Metres per unit of the depth images, or None if the file does not tell."""
    frames_per_s: float | None = None
    """Frame rate, or None if the file does not tell."""
    stamp_s: Float[np.ndarray, " S"] | None = None
    """Time of every frame in seconds, or None."""
    cam_from_world: Float[np.ndarray, "4 4"] | Float[np.ndarray, "P 4 4"] | None = None
    """One pose, or one per frame; None if unknown. Numbers of frames are checked by the reader."""

    @property
    def unit_m(self) -> float:
        """Metres per unit of depth images of integers."""
        return DEFAULT_DEPTH_SCALE_M if self.depth_scale_m is None else self.depth_scale_m

    @property
    def lengths(self) -> list[tuple[str, int]]:
        """Of which fields the file gives one value per frame, and for how many frames."""
        found = [] if self.stamp_s is None else [("stamp_s", len(self.stamp_s))]
        if self.cam_from_world is not None and self.cam_from_world.ndim == 3:
            found.append(("cam_from_world", len(self.cam_from_world)))
        return found

    def stamp(self, t: int, *, fallback_s: float) -> float:
        """Time of frame ``t`` in seconds: the file's own, else from its rate, else ``fallback_s``."""
        if self.stamp_s is not None:
            return float(self.stamp_s[t])
        return fallback_s if self.frames_per_s is None else t / self.frames_per_s

    def pose(self, t: int) -> np.ndarray:
        """``cam_from_world`` of frame ``t``; the identity if unknown."""
        if self.cam_from_world is None:
            return np.eye(4)
        return self.cam_from_world if self.cam_from_world.ndim == 2 else self.cam_from_world[t]


def read_camera(path: Path) -> CameraFile:
    """Read a camera file.

    Intrinsics are in pixels with pixel centres at integers (OpenCV, ROS) unless ``pixel_centre`` is ``half-integer``.

    Raises:
        RecordingError: the file is missing, is not JSON, lacks or misspells a field, or a value makes no sense.
    """
    where, remedy = f"camera file {path}", f"expected such as {EXAMPLE}"
    with reading(where, RecordingError, remedy):
        there = path.exists()
    if not there:
        raise RecordingError(f"{where}: no such file; write one such as {EXAMPLE}, or name another one")
    fields = read_json(path, RecordingError, remedy)
    if not isinstance(fields, dict):
        raise RecordingError(f"{where}: expected an object such as {EXAMPLE}, got {type(fields).__name__}")
    missing = [name for name in _INTRINSICS if name not in fields]
    unknown = sorted(set(fields) - set(_KNOWN))
    if missing or unknown:
        said = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has unknown {', '.join(unknown)}"] * bool(unknown)
        raise RecordingError(f"{where}: {' and '.join(said)}; known are {', '.join(_KNOWN)}, for example {EXAMPLE}")
    with reading(where, RecordingError, remedy):
        return _parse(fields)


def read_setup(camera: Path | Camera | CameraFile, depth_scale_m: float | None = None) -> CameraFile:
    """A camera file that is read, made of intrinsics, or taken as it is, with another depth scale if one is given."""
    if isinstance(camera, Path):
        camera = read_camera(camera)
    setup = CameraFile(camera) if isinstance(camera, Camera) else camera
    return setup if depth_scale_m is None else replace(setup, depth_scale_m=depth_scale_m)


def completed(setup: CameraFile, own: CameraFile) -> CameraFile:
    """A camera with the units, times, poses and depth camera that it leaves out, as the recording has them."""
    names = ["depth_scale_m", "frames_per_s", "cam_from_world"]
    if setup.frames_per_s is None:  # a rate of the user's tells the times
        names.append("stamp_s")
    missing = [name for name in names if getattr(setup, name) is None]
    if setup.depth_camera is None:
        missing += ["depth_camera", "depth_distortion", "colour_from_depth"]
    return replace(setup, **{name: getattr(own, name) for name in missing})


def find_setup(
    where: str,
    options: ReadOptions,
    known: CameraFile | None,
    *,
    size: tuple[int, int],
    depth: bool,
    notes: Notes,
) -> CameraFile:
    """The camera of a recording: as the user gives it, else its own, else a guess for frames of a size, which is noted.

    What the user's file leaves out is taken from the recording's own.

    Raises:
        RecordingError: the camera file makes no sense, a field of view is given beside it or out of range, or there is
            depth and no camera.
    """
    camera = known if options.camera is None else options.camera
    if camera is not None:
        if options.fov_deg is not None:
            raise RecordingError(f"{where}: --fov is for recordings without a camera, and this has one; omit --fov")
        setup = read_setup(camera, options.depth_scale_m)
        return setup if known is None else completed(setup, known)
    if depth and options.fov_deg is None:
        raise RecordingError(
            f"recording {where}: it has depth but no camera, and depth needs intrinsics; give a camera file such as "
            f"{EXAMPLE} (camera.json beside the frames, or --camera FILE), or the field of view with --fov DEGREES"
        )
    with naming(f"recording {where}: --fov"):
        camera = Camera.from_fov(*size, options.fov_deg)
    if options.fov_deg is None:
        notes.say(
            f"no camera file: guessed a focal length of {camera.fx:.0f} px, the longer side of the image (a field of "
            "view of 53 degrees); if you know the field of view, state it with --fov DEGREES"
        )
    else:
        notes.say(f"no camera file: a focal length of {camera.fx:.0f} px from --fov {options.fov_deg:g}")
    return read_setup(camera, options.depth_scale_m)


def write_camera(file: CameraFile, path: Path) -> None:
    """Write a camera file that :func:`read_camera` reads."""
    fields: dict[str, Any] = asdict(file.camera) | {"pixel_centre": "half-integer", "depth_scale_m": file.unit_m}
    if file.frames_per_s is not None:
        fields["fps"] = file.frames_per_s
    for name in ("stamp_s", "cam_from_world"):
        if (values := getattr(file, name)) is not None:
            fields[name] = values.tolist()
    fields |= _lens_to_json(file.distortion)
    if file.depth_camera is not None:
        fields["depth_camera"] = asdict(file.depth_camera) | _lens_to_json(file.depth_distortion)
        fields["colour_from_depth"] = file.colour_from_depth.tolist()
    path.write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")


def _lens_to_json(lens: Distortion) -> dict[str, Any]:
    return {} if lens.none else {"distortion_model": lens.model, "distortion": list(lens.coefficients)}


def _parse(fields: dict[str, Any]) -> CameraFile:
    convention = fields.get("pixel_centre", "integer")
    if convention not in ("integer", "half-integer"):
        raise ValueError(f"pixel_centre is {convention!r}, expected 'integer' (OpenCV, ROS) or 'half-integer'")
    shift = 0.5 if convention == "integer" else 0.0
    depth, known = fields.get("depth_camera"), {*_INTRINSICS, *_LENS}
    if depth is None and "colour_from_depth" in fields:
        raise ValueError("colour_from_depth is given without depth_camera; give the intrinsics of the depth images too")
    if depth is not None and not (isinstance(depth, dict) and known >= set(depth) >= set(_INTRINSICS)):
        raise ValueError(f"depth_camera must be an object of {', '.join(_INTRINSICS)}, and may have {', '.join(_LENS)}")
    parsed: dict[str, Any] = {
        "depth_scale_m": check_depth_scale,
        "fps": lambda value: _positive("fps", value),
        "stamp_s": _parse_stamps,
        "cam_from_world": lambda value: _parse_poses("cam_from_world", value, (2, 3)),
        "colour_from_depth": lambda value: _parse_poses("colour_from_depth", value, (2,)),
    }
    given = {name: parse(fields[name]) for name, parse in parsed.items() if name in fields}
    return CameraFile(
        camera=_parse_intrinsics(fields, shift),
        frames_per_s=given.pop("fps", None),
        distortion=_parse_lens(fields),
        depth_camera=None if depth is None else _parse_intrinsics(depth, shift),
        depth_distortion=_parse_lens(depth or {}),
        **given,
    )


def _parse_intrinsics(fields: dict[str, Any], shift: float) -> Camera:
    fx, fy, cx, cy, width, height = (float(fields[name]) for name in _INTRINSICS)
    if width != int(width) or height != int(height):
        raise ValueError(f"width and height are {width} and {height}, expected whole pixels")
    return Camera(fx, fy, cx + shift, cy + shift, int(width), int(height))


def _parse_lens(fields: dict[str, Any]) -> Distortion:
    coefficients = np.asarray(fields.get("distortion", []), dtype=np.float64)
    if coefficients.ndim != 1:
        raise ValueError("distortion must be a list of coefficients, in the order of ROS and OpenCV")
    if "distortion_model" in fields and not len(coefficients):
        raise ValueError("distortion_model is given without distortion; give its coefficients too, or omit it")
    return Distortion(str(fields.get("distortion_model", "plumb_bob")), tuple(coefficients.tolist()))


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


def _parse_poses(name: str, value: Any, dimensions: tuple[int, ...]) -> np.ndarray:
    poses = np.asarray(value, dtype=np.float64)
    if poses.shape[-2:] != (4, 4) or poses.ndim not in dimensions:
        expected = "one 4 x 4 matrix" + " or one per frame" * (3 in dimensions)
        raise ValueError(f"{name} has shape {poses.shape}, expected {expected}")
    if not is_rigid(poses):
        raise ValueError(f"{name} is not a rigid transform (rotation, translation in metres, last row 0 0 0 1)")
    return poses
