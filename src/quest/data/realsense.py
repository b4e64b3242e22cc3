"""RealSense cameras, live: ``realsense``, or ``realsense:SERIAL`` where several are connected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions
from quest.data.live_camera import newest
from quest.errors import RecordingError
from quest.extras import require
from quest.types import Camera, Frame

_SIZE = (640, 480)
_RATE = 30


def _accepts(where: str) -> bool:
    return where == "realsense" or where.startswith("realsense:")


def _open(where: str, options: ReadOptions) -> FrameSource:
    serial = where.partition(":")[2]
    pipeline, profile = _start(serial)
    try:
        rs = require("pyrealsense2")
        lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    finally:
        pipeline.stop()
    matrix = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]])
    camera, notes = Camera.from_opencv(matrix, width=lens.width, height=lens.height), Notes()
    if any(lens.coeffs):
        notes.say("the lens' distortion is not corrected")
    return FrameSource(where, camera, lambda: newest(lambda: _grab(serial), notes), notes=notes, live=True)


def _start(serial: str) -> tuple[Any, Any]:
    """A pipeline that runs, and its profile."""
    rs = require("pyrealsense2")
    pipeline, config = rs.pipeline(), rs.config()
    if serial:
        config.enable_device(serial)
    config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, _RATE)
    config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, _RATE)
    try:
        return pipeline, pipeline.start(config)
    except RuntimeError as error:
        raise RecordingError(
            f"realsense {serial}: cannot be started ({error}); check that it is connected, that nothing else uses it, "
            "and its serial number"
        ) from error


def _grab(serial: str) -> Iterator[Frame]:
    """Colours, depth registered to them, and the time of the colours by the camera's clock."""
    rs = require("pyrealsense2")
    pipeline, profile = _start(serial)
    try:
        scale_m = profile.get_device().first_depth_sensor().get_depth_scale()
        align = rs.align(rs.stream.color)
        while True:
            both = align.process(pipeline.wait_for_frames())
            colours, depth = both.get_color_frame(), both.get_depth_frame()
            if not colours:
                continue
            depth_m = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(scale_m) if depth else None
            yield Frame(np.array(colours.get_data()), depth_m, colours.get_timestamp() / 1e3)
    except RuntimeError as error:
        raise RecordingError(f"realsense {serial}: it sends no frames any more ({error}); connect it again") from error
    finally:
        pipeline.stop()


READER = Reader("a RealSense camera", "realsense, or realsense:SERIAL", _accepts, _open)
