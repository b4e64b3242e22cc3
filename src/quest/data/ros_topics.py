"""The messages of a bag, and which of its topics are the colours, the depth, their cameras and the transforms."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quest.data.frame_source import Parts
from quest.data.ros_images import encoding_of, is_depth, is_grey
from quest.errors import RecordingError

PICTURES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
INFO = "sensor_msgs/CameraInfo"
TRANSFORMS = ("tf2_msgs/TFMessage", "tf/tfMessage")
"""Types of messages; the second of transforms is that of ROS 1."""

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

    rgb = _named(messages, "--topic-rgb", parts.topic_rgb, PICTURES) or _colours(messages)
    if there(rgb) is None:
        raise messages.error(f"topic {rgb} has no messages")
    depth = depth_info = None
    if parts.topic_depth != "none":
        depth = there(_named(messages, "--topic-depth", parts.topic_depth, PICTURES) or _depth(messages, rgb))
    info = _named(messages, "--topic-info", parts.topic_info, (INFO,)) or _info_of(messages, rgb)
    if depth is not None:
        named = _named(messages, "--topic-depth-info", parts.topic_depth_info, (INFO,))
        depth_info = there(named or _info_of(messages, depth))
    transforms = messages.of_kind(*TRANSFORMS)
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
    firsts = {name: messages.first(name) for name in messages.of_kind(*PICTURES)}
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
    infos = messages.of_kind(INFO)
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
