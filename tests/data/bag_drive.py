"""Messages of a robot that drives past with a colour camera and depth, for tests that read bags."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quest.data.frame_source import Parts
from quest.data.recording import open_recording
from quest.types import Camera, Frame
from tests.data.bags import (
    COLOUR,
    COLOUR_FRAME,
    COLOUR_INFO,
    DEPTH,
    SECOND,
    Sent,
    camera_info,
    image,
    transform,
    write_bag,
    write_mcap,
    write_ros1,
)

CAMERA = Camera(40.0, 41.0, 16.2, 12.1, 32, 24)
IMAGE, INFO, TF = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
FRAMES = 8
BEGIN = 1_700_000_000 * SECOND
STEP = SECOND // 20
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (FRAMES, 24, 32, 3)).astype(np.uint8)
DEPTH_MM = RNG.integers(500, 3000, (FRAMES, 24, 32)).astype(np.uint16)
OPTICAL = np.eye(4)
OPTICAL[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]

WRITERS: dict[str, Callable[[Path, Sequence[Sent]], Path]] = {
    "mcap": lambda folder, sent: write_mcap(folder / "bag.mcap", sent),
    "sqlite3 folder": lambda folder, sent: write_bag(folder / "bag", sent),
    "mcap folder": lambda folder, sent: write_bag(folder / "bag", sent, storage="mcap"),
    "ros1": lambda folder, sent: write_ros1(folder / "bag.bag", sent),
}


def base_at(seconds: float) -> np.ndarray:
    """Where the robot is: it drives and turns evenly."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 0.4 * seconds).as_matrix()
    pose[:3, 3] = [0.5 * seconds, 0.1, 0.3]
    return pose


def colours(t: int, *, at_ns: int | None = None, **changes: Any) -> Sent:
    stamp = BEGIN + t * STEP if at_ns is None else at_ns
    return COLOUR, IMAGE, image(RGB[t], "rgb8", stamp) | changes, stamp


def depths(t: int, *, at_ns: int | None = None, topic: str = DEPTH) -> Sent:
    stamp = BEGIN + t * STEP if at_ns is None else at_ns
    return topic, IMAGE, image(DEPTH_MM[t], "16UC1", stamp), stamp


def info(t: int = 0, camera: Camera = CAMERA, **changes: Any) -> Sent:
    return COLOUR_INFO, INFO, camera_info(camera, BEGIN + t * STEP, **changes), BEGIN + t * STEP


def recording() -> list[Sent]:
    """A driving robot: colours, aligned depth a little later, cameras, and transforms between the frames' times."""
    mount = np.eye(4)
    mount[:3, 3] = [0.1, 0.02, 0.5]
    sent: list[Sent] = [
        ("/tf_static", TF, transform("base", "camera_link", mount, BEGIN), BEGIN),
        ("/tf_static", TF, transform("camera_link", COLOUR_FRAME, OPTICAL, BEGIN), BEGIN),
    ]
    for t in range(FRAMES):
        sent += [info(t), colours(t), depths(t, at_ns=BEGIN + t * STEP + STEP // 10)]
    for k in range(-2, 4 * FRAMES):
        at = BEGIN + k * STEP // 3
        sent.append(("/tf", TF, transform("odom", "base", base_at((at - BEGIN) / SECOND), at), at))
    return sorted(sent, key=lambda one: one[3])


def frames_of(path: Path, **parts: Any) -> tuple[list[Frame], tuple[str, ...]]:
    source = open_recording(path, parts=Parts(**parts))
    frames = list(source)
    return frames, source.flags
