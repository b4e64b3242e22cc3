"""Recordings of real cameras, whatever they are kept in: folders, videos, LeRobot datasets, MCAP files, ROS bags.

A recording folder holds ``rgb/`` (images, in natural order of their names) or one video, optionally ``depth/`` (16-bit
PNGs), and ``camera.json`` (see :mod:`quest.data.camera_file`). The others are as their makers describe them; what is
read of them is in :mod:`quest.data.lerobot` and :mod:`quest.data.ros_frames`.
"""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Collection
from dataclasses import fields
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from quest.data.camera_file import CameraFile, check_depth_scale, write_camera
from quest.data.folder import open_folder, read_scale
from quest.data.frame_source import PLAUSIBLE_DEPTH_M, FrameSource, Parts, clean_depth
from quest.data.video import frame_rate, write_video
from quest.errors import InputError, RecordingError
from quest.types import Camera, Clip

__all__ = [
    "PLAUSIBLE_DEPTH_M",
    "FrameSource",
    "Parts",
    "clean_depth",
    "open_recording",
    "read_recording",
    "write_recording",
]

_BAG_SUFFIXES = (".bag", ".db3")
_OF_DATASETS = ("episode", "camera_key")
_OF_BAGS = tuple(field.name for field in fields(Parts) if field.name not in _OF_DATASETS)


def open_recording(
    path: str | Path,
    *,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
    parts: Parts | None = None,
) -> FrameSource:
    """Open a recording; its frames are read when they are asked for.

    Args:
        path: a recording folder, a folder of images, a video, a LeRobot v3 dataset, an MCAP file, or a ROS bag (the
            folder of a ROS 2 bag, its ``.db3``, or a ROS 1 ``.bag``).
        depth: folder of 16-bit depth images, one per frame, of folders and videos alone; by default ``depth`` in the
            recording folder (or beside a video), where there is one. Without it there are colours only.
        camera: camera file, or the intrinsics themselves; by default ``camera.json`` in the recording folder (or beside
            a video), or what the bag says.
        depth_scale_m: metres per unit of depth images; by default what the camera file says, else 0.001, and in bags
            millimetres in 16 bits and metres in floats.
        parts: what to read of datasets and bags; by default what there is.

    Raises:
        RecordingError: something is missing, empty, torn, inconsistent, or in the wrong units, or an argument is not
            for recordings of that kind.
        MissingExtraError: bags need the extra ``ros``.
    """
    source = Path(path)
    if not source.exists():
        raise RecordingError(f"recording {source}: no such file or folder; check the path")
    parts = Parts() if parts is None else parts
    scale_m = read_scale(source, depth_scale_m)
    if source.is_dir() and (source / "meta" / "info.json").is_file():
        from quest.data.lerobot import open_lerobot

        _refuse_folder(source, depth, "a LeRobot dataset has its depth in a feature of its own")
        refuse_parts(f"dataset {source}", parts, allowed=_OF_DATASETS)
        return open_lerobot(
            source,
            episode=parts.episode,
            camera_key=parts.camera_key,
            camera=_as_path(camera),
            depth_scale_m=scale_m,
        )
    if is_bag(source):
        _refuse_folder(source, depth, "a bag has its depth in a topic, which --topic-depth names")
        refuse_parts(f"bag {source}", parts, allowed=_OF_BAGS)
        return _open_bag(source, _as_path(camera), scale_m, parts)
    refuse_parts(f"recording {source}", parts, allowed=())
    return open_folder(
        source, depth=None if depth is None else Path(depth), camera=_as_path(camera), depth_scale_m=scale_m
    )


def read_recording(
    path: str | Path,
    *,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
    parts: Parts | None = None,
) -> Clip:
    """All frames of a recording in memory; arguments and errors as of :func:`open_recording`."""
    return open_recording(path, depth=depth, camera=camera, depth_scale_m=depth_scale_m, parts=parts).clip()


def is_bag(path: Path) -> bool:
    """Whether a path is an MCAP file or a ROS bag, by its name or its ``metadata.yaml``."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in (".mcap", *_BAG_SUFFIXES)


def refuse_parts(what: str, parts: Parts, *, allowed: Collection[str]) -> None:
    """Raise RecordingError if a part is named that recordings of that kind do not have.

    Args:
        what: the recording, for the message.
        parts: what was asked for.
        allowed: fields of :class:`Parts` that mean something there.
    """
    usual = Parts()
    for field in fields(Parts):
        value = getattr(parts, field.name)
        if field.name not in allowed and value != getattr(usual, field.name):
            kind = "LeRobot datasets" if field.name in _OF_DATASETS else "bags"
            option = "--" + field.name.replace("_", "-")
            raise RecordingError(f"{what}: {option} {value} is for {kind}, and this is none; leave {option} out")


def _refuse_folder(source: Path, depth: str | Path | None, why: str) -> None:
    if depth is not None:
        raise RecordingError(
            f"recording {source}: depth {depth} is for folders of images and videos, but {why}; leave --depth out"
        )


def _open_bag(source: Path, camera: Path | Camera | None, depth_scale_m: float | None, parts: Parts) -> FrameSource:
    from quest.data.folder import read_setup
    from quest.data.ros_frames import open_messages

    if source.is_file() and source.suffix.lower() == ".mcap":
        from quest.data.mcap_file import McapMessages

        messages = McapMessages(source)
    else:
        from quest.data.rosbag import BagMessages

        messages = BagMessages(source)
    setup = None if camera is None else read_setup(source, camera, None)
    return open_messages(messages, parts, setup=setup, depth_scale_m=depth_scale_m)


def _as_path(camera: str | Path | Camera | None) -> Path | Camera | None:
    return Path(camera) if isinstance(camera, str) else camera


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
        InputError: the folder has something in it, or the scale of depth is not a positive number.
    """
    try:
        scale = 1e-3 if depth_scale_m is None else check_depth_scale(depth_scale_m)
    except ValueError as error:
        raise InputError(f"recording {folder}: {error}") from None
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"recording {target}: exists and is not an empty folder; choose another one")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex[:8]}")
    try:
        partial.mkdir()
        if rgb == "video":
            write_video(partial / "rgb.mp4", clip.rgb, frames_per_s=frame_rate(clip.stamp_s), crf=12, preset="slow")
        else:
            (partial / "rgb").mkdir()
            for t, image in enumerate(clip.rgb):
                _write_png(partial / "rgb" / f"{t:06d}.png", image[..., ::-1])
        if clip.depth_m is not None:
            scale = 1e-4 if depth_scale_m is None and clip.depth_m.max() < 6.5 else scale
            (partial / "depth").mkdir()
            units = np.rint(clean_depth(clip.depth_m) / np.float32(scale))
            units = np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
            for t, image in enumerate(units):
                _write_png(partial / "depth" / f"{t:06d}.png", image)
        static = (clip.cam_from_world == clip.cam_from_world[0]).all()
        poses = clip.cam_from_world[0] if static else clip.cam_from_world
        file = CameraFile(clip.camera, scale, frame_rate(clip.stamp_s), clip.stamp_s, poses)
        write_camera(file, partial / "camera.json")
        if target.exists():
            target.rmdir()
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write_png(path: Path, image: np.ndarray) -> None:
    done, data = cv2.imencode(".png", image)
    assert done, "OpenCV encodes 8-bit colour and 16-bit grey as PNG"
    path.write_bytes(data.tobytes())  # not imwrite: it fails silently, and on some platforms on non-ASCII paths
