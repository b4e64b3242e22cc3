"""Clips as MCAP files of ROS 2 messages, which Foxglove, rosbag2 and :mod:`quest.data.bags` read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from quest.depth import clean_depth
from quest.errors import InputError
from quest.extras import require
from quest.types import Camera, Clip, Tracks
from quest.whole_file import whole_file

WORLD = "world"
CAMERA = "camera_color_optical_frame"
COLOUR, DEPTH, TRACKS = "/camera/color", "/camera/aligned_depth_to_color", "/quest/tracks"

_MARKER_M = 0.015
_COLOURS = ((0.90, 0.27, 0.22), (0.16, 0.55, 0.90), (0.20, 0.70, 0.35), (0.95, 0.65, 0.10), (0.60, 0.35, 0.80))
_ADD, _DELETE = 0, 2
_SPHERE, _TEXT = 2, 9


def export_mcap(
    clip: Clip,
    path: str | Path,
    *,
    tracks: Tracks | None = None,
    rgb: Literal["jpeg", "raw"] = "jpeg",
    depth: Literal["16UC1", "32FC1"] = "16UC1",
    quality: int = 95,
) -> None:
    """Write a clip as an MCAP file, all or nothing; an existing file is replaced.

    Topics are named as a RealSense driver does: colours and their CameraInfo under ``/camera/color``, aligned depth
    and its CameraInfo under ``/camera/aligned_depth_to_color``, the camera's pose from ``world`` on ``/tf_static``, or
    on ``/tf`` where it moves, and tracks as ``/quest/tracks`` (MarkerArray: a ball and a name for what is seen).

    Args:
        clip: what to write.
        path: the file.
        tracks: answers on the clip, to look at beside it.
        rgb: colours as JPEG (CompressedImage) or as they are (Image).
        depth: millimetres in 16 bits, which end at 65.5 m, or metres as float32 without loss.
        quality: of JPEG, 1 to 100.

    Raises:
        InputError: time stamps before 0, or tracks of another number of frames.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    require("mcap")
    writer_module = require("mcap_ros2.writer")
    if clip.stamp_s[0] < 0:
        raise InputError(f"clip {clip.name!r}: MCAP has no times before 0, got {clip.stamp_s[0]} s; shift the stamps")
    if tracks is not None and len(tracks) != len(clip):
        raise InputError(f"clip {clip.name!r}: tracks of {len(tracks)} frames for a clip of {len(clip)}")
    typesys = require("rosbags.typesys")
    store, schemas = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), {}
    with whole_file(Path(path)) as partial, partial.open("wb") as file, writer_module.Writer(file) as writer:
        for t in range(len(clip)):
            stamp_ns = round(float(clip.stamp_s[t]) * 1e9)
            messages = [*_messages(clip, t, stamp_ns, rgb, depth, quality)]
            if tracks is not None:
                messages.append((TRACKS, "visualization_msgs/msg/MarkerArray", _markers(tracks, t, stamp_ns)))
            for topic, kind, message in messages:  # fields that are left out are zero
                if kind not in schemas:
                    schemas[kind] = writer.register_msgdef(kind, store.generate_msgdef(kind, ros_version=2)[0])
                writer.write_message(topic, schemas[kind], message, log_time=stamp_ns)


def _messages(
    clip: Clip, t: int, stamp_ns: int, rgb: str, depth: str, quality: int
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Topic, type and fields of everything that belongs to one frame but its tracks."""
    header = _header(CAMERA, stamp_ns)
    moving = not (clip.cam_from_world == clip.cam_from_world[0]).all()
    if moving or t == 0:
        transform = _transform(clip.cam_from_world[t], stamp_ns)
        yield "/tf" if moving else "/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [transform]}
    info = _camera_info(clip.camera, header)
    yield f"{COLOUR}/camera_info", "sensor_msgs/msg/CameraInfo", info
    if rgb == "jpeg":
        done, data = cv2.imencode(".jpg", clip.rgb[t][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        assert done, "OpenCV encodes 8-bit colours as JPEG"
        image = {"header": header, "format": "rgb8; jpeg compressed bgr8", "data": data.tobytes()}
        yield f"{COLOUR}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", image
    else:
        yield f"{COLOUR}/image_raw", "sensor_msgs/msg/Image", _image(header, "rgb8", clip.rgb[t])
    if clip.depth_m is not None:
        yield f"{DEPTH}/camera_info", "sensor_msgs/msg/CameraInfo", info
        pixels = clean_depth(clip.depth_m[t])
        if depth == "16UC1":
            units = np.rint(pixels * np.float32(1000))
            pixels = np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
        yield f"{DEPTH}/image_raw", "sensor_msgs/msg/Image", _image(header, depth, pixels)


def _header(frame: str, stamp_ns: int) -> dict[str, Any]:
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def _image(header: dict[str, Any], encoding: str, pixels: np.ndarray) -> dict[str, Any]:
    little = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder("<")))
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": little.strides[0]}
    return {"header": header, "encoding": encoding, **size, "data": little.tobytes()}


def _camera_info(camera: Camera, header: dict[str, Any]) -> dict[str, Any]:
    """CameraInfo, whose pixel centres lie at integers."""
    k = [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0]
    lens = {"distortion_model": "plumb_bob", "d": [0.0] * 5, "k": k, "r": np.eye(3).ravel().tolist()}
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    return {"header": header, "height": camera.height, "width": camera.width, **lens, "p": p}


def _transform(cam_from_world: Float[np.ndarray, "4 4"], stamp_ns: int) -> dict[str, Any]:
    rotation = cam_from_world[:3, :3].T
    moved = dict(zip("xyz", (-rotation @ cam_from_world[:3, 3]).tolist(), strict=True))
    turned = dict(zip("xyzw", Rotation.from_matrix(rotation).as_quat().tolist(), strict=True))
    transform = {"translation": moved, "rotation": turned}
    return {"header": _header(WORLD, stamp_ns), "child_frame_id": CAMERA, "transform": transform}


def _markers(tracks: Tracks, t: int, stamp_ns: int) -> dict[str, Any]:
    """A ball and a name per query; those without a place are taken away."""
    markers = []
    for k, name in enumerate(tracks.names):
        point = tracks.point_world[t, k]
        shown = bool(np.isfinite(point).all())
        x, y, z = (float(value) for value in (point if shown else np.zeros(3)))
        colour = dict(zip("rgb", _COLOURS[k % len(_COLOURS)], strict=True))
        both = {
            "header": _header(WORLD, stamp_ns),
            "action": _ADD if shown else _DELETE,
            "scale": dict.fromkeys("xyz", _MARKER_M),
            "color": colour | {"a": 1.0 if tracks.visible[t, k] else 0.4},
        }
        ball, above = {"x": x, "y": y, "z": z}, {"x": x, "y": y, "z": z + 1.5 * _MARKER_M}
        pose = {"position": ball, "orientation": {"w": 1.0}}
        markers.append(both | {"ns": "points", "id": 2 * k, "type": _SPHERE, "pose": pose})
        words = {"text": f"{name} {tracks.state[t, k]}", "pose": pose | {"position": above}}
        markers.append(both | {"ns": "names", "id": 2 * k + 1, "type": _TEXT} | words)
    return {"markers": markers}
