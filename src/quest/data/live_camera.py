"""Live sources: frames come at their own pace, and whoever is busy gets the newest one.

A camera is ``camera:0`` (the system's first), ``camera:/dev/video2``, or the address of a stream: ``camera:rtsp://…``;
RealSense cameras are ``realsense``, or ``realsense:SERIAL`` where several are connected.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from quest.data.camera_file import CameraFile, read_setup
from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions
from quest.errors import RecordingError
from quest.extras import require
from quest.types import GUESSED_CAMERA, Camera, Frame

DROPPED = "frames dropped because the one before took too long"
_PREFIX = "camera:"
_REALSENSE_SIZE, _REALSENSE_RATE = (640, 480), 30
_PATIENCE_S = 5.0
"""For how long a camera may send nothing."""


def newest(frames: Callable[[], Iterator[Frame]], notes: Notes) -> Generator[Frame]:
    """Frames of a thread that reads as fast as they come; those that nobody takes in time are dropped and counted.

    Whatever reading raises comes after the frames before it.
    """
    ready, over = threading.Condition(), threading.Event()
    slot: list[Frame] = []
    failed: list[Exception] = []

    def read() -> None:
        try:
            for number, frame in enumerate(frames()):
                with ready:
                    if slot:
                        notes.count(DROPPED, number)
                    slot[:] = [frame]
                    ready.notify()
                if over.is_set():
                    return
        except Exception as error:  # of the camera: raised where frames are asked for
            failed.append(error)
        finally:
            over.set()
            with ready:
                ready.notify()

    thread = threading.Thread(target=read, name="camera", daemon=True)
    thread.start()
    try:
        while True:
            with ready:
                ready.wait_for(lambda: slot or over.is_set())
                if not slot:
                    break
                frame = slot.pop()
            yield frame
        if failed:
            raise failed[0]
    finally:
        over.set()
        thread.join(_PATIENCE_S)


def as_live(source: FrameSource) -> FrameSource:
    """A recording played at its own pace, as a camera would send it; frames that come meanwhile are dropped."""
    if source.live:
        return source

    def play() -> Iterator[Frame]:
        begun_s = None
        for frame in source:
            begun_s = time.monotonic() - frame.stamp_s if begun_s is None else begun_s
            time.sleep(max(0.0, begun_s + frame.stamp_s - time.monotonic()))
            yield frame

    return replace(source, frames=lambda: newest(play, source.notes), length=None, live=True)


def _accepts(where: str) -> bool:
    return where.startswith(_PREFIX)


def _open(where: str, options: ReadOptions) -> FrameSource:
    device = where.removeprefix(_PREFIX)
    with closing(_pictures(device)) as pictures:
        height, width = next(pictures).shape[:2]
    notes = Notes()
    if options.camera is None and options.fov_deg is None:
        notes.say(GUESSED_CAMERA)
    setup = read_setup(options.camera or Camera.from_fov(width, height, options.fov_deg))
    camera = setup.camera
    if (camera.width, camera.height) != (width, height):
        raise RecordingError(
            f"camera {device}: it sends {width} x {height} pixels, and the intrinsics are for {camera.width} x "
            f"{camera.height}; give those of this size"
        )
    return FrameSource(where, camera, lambda: newest(lambda: _frames(device, setup), notes), notes=notes, live=True)


def _pictures(device: str) -> Generator[np.ndarray]:
    """Pictures of a camera, sRGB, until it sends no more."""
    log: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5, and 4
    said = log.getLogLevel()
    log.setLogLevel(0)  # what cannot be opened is told below, in one line
    capture = cv2.VideoCapture(int(device) if device.isdigit() else device)
    log.setLogLevel(said)
    if not capture.isOpened():
        raise RecordingError(
            f"camera {device}: cannot be opened; check its number or address, that nothing else uses it, and that "
            "this program may use cameras"
        )
    try:
        while True:
            there, picture = capture.read()
            if not there:
                raise RecordingError(f"camera {device}: it sends no pictures any more; connect it again")
            yield np.ascontiguousarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    finally:
        capture.release()


def _frames(device: str, setup: CameraFile) -> Iterator[Frame]:
    begun_s = time.monotonic()
    with closing(_pictures(device)) as pictures:
        for picture in pictures:
            yield Frame(setup.rgb(picture), None, time.monotonic() - begun_s)


def _is_realsense(where: str) -> bool:
    return where == "realsense" or where.startswith("realsense:")


def _open_realsense(where: str, options: ReadOptions) -> FrameSource:
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
    config.enable_stream(rs.stream.color, *_REALSENSE_SIZE, rs.format.rgb8, _REALSENSE_RATE)
    config.enable_stream(rs.stream.depth, *_REALSENSE_SIZE, rs.format.z16, _REALSENSE_RATE)
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


READERS = (
    Reader("a live camera", "camera:0, or camera: and an address", _accepts, _open, ("camera", "fov_deg")),
    Reader("a RealSense camera", "realsense, or realsense:SERIAL", _is_realsense, _open_realsense),
)
