"""Recordings, in whatever form: one registry of readers, and recording folders written.

A recording folder holds ``rgb/`` (images, in natural order of their names) or one video, optionally ``depth/`` (16-bit
PNGs), and ``camera.json`` (see :mod:`quest.data.camera_file`). The other forms are as their makers describe them
(:mod:`quest.data.folder` for folders).
"""

from __future__ import annotations

import difflib
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from quest.data.camera_file import CameraFile, check_depth_scale, write_camera
from quest.data.frame_source import FrameSource, Parts, Reader, ReadOptions, naming
from quest.data.video import frame_rate, write_video
from quest.depth import clean_depth
from quest.errors import InputError, QuestError, RecordingError
from quest.types import Camera, Clip
from quest.untrusted import reading

_READERS = ("live_camera", "sample", "store", "lerobot", "bags", "folder")
"""Modules of this room with ``READERS``; the first that accepts a path reads it. A new module is a line here."""


def readers() -> tuple[Reader, ...]:
    """All readers of recordings, in the order in which they are asked."""
    return tuple(reader for name in _READERS for reader in import_module(f"quest.data.{name}").READERS)


def open_recording(
    path: str | Path,
    *,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
    fov_deg: float | int | None = None,
    parts: Parts | None = None,
) -> FrameSource:
    """Open a recording; its frames are read when they are asked for.

    Args:
        path: a recording folder, one of another recorder, a folder of images, a video, a LeRobot v3 dataset, an MCAP
            file, a ROS bag (the folder of a ROS 2 bag, its ``.db3``, or a ROS 1 ``.bag``), a take (``STORE/NAME.zarr``,
            also as a URL), the word ``sample`` or ``sample-alarm`` for a packaged clip, or a live camera
            (``camera:0``, ``camera:rtsp://…``, ``realsense``), which has no end.
        depth: folder of 16-bit depth images, one per frame, of folders and videos alone; by default ``depth`` in the
            recording folder (or beside a video), where there is one. Without it there are colours only.
        camera: camera file, or the intrinsics themselves; by default those that the recording has, such as
            ``camera.json`` in the recording folder (or beside a video). Colours without any are read with a guessed
            camera, and a note says so.
        depth_scale_m: metres per unit of depth images; by default as the camera file says, else 0.001, and in bags
            millimetres in 16 bits and metres in floats.
        fov_deg: field of view across the longer side of the image, degrees, of a recording without a camera.
        parts: which parts of takes, datasets and bags to read; by default the first or only one.

    Raises:
        RecordingError: something is missing, empty, corrupt, inconsistent, or in the wrong units, or an argument is not
            for recordings of that kind.
        TakeError: there is no such take, or it is corrupt.
        MissingExtraError: bags need the extra ``ros``.
    """
    where = os.fspath(path)
    options = ReadOptions(
        **asdict(Parts() if parts is None else parts),
        depth=None if depth is None else Path(depth),
        camera=Path(camera) if isinstance(camera, str) else camera,
        depth_scale_m=_checked_scale(where, depth_scale_m, RecordingError),
        fov_deg=fov_deg,
    )
    known, there = readers(), Path(where)
    reader = next((reader for reader in known if reader.accepts(where)), None)
    if reader is None:
        if not there.exists():
            beside = [p.name for p in there.parent.iterdir()] if there.parent.is_dir() else []
            close = difflib.get_close_matches(there.name, beside, n=1)
            advice = f"did you mean {there.parent / close[0]}?" if close else "check the path"
            raise RecordingError(f"recording {where}: no such file or folder; {advice}")
        kinds = "; ".join(f"{reader.kind} ({reader.form})" for reader in known)
        what = "an empty folder" if not any(there.iterdir()) else "a folder with nothing of these in it"
        raise RecordingError(f"recording {where}: this is {what}; expected {kinds}")
    for name, value in options.given().items():
        if name not in reader.options:
            kinds = " or ".join(reader.kind for reader in known if name in reader.options)
            option = "--fov" if name == "fov_deg" else "--" + name.replace("_", "-")
            raise RecordingError(f"{where}: {option} {value} is for {kinds}, and this is {reader.kind}; omit {option}")
    with reading(f"recording {where}", RecordingError, known=QuestError), naming(f"recording {where}"):
        return reader.open(where, options)


def read_recording(
    path: str | Path,
    *,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
    fov_deg: float | int | None = None,
    parts: Parts | None = None,
) -> Clip:
    """All frames of a recording in memory; arguments and errors as of :func:`open_recording`."""
    return open_recording(
        path, depth=depth, camera=camera, depth_scale_m=depth_scale_m, fov_deg=fov_deg, parts=parts
    ).clip()


def _checked_scale(where: str | Path, depth_scale_m: float | int | None, kind: type[QuestError]) -> float | None:
    try:
        return None if depth_scale_m is None else check_depth_scale(depth_scale_m)
    except ValueError as error:
        raise kind(f"recording {where}: {error}") from error


def write_recording(
    clip: Clip,
    folder: str | Path,
    *,
    rgb: Literal["video", "png"] = "video",
    crf: int = 12,
    depth_scale_m: float | None = None,
) -> None:
    """Write a clip as a recording folder, all or nothing. A video is H.264 of high quality, not lossless.

    Args:
        clip: the clip.
        folder: must not exist, or be empty.
        rgb: colours as ``rgb.mp4`` or as lossless images.
        crf: quality of the video, as in :func:`quest.data.video.write_video`; a larger number makes a smaller file.
        depth_scale_m: metres per unit of the depth images; by default 0.1 mm where all is below 6.5 m, else 1 mm.

    Raises:
        InputError: the folder has something in it, or the scale of depth is not a positive number.
    """
    scale = _checked_scale(folder, depth_scale_m, InputError) or 1e-3
    with whole_folder(folder, "recording") as partial:
        if rgb == "video":
            write_video(partial / "rgb.mp4", clip.rgb, frames_per_s=frame_rate(clip.stamp_s), crf=crf, preset="slow")
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
        file = CameraFile(clip.camera, depth_scale_m=scale, frames_per_s=frame_rate(clip.stamp_s), stamp_s=clip.stamp_s)
        poses = clip.cam_from_world[0] if static else clip.cam_from_world
        write_camera(replace(file, cam_from_world=poses), partial / "camera.json")


@contextmanager
def whole_folder(folder: str | Path, what: str) -> Iterator[Path]:
    """Where to write a folder that gets its name when all is written; a failure leaves nothing.

    Raises:
        InputError: the folder is there already and has something in it.
    """
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{what} {target}: exists and is not an empty folder; choose another one")
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex[:8]}")
    partial.mkdir(parents=True)
    try:
        yield partial
        if target.exists():
            target.rmdir()
        partial.rename(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write_png(path: Path, image: np.ndarray) -> None:
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])  # depth: a third of the usual size
    assert done, "OpenCV encodes 8-bit colour and 16-bit grey as PNG"
    path.write_bytes(data.tobytes())  # not imwrite: it fails silently, and on some platforms on non-ASCII paths
