"""Which topics of a bag are the colours, the depth, their cameras and the transforms."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from quest.data.frame_source import Parts
from quest.data.ros_images import encoding_of, is_depth, is_grey
from quest.errors import RecordingError

IMAGE, COMPRESSED, INFO, TRANSFORMS = (
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/CameraInfo",
    "tf2_msgs/TFMessage",
)
_TRANSFORMS_1 = "tf/tfMessage"
NO_DEPTH = "none"

_TRANSPORTS = re.compile(r"/(compressed|compressedDepth)$")
_COLOUR = re.compile(r"colou?r|rgb", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)
_ALIGNED = re.compile(r"aligned|registered|depth_to_(rgb|colou?r)", re.IGNORECASE)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    kind: str
    """Message type such as ``sensor_msgs/Image``."""
    number: int | None
    """Of messages; None if the bag does not tell."""


@runtime_checkable
class Messages(Protocol):
    """The messages of a bag, however it is stored."""

    @property
    def path(self) -> Path:
        """The file or folder."""
        ...

    @property
    def topics(self) -> dict[str, Topic]:
        """The topics in it."""
        ...

    def read(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of logging in nanoseconds and message, of some topics, in the order of logging.

        Raises:
            RecordingError: the bag is corrupt, or a message cannot be decoded.
        """
        ...


@dataclass(frozen=True)
class Chosen:
    """The topics that make a recording."""

    rgb: str
    """Of colours."""
    depth: str | None
    """Of depth; None without."""
    info: str | None
    """CameraInfo of the colours; None if there is none."""
    depth_info: str | None
    """CameraInfo of the depth; None if there is none."""
    moving: tuple[str, ...]
    """Of transforms that change."""
    static: tuple[str, ...]
    """Of transforms that do not."""
    first: dict[str, Any]
    """First message of the topics of pictures and cameras."""


def choose(messages: Messages, parts: Parts) -> Chosen:
    """Find the topics, or check those that are named.

    Raises:
        RecordingError: there are no pictures, several that could be meant, or a named topic is missing or of another
            type; the message lists what there is.
    """
    found = _Finder(messages)
    rgb = found.named("--topic-rgb", parts.topic_rgb, (IMAGE, COMPRESSED)) or found.colours()
    depth = None
    if parts.topic_depth != NO_DEPTH:
        depth = found.named("--topic-depth", parts.topic_depth, (IMAGE, COMPRESSED)) or found.depth(rgb)
    info = found.named("--topic-info", parts.topic_info, (INFO,)) or found.info_of(rgb)
    depth_info = None
    if depth is not None:
        depth_info = found.named("--topic-depth-info", parts.topic_depth_info, (INFO,)) or found.info_of(depth)
    transforms = found.of_kind(TRANSFORMS, _TRANSFORMS_1)
    static = tuple(name for name in transforms if name.endswith("_static"))
    pictures = [name for name in (rgb, depth, info, depth_info) if name is not None]
    first = {name: message for name in pictures if (message := found.first(name)) is not None}
    if rgb not in first:
        raise RecordingError(f"{found.where}: topic {rgb} has no messages; {found.listed()}")
    if depth is not None and depth not in first:
        depth = depth_info = None
    moving = tuple(name for name in transforms if name not in static)
    return Chosen(
        rgb,
        depth,
        info if info in first else None,
        depth_info if depth_info in first else None,
        moving,
        static,
        first,
    )


def base_of(topic: str) -> str:
    """Name of the raw topic of a compressed one."""
    return _TRANSPORTS.sub("", topic)


class _Finder:
    """Looks into a bag; a topic's first message is read once."""

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._firsts: dict[str, Any] = {}
        self.where = f"bag {messages.path}"

    def of_kind(self, *kinds: str) -> list[str]:
        return sorted(name for name, topic in self._messages.topics.items() if topic.kind in kinds)

    def listed(self) -> str:
        """The topics of the bag, for messages."""
        topics = sorted(self._messages.topics.items())
        if not topics:
            return "it has no topics; record it again"
        return "topics found: " + ", ".join(
            f"{name} ({topic.kind}, {'some' if topic.number is None else topic.number})" for name, topic in topics
        )

    def first(self, topic: str) -> Any | None:
        if topic not in self._firsts:
            stream = self._messages.read([topic])
            self._firsts[topic] = next(stream, (topic, 0, None))[2]
        return self._firsts[topic]

    def named(self, argument: str, topic: str | None, kinds: tuple[str, ...]) -> str | None:
        if topic is None:
            return None
        known = self._messages.topics.get(topic)
        if known is None:
            raise RecordingError(f"{self.where}: no topic {topic} ({argument}); {self.listed()}")
        if known.kind not in kinds:
            raise RecordingError(
                f"{self.where}: {argument} {topic} is of type {known.kind}, expected {' or '.join(kinds)}; "
                f"{self.listed()}"
            )
        return topic

    def colours(self) -> str:
        pictures = [name for name in self.of_kind(IMAGE, COMPRESSED) if self._is(name, lambda m: not is_depth(m))]
        pictures = [name for name in pictures if not _DEPTH.search(base_of(name).rpartition("/")[0])] or pictures
        coloured = [name for name in pictures if self._is(name, lambda m: not is_grey(m))] or pictures
        named = [name for name in coloured if _COLOUR.search(name)] or coloured
        if not named:
            raise RecordingError(f"{self.where}: no topic of colour images (sensor_msgs/Image); {self.listed()}")
        return self._one("--topic-rgb", "colours", named)

    def depth(self, rgb: str) -> str | None:
        pictures = [name for name in self.of_kind(IMAGE, COMPRESSED) if name != rgb and self._is(name, is_depth)]
        pictures = [
            name
            for name in pictures
            if _DEPTH.search(name) or not self._is(name, lambda message: encoding_of(message).startswith("mono16"))
        ]
        if not pictures:
            return None
        shared = [sum(a == b for a, b in zip(name.split("/"), rgb.split("/"), strict=False)) for name in pictures]
        near = [name for name, number in zip(pictures, shared, strict=True) if number == max(shared)]
        aligned = (
            [name for name in near if _ALIGNED.search(name)] or [n for n in pictures if _ALIGNED.search(n)] or near
        )
        return self._one("--topic-depth", "depth", aligned)

    def info_of(self, picture: str) -> str | None:
        """The CameraInfo beside a picture, else the only one that is of the picture's frame and size."""
        infos = self.of_kind(INFO)
        beside = base_of(picture).rpartition("/")[0] + "/camera_info"
        if beside in infos:
            return beside
        image = self.first(picture)
        same = [
            name
            for name in infos
            if image is not None
            and (info := self.first(name)) is not None
            and info.header.frame_id == image.header.frame_id
            and (not hasattr(image, "width") or (info.width, info.height) == (image.width, image.height))
        ]
        return same[0] if len(same) == 1 else None

    def _is(self, topic: str, what: Callable[[Any], bool]) -> bool:
        message = self.first(topic)
        return message is not None and what(message)

    def _one(self, argument: str, what: str, topics: list[str]) -> str:
        """The topic if all are transports of one; raw before compressed."""
        bases = {base_of(name) for name in topics}
        if len(bases) > 1:
            raise RecordingError(
                f"{self.where}: several topics may be the {what}: {', '.join(sorted(topics))}; choose with {argument}"
            )
        return min(topics, key=len)
