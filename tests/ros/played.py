"""A bag of the packaged clip, and how its messages are played to the node."""

from __future__ import annotations

import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from quest.types import Clip
from tests.data.bags import COLOUR, COLOUR_INFO, DEPTH, SECOND, Sent, camera_info, image, write_bag

START_NS = 1_700_000_000 * SECOND


def sent_of(clip: Clip, frames: int, *, start_ns: int = START_NS) -> list[Sent]:
    """Colours, depth in millimetres and camera_info of the first frames, as a camera sends them."""
    assert clip.depth_m is not None
    sent: list[Sent] = []
    for t in range(frames):
        stamp_ns = start_ns + round(clip.stamp_s[t] * 1e9)
        depth = np.rint(clip.depth_m[t] * 1000).astype(np.uint16)
        sent.append((COLOUR_INFO, "sensor_msgs/msg/CameraInfo", camera_info(clip.camera, stamp_ns), stamp_ns))
        sent.append((COLOUR, "sensor_msgs/msg/Image", image(clip.rgb[t], "rgb8", stamp_ns), stamp_ns))
        sent.append((DEPTH, "sensor_msgs/msg/Image", image(depth, "16UC1", stamp_ns), stamp_ns))
    return sent


def bag_of(clip: Clip, frames: int, path: Path) -> Path:
    return write_bag(path, sent_of(clip, frames))


def play(path: Path) -> Iterator[tuple[str, Any, int]]:
    """Topic, message and time of logging; bytes come as rclpy gives them."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(path) as reader:
        for connection, log_ns, data in reader.messages():
            message: Any = store.deserialize_cdr(data, connection.msgtype)
            if hasattr(message, "data"):
                message.data = array.array("B", message.data.tobytes())
            yield connection.topic, message, log_ns
