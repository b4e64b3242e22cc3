"""Live sources: the newest frame counts, others are dropped and counted, and what fails is told."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from quest.data.camera_file import CameraFile, write_camera
from quest.data.frame_source import Notes, source_of_clip
from quest.data.live_camera import DROPPED, as_live, newest
from quest.data.recording import open_recording
from quest.errors import RecordingError
from quest.types import GUESSED_CAMERA, Camera, Frame
from tests.track.clips import make_clip


def numbered(count: int) -> list[Frame]:
    return [Frame(np.full((4, 6, 3), t % 256, np.uint8), None, float(t)) for t in range(count)]


def test_whoever_is_busy_gets_the_newest():
    turn, done, notes = threading.Semaphore(0), threading.Semaphore(0), Notes()

    def camera() -> Iterator[Frame]:
        for frame in numbered(6):
            turn.acquire()
            yield frame
            done.release()

    frames = newest(camera, notes)
    turn.release()
    assert next(frames).stamp_s == 0
    for _ in range(4):
        turn.release()
    for _ in range(4):
        done.acquire()
    turn.release()
    assert [frame.stamp_s for frame in frames][-1] == 5
    assert any(words.startswith(DROPPED) for words in notes.words)


def test_what_a_camera_raises_comes_after_its_frames():
    def camera() -> Iterator[Frame]:
        yield numbered(1)[0]
        time.sleep(0.05)
        raise RecordingError("unplugged")

    frames = newest(camera, Notes())
    assert next(frames).stamp_s == 0
    with pytest.raises(RecordingError, match="unplugged"):
        next(frames)


def test_the_thread_ends_with_whoever_reads():
    before = threading.active_count()
    frames = newest(lambda: iter(numbered(1000)), Notes())
    next(frames)
    frames.close()
    assert threading.active_count() == before


def test_a_recording_plays_at_its_own_pace():
    clip = make_clip(frames=4)
    source = as_live(source_of_clip(clip))
    assert (source.live, source.length, as_live(source)) == (True, None, source)
    begun_s = time.monotonic()
    stamps = [frame.stamp_s for frame in source]
    assert stamps[-1] == clip.stamp_s[-1]
    assert time.monotonic() - begun_s > stamps[-1] - stamps[0] - 0.01
    with pytest.raises(RecordingError, match="has no end"):
        source.clip()


class FakeCapture:
    """As OpenCV's: pictures of one colour, blue first; then none."""

    def __init__(self, device: int | str) -> None:
        self.left = {0: 3, "rtsp://there": 3}.get(device, 0)

    def isOpened(self) -> bool:  # noqa: N802
        return self.left > 0

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.left -= 1
        return (True, np.full((6, 8, 3), (255, 0, 0), np.uint8)) if self.left >= 0 else (False, None)

    def release(self) -> None:
        self.left = 0


def test_a_webcam(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    for name in ("camera:0", "camera:rtsp://there"):
        source = open_recording(name)
        assert (source.live, source.camera, source.flags) == (True, Camera.from_fov(8, 6), (GUESSED_CAMERA,))
        frames = iter(source)
        assert next(frames).rgb[0, 0].tolist() == [0, 0, 255]
        with pytest.raises(RecordingError, match="no pictures any more"):
            list(frames)
    assert open_recording("camera:0", fov_deg=90).camera == Camera.from_fov(8, 6, 90)
    camera = Camera(9, 9, 4, 3, 8, 6)
    write_camera(CameraFile(camera), tmp_path / "camera.json")
    assert open_recording("camera:0", camera=tmp_path / "camera.json").camera == camera
    with pytest.raises(RecordingError, match="8 x 6"):
        open_recording("camera:0", camera=Camera(9, 9, 4, 3, 8, 8))
    with pytest.raises(RecordingError, match="cannot be opened"):
        open_recording("camera:7")
    with pytest.raises(RecordingError, match="--depth-scale-m"):
        open_recording("camera:0", depth_scale_m=0.001)


def test_a_realsense(monkeypatch: pytest.MonkeyPatch):
    rs = MagicMock()  # as librealsense: a camera that sends two frames
    monkeypatch.setitem(sys.modules, "pyrealsense2", rs)
    pipeline, both = rs.pipeline.return_value, rs.align.return_value.process.return_value
    lens = SimpleNamespace(fx=600.0, fy=601.0, ppx=320.0, ppy=240.0, width=640, height=480, coeffs=[0.0] * 5)
    stream, device = (getattr(pipeline.start.return_value, name).return_value for name in ("get_stream", "get_device"))
    stream.as_video_stream_profile.return_value.get_intrinsics.return_value = lens
    device.first_depth_sensor.return_value.get_depth_scale.return_value = 0.001
    both.get_color_frame.return_value.get_data.return_value = np.zeros((480, 640, 3), np.uint8)
    both.get_color_frame.return_value.get_timestamp.return_value = 1500.0
    both.get_depth_frame.return_value.get_data.return_value = np.full((480, 640), 1250, np.uint16)
    pipeline.wait_for_frames.side_effect = [None, None, RuntimeError("Frame didn't arrive within 5000")]
    source = open_recording("realsense:123")
    rs.config.return_value.enable_device.assert_called_once_with("123")
    assert source.camera == Camera(600, 601, 320.5, 240.5, 640, 480)
    frames = iter(source)
    frame = next(frames)
    assert frame.depth_m is not None
    assert (float(frame.depth_m[0, 0]), frame.stamp_s) == (1.25, 1.5)
    with pytest.raises(RecordingError, match="sends no frames any more"):
        list(frames)
    assert pipeline.start.call_count == pipeline.stop.call_count == 2
    pipeline.start.side_effect = RuntimeError("No device connected")
    with pytest.raises(RecordingError, match="No device connected"):
        open_recording("realsense:9")
