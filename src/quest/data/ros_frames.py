"""ROS messages as RGB-D frames: colour and depth paired by time, rectified, registered, and posed by tf.

Which topics are the colours, the depth, their cameras and the transforms is found by their types and names.

Times are those of the messages' headers, or of logging where nobody set them. A frame waits for its depth and its pose
until they have come or half a second has passed, so that memory stays bounded however long the bag is.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from quest.data.camera_file import CameraFile, read_setup
from quest.data.frame_source import FrameSource, Notes, Parts, ReadOptions, naming
from quest.data.registration import Distortion, Rig
from quest.data.ros_images import depth_of, encoding_of, header_ns, is_depth, is_grey, rgb_of, unit_of
from quest.data.transforms import STALE_S, Transforms, frame_name
from quest.errors import RecordingError
from quest.types import Camera, Frame

_PICTURES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
_INFO = "sensor_msgs/CameraInfo"
_TRANSFORMS = ("tf2_msgs/TFMessage", "tf/tfMessage")
"""Types of messages; the second of transforms is that of ROS 1."""

_TRANSPORTS = re.compile(r"/(compressed|compressedDepth)$")
_COLOUR = re.compile(r"colou?r|rgb", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)
_ALIGNED = re.compile(r"aligned|registered|depth_to_(rgb|colou?r)", re.IGNORECASE)
_PATIENCE_NS = 500_000_000
_SCAN_NS = 2_000_000_000
_LATE_NS = 1_000_000_000

BAG_OPTIONS = (
    *("topic_rgb", "topic_depth", "topic_info", "topic_depth_info", "world_frame", "sync_s"),
    *("camera", "depth_scale_m"),
)
"""Fields of :class:`quest.data.frame_source.ReadOptions` that readers of bags know."""

NO_POSE = "no tf joins the camera to another frame: the world is the camera"
NO_DEPTH = "no topic of depth: colours only"
LATE = "colours out of order: omitted"
NO_STAMP = "headers have no time: that of logging is used"
CAMERA_CHANGED = "camera_info changes on the way: the first is used"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    kind: str
    """Message type such as ``sensor_msgs/Image``."""
    number: int | None
    """Of messages; None if the bag does not tell."""


@dataclass(frozen=True)
class Messages:
    """The messages of a bag, however they are stored."""

    path: Path
    """The file or folder."""
    topics: dict[str, Topic]
    """By name."""
    read: Callable[[Collection[str]], Iterator[tuple[str, int, Any]]]
    """Topic, time of logging in nanoseconds and message, of some topics, in the order of logging; a RecordingError
    where the bag is corrupt or a message cannot be decoded."""
    _firsts: dict[str, Any] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """The bag, for messages."""
        return f"bag {self.path}"

    def first(self, topic: str) -> Any | None:
        """The first message of a topic, which is read once; None if it has none."""
        if topic not in self._firsts:
            self._firsts[topic] = next(self.read([topic]), (topic, 0, None))[2]
        return self._firsts[topic]

    def of_kind(self, *kinds: str) -> list[str]:
        """The topics of some types."""
        return sorted(name for name, topic in self.topics.items() if topic.kind in kinds)

    def error(self, words: str) -> RecordingError:
        """An error that lists the topics that there are."""
        listed = ", ".join(
            f"{name} ({topic.kind}, {'some' if topic.number is None else topic.number})"
            for name, topic in sorted(self.topics.items())
        )
        return RecordingError(f"{self.where}: {words}; topics found: {listed}")


@dataclass(frozen=True)
class Chosen:
    """The topics that make a recording; each has a message, but for those of transforms."""

    rgb: str
    depth: str | None
    info: str | None
    """CameraInfo of the colours; None if there is none, as of the depth."""
    depth_info: str | None
    moving: tuple[str, ...]
    """Of transforms that change."""
    static: tuple[str, ...]
    """Of transforms that do not."""


def choose(messages: Messages, parts: Parts) -> Chosen:
    """Find the topics, or check those that are named.

    Raises:
        RecordingError: there are no pictures, several that could be meant, or a named topic is missing or of another
            type; the message lists what there is.
    """

    def there(topic: str | None) -> str | None:
        return None if topic is None or messages.first(topic) is None else topic

    rgb = _named(messages, "--topic-rgb", parts.topic_rgb, _PICTURES) or _colours(messages)
    if there(rgb) is None:
        raise messages.error(f"topic {rgb} has no messages")
    depth = depth_info = None
    if parts.topic_depth != "none":
        depth = there(_named(messages, "--topic-depth", parts.topic_depth, _PICTURES) or _depth(messages, rgb))
    info = _named(messages, "--topic-info", parts.topic_info, (_INFO,)) or _info_of(messages, rgb)
    if depth is not None:
        named = _named(messages, "--topic-depth-info", parts.topic_depth_info, (_INFO,))
        depth_info = there(named or _info_of(messages, depth))
    transforms = messages.of_kind(*_TRANSFORMS)
    static = tuple(name for name in transforms if name.endswith("_static"))
    moving = tuple(name for name in transforms if name not in static)
    return Chosen(rgb, depth, there(info), depth_info, moving, static)


def base_of(topic: str) -> str:
    """Name of the raw topic of a compressed one."""
    return _TRANSPORTS.sub("", topic)


def _named(messages: Messages, argument: str, topic: str | None, kinds: tuple[str, ...]) -> str | None:
    if topic is None:
        return None
    known = messages.topics.get(topic)
    if known is None:
        raise messages.error(f"no topic {topic} ({argument})")
    if known.kind not in kinds:
        raise messages.error(f"{argument} {topic} is of type {known.kind}, expected {' or '.join(kinds)}")
    return topic


def _pictures(messages: Messages, what: Callable[[Any], bool]) -> list[str]:
    """Topics of pictures, by their first message."""
    firsts = {name: messages.first(name) for name in messages.of_kind(*_PICTURES)}
    return [name for name, message in firsts.items() if message is not None and what(message)]


def _colours(messages: Messages) -> str:
    pictures = _pictures(messages, lambda message: not is_depth(message))
    pictures = [name for name in pictures if not _DEPTH.search(base_of(name).rpartition("/")[0])] or pictures
    coloured = [name for name in pictures if not is_grey(messages.first(name))] or pictures
    named = [name for name in coloured if _COLOUR.search(name)] or coloured
    if not named:
        raise messages.error("no topic of colour images (sensor_msgs/Image)")
    return _one(messages, "--topic-rgb", "colours", named)


def _depth(messages: Messages, rgb: str) -> str | None:
    pictures = [name for name in _pictures(messages, is_depth) if name != rgb]
    infrared = [name for name in pictures if encoding_of(messages.first(name)).startswith("mono16")]
    pictures = [name for name in pictures if _DEPTH.search(name) or name not in infrared]
    if not pictures:
        return None
    shared = [sum(a == b for a, b in zip(name.split("/"), rgb.split("/"), strict=False)) for name in pictures]
    near = [name for name, number in zip(pictures, shared, strict=True) if number == max(shared)]
    aligned = next((found for names in (near, pictures) if (found := list(filter(_ALIGNED.search, names)))), near)
    return _one(messages, "--topic-depth", "depth", aligned)


def _info_of(messages: Messages, picture: str) -> str | None:
    """The CameraInfo beside a picture, else the only one that is of the picture's frame and size."""
    infos = messages.of_kind(_INFO)
    beside = base_of(picture).rpartition("/")[0] + "/camera_info"
    if beside in infos:
        return beside
    image = messages.first(picture)
    same = [
        name
        for name in infos
        if image is not None
        and (info := messages.first(name)) is not None
        and info.header.frame_id == image.header.frame_id
        and (not hasattr(image, "width") or (info.width, info.height) == (image.width, image.height))
    ]
    return same[0] if len(same) == 1 else None


def _one(messages: Messages, argument: str, what: str, topics: list[str]) -> str:
    """The topic if all are transports of one; raw before compressed."""
    if len({base_of(name) for name in topics}) > 1:
        raise RecordingError(
            f"{messages.where}: several topics may be the {what}: {', '.join(sorted(topics))}; choose with {argument}"
        )
    return min(topics, key=len)


def open_messages(messages: Messages, options: ReadOptions) -> FrameSource:
    """The RGB-D frames of a bag.

    A camera file overrules the bag's colour camera, and that of depth that is registered to it, and the depth camera,
    if it has one. Depth is in millimetres in 16 bits and metres in floats, unless it is said otherwise.

    Raises:
        RecordingError: no colours, no intrinsics, unknown lens, or depth of a camera whose place is unknown.
    """
    setup = None if options.camera is None else read_setup(options.camera)
    chosen, where, notes = choose(messages, options), messages.where, Notes()
    transforms, now_ns = _scan_transforms(messages, chosen)
    colour_frame = _frame_of(messages, chosen.rgb)
    world = transforms.root(colour_frame)
    if options.world_frame is not None:
        world = frame_name(options.world_frame)
        if transforms.lookup(colour_frame, world, now_ns) is None:
            raise RecordingError(
                f"{where}: no tf joins the camera's frame {colour_frame!r} to {world!r} (--world-frame); it hangs on "
                f"{transforms.root(colour_frame)!r}"
            )
    if world == colour_frame:
        world = None
    pose = None if setup is None else setup.cam_from_world
    if pose is not None and pose.ndim == 3:
        raise RecordingError(f"{where}: the camera file has a pose per frame; give one pose, or none to use tf")
    if world is None and pose is None:
        notes.say(NO_POSE)
    if chosen.depth is None:
        notes.say(NO_DEPTH)
    with naming(where):
        rig = _rig(messages, chosen, setup, transforms, now_ns)
    # A clock of a simulator may begin at 0, but does not stay there.
    by_log = all(header_ns(message) == 0 for _, _, message in islice(messages.read([chosen.rgb]), 2))
    if by_log:
        notes.say(NO_STAMP)
    unit_m = 1.0 if chosen.depth is None else options.depth_scale_m or unit_of(messages.first(chosen.depth))
    play = partial(_Play, messages, chosen, rig, options, notes, colour_frame, world, pose, by_log)
    return FrameSource(
        messages.path.stem if messages.path.is_file() else messages.path.resolve().name,
        rig.camera,
        lambda: play().frames(),
        length=messages.topics[chosen.rgb].number,
        exact=False,
        notes=notes,
        units=(f"{messages.path}, {chosen.depth}", unit_m),
    )


def _frame_of(messages: Messages, topic: str) -> str:
    message: Any = messages.first(topic)
    return frame_name(message.header.frame_id)


def _scan_transforms(messages: Messages, chosen: Chosen) -> tuple[Transforms, int]:
    """Transforms that hold throughout and the first seconds of those that change; the time of the first colours."""
    transforms, begun_ns = Transforms(), None
    for _, _, message in messages.read(chosen.static):
        transforms.add(message, static=True)
    for _, log_ns, message in messages.read(chosen.moving):
        begun_ns = log_ns if begun_ns is None else begun_ns
        if log_ns - begun_ns > _SCAN_NS:
            break
        transforms.add(message, static=False, log_ns=log_ns)
    return transforms, header_ns(messages.first(chosen.rgb)) or begun_ns or 0


def _rig(messages: Messages, chosen: Chosen, setup: CameraFile | None, transforms: Transforms, now_ns: int) -> Rig:
    where = messages.where
    size = rgb_of(messages.first(chosen.rgb), f"{where}: first message of {chosen.rgb}").shape[:2]
    if setup is not None:
        camera, lens = setup.camera, setup.distortion
    elif chosen.info is not None:
        camera, lens = camera_of(messages.first(chosen.info), chosen.rgb, size, where)
    else:
        raise RecordingError(
            f"{where}: no camera_info for {chosen.rgb}; name its topic with --topic-info, or give the intrinsics with "
            "--camera FILE"
        )
    if (camera.height, camera.width) != size:
        raise RecordingError(
            f"{where}: {chosen.rgb} is {size[1]} x {size[0]} but its camera is for {camera.width} x "
            f"{camera.height}; give the intrinsics of these images with --camera FILE"
        )
    if setup is not None and setup.depth_camera is not None:
        return setup
    if chosen.depth is None:
        return Rig(camera, lens)
    depth_size = depth_of(messages.first(chosen.depth), f"{where}: first message of {chosen.depth}").shape
    rgb_frame, depth_frame = _frame_of(messages, chosen.rgb), _frame_of(messages, chosen.depth)
    same_pixels = depth_frame == rgb_frame and depth_size == size
    if same_pixels and (chosen.depth_info is None or (setup is not None and _same_camera(messages, chosen))):
        return Rig(camera, lens)
    if chosen.depth_info is None:
        raise RecordingError(
            f"{where}: no camera_info for {chosen.depth}; name its topic with --topic-depth-info, give depth_camera in "
            "--camera FILE, or omit the depth with --topic-depth none"
        )
    depth_camera, depth_lens = camera_of(messages.first(chosen.depth_info), chosen.depth, depth_size, where)
    colour_from_depth = transforms.lookup(rgb_frame, depth_frame, now_ns)
    if colour_from_depth is None:
        raise RecordingError(
            f"{where}: no tf joins the depth's frame {depth_frame!r} to the colours' {rgb_frame!r}, so depth cannot be "
            "registered; record /tf_static too, give depth_camera and colour_from_depth in --camera FILE, or omit the "
            "depth with --topic-depth none"
        )
    return Rig(camera, lens, depth_camera, depth_lens, colour_from_depth)


def _same_camera(messages: Messages, chosen: Chosen) -> bool:
    """Whether a bag says the same of the cameras of colours and depth: what overrules the one overrules the other."""
    if chosen.info is None or chosen.depth_info is None or chosen.depth is None:
        return False
    (k, d, _), (depth_k, depth_d, _) = (_numbers(messages.first(name)) for name in (chosen.info, chosen.depth_info))
    straight = _is_rectified(chosen.rgb) == _is_rectified(chosen.depth) or not d.any()
    return straight and np.array_equal(k, depth_k) and np.array_equal(d, depth_d)


def _numbers(info: Any) -> tuple[np.ndarray, ...]:
    """K, D and P of a CameraInfo, whose names are capital letters in ROS 1."""
    return tuple(np.asarray(getattr(info, n, getattr(info, n.upper(), ())), dtype=np.float64) for n in "kdp")


def _is_rectified(topic: str) -> bool:
    return "rect" in base_of(topic).rpartition("/")[2]


def camera_of(info: Any, topic: str, size: tuple[int, ...], where: str) -> tuple[Camera, Distortion]:
    """Intrinsics and lens of a CameraInfo; of the rectified camera where the topic says that its images are."""
    (k, d, p), rectified = _numbers(info), _is_rectified(topic)
    matrix = p.reshape(3, 4)[:, :3] if rectified and p.size == 12 and p[0] > 0 else k.reshape(3, 3)
    if not matrix[0, 0] > 0:
        raise RecordingError(
            f"{where}: camera_info of {topic} is of a camera that was never calibrated (fx = {matrix[0, 0]:g}); give "
            "the intrinsics with --camera FILE"
        )
    lens = Distortion() if rectified else Distortion(str(info.distortion_model) or "plumb_bob", tuple(d.tolist()))
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    whole = (info.height, info.width) if info.width and info.height else size
    (left, top), (across, down), cut = _window(info, whole)
    if cut != size:  # the driver says what it left out, and has it in its numbers already
        (left, top), (across, down), cut = (0, 0), (1, 1), whole
    centre = (cx + 0.5 - left) / across, (cy + 0.5 - top) / down  # ROS has centres at integers
    return Camera(fx / across, fy / down, *centre, int(cut[1]), int(cut[0])), lens


def _window(info: Any, whole: tuple[int, ...]) -> tuple[tuple[int, int], tuple[int, int], tuple[int, ...]]:
    """Region of interest and binning: left and top, pixels in one across and down, and height and width then."""
    bins = max(int(getattr(info, "binning_x", 1)), 1), max(int(getattr(info, "binning_y", 1)), 1)
    roi = getattr(info, "roi", None)
    height, width = (int(roi.height), int(roi.width)) if roi is not None and roi.width and roi.height else whole
    corner = (0, 0) if roi is None else (int(roi.x_offset), int(roi.y_offset))
    return corner, bins, (height // bins[1], width // bins[0])


@dataclass
class _Play:
    """One pass over a bag."""

    messages: Messages
    chosen: Chosen
    rig: Rig
    options: ReadOptions
    notes: Notes
    colour_frame: str
    """Tf frame of the colours."""
    world: str | None
    """Tf frame that is the world; None without tf."""
    pose: np.ndarray | None
    """Of every frame, where the camera file gives one."""
    by_log: bool
    """Whether times are those of logging, because nobody set those of the headers."""
    colours: deque[tuple[int, int, Any]] = field(default_factory=deque)
    """Those that wait, in order: time, which message of the topic, and the message; so the depths."""
    depths: deque[tuple[int, int, Any]] = field(default_factory=deque)
    newest_ns: int = 0
    emitted_ns: int | None = None
    emitted: int = 0

    def __post_init__(self) -> None:
        self.tolerance_ns = round(self.options.sync_s * 1e9)
        self.numbers = {name: 0 for name in (self.chosen.rgb, self.chosen.depth) if name is not None}
        self.transforms = _scan_transforms(self.messages, self.chosen)[0]

    def frames(self) -> Iterator[Frame]:
        info = self.chosen.info
        wanted = {*self.numbers, *self.chosen.moving, *([info] if info else [])}
        for topic, log_ns, message in self.messages.read(sorted(wanted)):
            if topic in self.numbers:
                self.take(topic, log_ns, message)
            elif topic != info:
                self.transforms.add(message, static=False, log_ns=log_ns)
            elif not np.allclose(_numbers(message)[0], _numbers(self.messages.first(topic))[0]):
                self.notes.say(CAMERA_CHANGED)
            while self.colours and self._ready(self.colours[0][0]):
                yield self._frame(*self.colours.popleft())
        while self.colours:
            yield self._frame(*self.colours.popleft())

    def take(self, topic: str, log_ns: int, message: Any) -> None:
        """Let a picture wait for what goes with it."""
        number = self.numbers[topic]
        self.numbers[topic] += 1
        at_ns = log_ns if self.by_log else header_ns(message)
        if topic == self.chosen.depth:
            self.depths.append((at_ns, number, message))
            # Without colours nothing else would make room.
            oldest_ns = max(self.newest_ns, at_ns) - _PATIENCE_NS - self.tolerance_ns
            while not self.colours and self.depths[0][0] < oldest_ns:
                self.depths.popleft()
        else:
            last_ns = self.colours[-1][0] if self.colours else self.emitted_ns
            if last_ns is not None and at_ns < last_ns:
                if last_ns - at_ns > _LATE_NS:
                    raise RecordingError(
                        f"{self._where(topic, number)}: time goes back by {(last_ns - at_ns) * 1e-9:.3f} s; cut the "
                        "bag there"
                    )
                self.notes.count(LATE, number)
                return
            self.colours.append((at_ns, number, message))
        self.newest_ns = max(self.newest_ns, at_ns)

    def _where(self, topic: str, number: int) -> str:
        return f"{self.messages.where}: message {number} of {topic}"

    def _ready(self, at_ns: int) -> bool:
        """Whether nothing better can come for colours of a time."""
        if self.newest_ns - at_ns > _PATIENCE_NS:
            return True
        depth = self.chosen.depth is None or (bool(self.depths) and self.depths[-1][0] >= at_ns)
        return depth and (self.world is None or self.transforms.gap(self.colour_frame, self.world, at_ns) == 0)

    def _frame(self, at_ns: int, number: int, message: Any) -> Frame:
        t, where = self.emitted, self._where(self.chosen.rgb, number)
        self.emitted, self.emitted_ns = t + 1, at_ns
        with naming(where):
            rgb = self.rig.rgb(rgb_of(message, where))
        return Frame(rgb, self._depth(at_ns, t), at_ns * 1e-9, self._pose(at_ns, t))

    def _depth(self, at_ns: int, t: int) -> np.ndarray | None:
        if self.chosen.depth is None:
            return None
        while self.depths and self.depths[0][0] < at_ns - self.tolerance_ns:
            self.depths.popleft()
        nearest = min(self.depths, key=lambda depth: abs(depth[0] - at_ns), default=None)
        if nearest is None or abs(nearest[0] - at_ns) > self.tolerance_ns:
            self.notes.count(f"no depth within {self.options.sync_s:g} s of the colours", t)
            return None
        where = self._where(self.chosen.depth, nearest[1])
        with naming(where):
            return self.rig.depth(depth_of(nearest[2], where, scale_m=self.options.depth_scale_m))

    def _pose(self, at_ns: int, t: int) -> np.ndarray:
        if self.pose is not None or self.world is None:
            return np.eye(4) if self.pose is None else self.pose
        if self.transforms.gap(self.colour_frame, self.world, at_ns) > STALE_S:
            self.notes.count(f"tf has nothing within {STALE_S} s: the nearest pose is used", t)
        pose = self.transforms.lookup(self.colour_frame, self.world, at_ns)
        self.transforms.forget(at_ns)
        return np.eye(4) if pose is None else pose
