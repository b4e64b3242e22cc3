"""Small bags for the tests: a robot that drives past with a colour camera and depth, as ROS messages in any storage."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from quest.data.frame_source import Parts
from quest.data.recording import open_recording
from quest.types import Camera, Frame

SECOND = 1_000_000_000
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/depth/image_rect_raw"
COLOUR_INFO, DEPTH_INFO = "/camera/color/camera_info", "/camera/depth/camera_info"
COLOUR_FRAME, DEPTH_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame"

Sent = tuple[str, str, dict[str, Any], int]
"""Topic, type such as sensor_msgs/msg/Image, fields, and time of logging in nanoseconds."""


def header(frame: str, stamp_ns: int) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}, "frame_id": frame}


def image(
    pixels: np.ndarray,
    encoding: str,
    stamp_ns: int,
    *,
    frame: str = COLOUR_FRAME,
    pad: int = 0,
    big_endian: bool = False,
) -> dict[str, Any]:
    """An Image whose rows may end in bytes that mean nothing."""
    order = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
    rows = np.ascontiguousarray(order).reshape(pixels.shape[0], -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, pad)), constant_values=170)
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": padded.shape[1]}
    how = {"header": header(frame, stamp_ns), "encoding": encoding, "is_bigendian": int(big_endian)}
    return {**how, **size, "data": padded.tobytes()}


def compressed(data: bytes, kind: str, stamp_ns: int, *, frame: str = COLOUR_FRAME) -> dict[str, Any]:
    return {"header": header(frame, stamp_ns), "format": kind, "data": data}


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def rvl(picture: np.ndarray) -> bytes:
    """16-bit depth as RVL, number by number as the paper has it."""
    height, width = picture.shape
    groups: list[int] = []

    def put(number: int) -> None:
        while True:
            low, number = number & 7, number >> 3
            groups.append(low | (8 if number else 0))
            if not number:
                return

    values, at, before = picture.ravel().astype(int).tolist(), 0, 0
    while at < len(values):
        for wanted in (False, True):  # a run of zeros, then one of others
            end = at
            while end < len(values) and (values[end] != 0) == wanted:
                end += 1
            put(end - at)
            for value in values[at:end] if wanted else ():
                delta = value - before
                put(2 * delta if delta >= 0 else -2 * delta - 1)
                before = value
            at = end
    groups += [0] * (-len(groups) % 8)
    words = [int("".join(f"{group:x}" for group in groups[i : i + 8]), 16) for i in range(0, len(groups), 8)]
    return struct.pack("<II", width, height) + struct.pack(f"<{len(words)}I", *words)


def camera_info(
    camera: Camera,
    stamp_ns: int,
    *,
    frame: str = COLOUR_FRAME,
    model: str = "plumb_bob",
    d: Sequence[float] = (0.0,) * 5,
) -> dict[str, Any]:
    k = [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0]
    size = {"header": header(frame, stamp_ns), "height": camera.height, "width": camera.width}
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    lens = {"distortion_model": model, "d": list(d), "k": k, "r": np.eye(3).ravel().tolist(), "p": p}
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {**size, **lens, "binning_x": 0, "binning_y": 0, "roi": roi}


def transform(parent: str, child: str, parent_from_child: np.ndarray, stamp_ns: int) -> dict[str, Any]:
    """A TFMessage of one transform."""
    moved = dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True))
    turned = dict(zip("xyzw", Rotation.from_matrix(parent_from_child[:3, :3]).as_quat().tolist(), strict=True))
    both = {"translation": moved, "rotation": turned}
    return {"transforms": [{"header": header(parent, stamp_ns), "child_frame_id": child, "transform": both}]}


def write_mcap(path: Path, sent: Sequence[Sent], **options: Any) -> Path:
    """An MCAP file, by the writer of the format's makers."""
    from mcap_ros2.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store, schemas = get_typestore(Stores.ROS2_HUMBLE), {}
    with path.open("wb") as file, Writer(file, **options) as writer:
        for topic, kind, fields, log_ns in sent:
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, store.generate_msgdef(kind, ros_version=2)[0])
            writer.write_message(topic, schemas[kind], fields, log_time=log_ns)
    return path


def write_bag(path: Path, sent: Sequence[Sent], *, storage: str = "sqlite3") -> Path:
    """A rosbag2 folder, by the writer of the rosbags library."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, connections = get_typestore(Stores.ROS2_HUMBLE), {}
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        for topic, kind, fields, log_ns in sent:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], log_ns, store.serialize_cdr(_message(store, kind, fields), kind))
    return path


def write_ros1(path: Path, sent: Sequence[Sent], *, compression: str | None = None) -> Path:
    """A ROS 1 bag, by the writer of the rosbags library."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, connections = get_typestore(Stores.ROS1_NOETIC), {}
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        for number, (topic, kind, fields, log_ns) in enumerate(sent):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            message = _message(store, kind, _as_ros1(kind, fields, number))
            writer.write(connections[topic], log_ns, store.serialize_ros1(message, kind))
    return path


def _as_ros1(kind: str, fields: dict[str, Any], number: int) -> dict[str, Any]:
    """The fields by their names in ROS 1."""
    if kind.endswith("TFMessage"):
        stamped = [{**one, "header": {**one["header"], "seq": number}} for one in fields["transforms"]]
        return {"transforms": stamped}
    named = {name.upper() if name in "dkrp" else name: value for name, value in fields.items()}
    return {**named, "header": {**fields["header"], "seq": number}}


def _message(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """An object of the typestore from nested dictionaries."""
    from rosbags.interfaces import Nodetype

    values = {}
    for name, (node, what) in store.fielddefs[kind][1]:
        value = fields[name]
        if node == Nodetype.NAME:
            value = _message(store, what, value)
        elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, element), _ = what
            if inner == Nodetype.NAME:
                value = [_message(store, element, one) for one in value]
            elif isinstance(value, bytes):
                value = np.frombuffer(value, np.uint8)
            else:
                value = np.array(value, {"float64": np.float64, "float32": np.float32}[element[0]])
        values[name] = value
    return store.types[kind](**values)


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
