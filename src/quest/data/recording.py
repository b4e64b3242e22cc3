"""Recordings of real cameras: a video or a folder of images, 16-bit depth images, and a camera file.

A recording folder holds ``rgb/`` (images, in natural order of their names) or one video, optionally ``depth/`` (16-bit
PNGs), and ``camera.json`` (see :mod:`quest.data.camera_file`).
"""

from __future__ import annotations

import re
import shutil
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8
from PIL import Image, UnidentifiedImageError

from quest.data.camera_file import CameraFile, check_depth_scale, read_camera, write_camera
from quest.data.video import SUFFIXES, read_video, write_video
from quest.errors import InputError, RecordingError
from quest.types import Camera, Clip

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
PLAUSIBLE_DEPTH_M = (0.05, 50.0)
"""A clip whose median depth lies outside is taken to be in other units."""

_USUAL_SCALES_M = (1e-3, 1e-4, 2e-4, 1e-2, 1e-5, 1e-6, 0.1, 1.0)
_USUAL_DEPTH_M = 1.5


def read_recording(
    path: str | Path,
    *,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
) -> Clip:
    """Read a recording from disk.

    Args:
        path: a recording folder, a folder of images, or a video file.
        depth: folder of 16-bit depth images, one per frame; by default ``depth`` in the recording folder (or beside a
            video), where there is one. Without it the clip has colours only.
        camera: camera file, or the intrinsics themselves; by default ``camera.json`` in the recording folder (or beside
            a video).
        depth_scale_m: metres per unit of the depth images; by default what the camera file says, else 0.001.

    Raises:
        RecordingError: something is missing, empty, torn, inconsistent, or in the wrong units.
    """
    source = Path(path)
    if not source.exists():
        raise RecordingError(f"recording {source}: no such file or folder; check the path")
    root = source if source.is_dir() else source.parent
    setup = CameraFile(camera) if isinstance(camera, Camera) else read_camera(Path(camera or root / "camera.json"))
    if depth_scale_m is not None:
        try:
            setup = replace(setup, depth_scale_m=check_depth_scale(depth_scale_m))
        except ValueError as error:
            raise RecordingError(f"recording {source}: {error}") from error

    rgb, stamp_s = _read_colours(source)
    frames, height, width = rgb.shape[:3]
    if (height, width) != (setup.camera.height, setup.camera.width):
        raise RecordingError(
            f"recording {source}: frames are {width} x {height} but the camera is for {setup.camera.width} x "
            f"{setup.camera.height}; give the intrinsics of these frames in the camera file"
        )
    stamp_s, poses = setup.stamps(frames, fallback=stamp_s), setup.poses(frames)
    for what, number in (("stamp_s", len(stamp_s)), ("cam_from_world", len(poses))):
        if number != frames:
            raise RecordingError(f"recording {source}: {what} of the camera is for {number} frames, expected {frames}")
    depth_folder = root / "depth" if depth is None else Path(depth)
    depth_m = None
    if depth is not None or depth_folder.exists():
        depth_m = _read_depth(depth_folder, frames, (width, height), setup.depth_scale_m)
        _check_units(depth_m, depth_folder, setup.depth_scale_m)
    return Clip(source.stem if source.is_file() else source.resolve().name, setup.camera, rgb, depth_m, stamp_s, poses)


def clip_from_arrays(
    rgb: UInt8[np.ndarray, "T H W 3"],
    depth_m: Shaped[np.ndarray, "T H W"] | None,
    camera: Camera,
    *,
    name: str = "clip",
    frames_per_s: float | int = 30.0,
    stamp_s: Float[np.ndarray, " T"] | None = None,
    cam_from_world: Float[np.ndarray, "T 4 4"] | None = None,
) -> Clip:
    """A clip from arrays in memory, checked as a recording on disk is.

    Args:
        rgb: colours.
        depth_m: depth along +z in metres; what is not finite or not positive counts as missing. None without depth.
        camera: intrinsics.
        name: name of the clip.
        frames_per_s: frame rate, where no time stamps are given.
        stamp_s: times in seconds, not decreasing.
        cam_from_world: pose per frame; identities by default.

    Raises:
        InputError: shapes contradict each other or there are no frames; as RecordingError if the depth is in the wrong
            units (millimetres, say).
    """
    frames = len(rgb)
    stamps = np.arange(frames) / frames_per_s if stamp_s is None else np.asarray(stamp_s, dtype=np.float64)
    poses = np.tile(np.eye(4), (frames, 1, 1)) if cam_from_world is None else cam_from_world
    clean = None if depth_m is None else clean_depth(depth_m)
    clip = Clip(name, camera, rgb, clean, stamps, poses)
    if (np.diff(stamps) < 0).any():
        raise InputError(f"clip {name!r}: time stamps decrease; sort the frames by time")
    if clean is not None:
        _check_units(clean, f"clip {name!r}", 1.0)
    return clip


def clean_depth(depth_m: Shaped[np.ndarray, "*S"]) -> Float32[np.ndarray, "*S"]:
    """Depth as float32 in which 0 stands for whatever was not finite or not positive."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float32)


def write_recording(
    clip: Clip,
    folder: str | Path,
    *,
    rgb: Literal["video", "png"] = "video",
    depth_scale_m: float | None = None,
) -> None:
    """Write a clip as a recording folder, all or nothing. A video is H.264 of high quality, not lossless.

    Args:
        clip: what to write.
        folder: where to; must not exist, or be empty.
        rgb: colours as ``rgb.mp4`` or as lossless images.
        depth_scale_m: metres per unit of the depth images; by default 0.1 mm where all is below 6.5 m, else 1 mm.

    Raises:
        InputError: the folder has something in it.
    """
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"recording {target}: exists and is not an empty folder; choose another one")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex[:8]}")
    try:
        partial.mkdir()
        if rgb == "video":
            write_video(partial / "rgb.mp4", clip.rgb, frames_per_s=_frame_rate(clip.stamp_s), crf=12, preset="slow")
        else:
            (partial / "rgb").mkdir()
            for t, image in enumerate(clip.rgb):
                _write_png(partial / "rgb" / f"{t:06d}.png", image[..., ::-1])
        scale = 1e-3 if depth_scale_m is None else check_depth_scale(depth_scale_m)
        if clip.depth_m is not None:
            scale = 1e-4 if depth_scale_m is None and clip.depth_m.max() < 6.5 else scale
            (partial / "depth").mkdir()
            units = np.rint(clean_depth(clip.depth_m) / np.float32(scale))
            units = np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
            for t, image in enumerate(units):
                _write_png(partial / "depth" / f"{t:06d}.png", image)
        static = (clip.cam_from_world == clip.cam_from_world[0]).all()
        poses = clip.cam_from_world[0] if static else clip.cam_from_world
        file = CameraFile(clip.camera, scale, _frame_rate(clip.stamp_s), clip.stamp_s, poses)
        write_camera(file, partial / "camera.json")
        if target.exists():
            target.rmdir()
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _frame_rate(stamp_s: np.ndarray) -> float:
    seconds = float(stamp_s[-1] - stamp_s[0])
    return (len(stamp_s) - 1) / seconds if seconds > 0 else 30.0


def _write_png(path: Path, image: np.ndarray) -> None:
    done, data = cv2.imencode(".png", image)
    assert done, "OpenCV encodes 8-bit colour and 16-bit grey as PNG"
    path.write_bytes(data.tobytes())  # not imwrite: it fails silently, and on some platforms on non-ASCII paths


def _read_colours(source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Frames and their times; times of images follow a nominal rate of 30 a second."""
    if source.is_file():
        return read_video(source)
    if (source / "rgb").is_dir():
        folder = source / "rgb"
    else:
        videos = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
        if len(videos) == 1:
            return read_video(videos[0])
        if len(videos) > 1:
            found = ", ".join(video.name for video in videos)
            raise RecordingError(f"recording {source}: expected one video, got {found}; name the video itself")
        folder = source
    paths = _list_images(folder, IMAGE_SUFFIXES)
    if not paths:
        raise RecordingError(
            f"recording {source}: no frames; expected images in {source / 'rgb'}, or a video such as rgb.mp4"
        )
    images = [np.asarray(_open_image(path).convert("RGB")) for path in paths]
    _check_sizes(paths, images)
    return np.stack(images), np.arange(len(images)) / 30.0


def _read_depth(folder: Path, frames: int, size: tuple[int, int], scale_m: float) -> np.ndarray:
    """Depth in metres of all frames, float32, 0 where missing."""
    if not folder.is_dir():
        raise RecordingError(f"depth {folder}: no such folder; expected one 16-bit PNG per colour frame")
    paths = _list_images(folder, (".png",))
    if len(paths) != frames:
        raise RecordingError(
            f"depth {folder}: {len(paths)} depth images for {frames} colour frames; expected one for each, "
            "cut the longer one or drop frames without a partner"
        )
    depth_m = np.empty((frames, size[1], size[0]), dtype=np.float32)
    for t, path in enumerate(paths):
        image = _open_image(path)
        if image.mode not in ("I;16", "I;16B", "I"):
            raise RecordingError(
                f"depth image {path}: expected 16-bit grey, got mode {image.mode}; "
                "write depth as 16-bit PNGs (millimetres, say), not as a coloured or 8-bit picture"
            )
        if image.size != size:
            raise RecordingError(
                f"depth image {path}: {image.width} x {image.height}, but colour frames are {size[0]} x {size[1]}; "
                "align the depth to the colour camera first"
            )
        depth_m[t] = np.asarray(image).astype(np.float32) * np.float32(scale_m)
    return depth_m


def _check_units(depth_m: np.ndarray, where: Path | str, scale_m: float) -> None:
    """Raise RecordingError if the median depth is not one that a camera sees."""
    step = max(1, len(depth_m) // 16)
    sample = depth_m[::step, ::2, ::2] if depth_m[0].size > 64 else depth_m
    valid = sample[sample > 0]
    if valid.size == 0:
        valid = depth_m[depth_m > 0]
    if valid.size == 0:
        raise RecordingError(f"depth of {where}: every pixel is missing; leave the depth out to use colours only")
    median_m = float(np.median(valid))
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median_m <= high:
        return
    likely = min(_USUAL_SCALES_M, key=lambda scale: abs(np.log(median_m / scale_m * scale / _USUAL_DEPTH_M)))
    raise RecordingError(
        f"depth of {where}: the median is {median_m:.3g} m with depth_scale_m = {scale_m:g}, expected {low:g} to "
        f"{high:g} m; the units are wrong, depth_scale_m = {likely:g} would give {median_m / scale_m * likely:.2f} m"
    )


def _list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    return sorted(paths, key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sorts frame 2 before frame 10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts] + [(0, 0, path.suffix)]


def _open_image(path: Path) -> Image.Image:
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except UnidentifiedImageError:
        raise RecordingError(f"image {path}: not an image; the file is torn, copy or record it again") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise RecordingError(
            f"image {path}: cannot be decoded ({error}); the file is torn, copy or record it again"
        ) from error


def _check_sizes(paths: list[Path], images: list[np.ndarray]) -> None:
    for path, image in zip(paths, images, strict=True):
        if image.shape != images[0].shape:
            raise RecordingError(
                f"image {path}: {image.shape[1]} x {image.shape[0]}, but {paths[0].name} is {images[0].shape[1]} x "
                f"{images[0].shape[0]}; all frames must be of one size"
            )
