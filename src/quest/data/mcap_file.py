"""MCAP files with ROS 2 messages, read through the libraries of the format's makers.

Reference: the MCAP specification, mcap.dev/spec.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

from quest.data.frame_source import FrameSource, Reader, ReadOptions
from quest.data.ros_frames import BAG_OPTIONS, open_messages
from quest.data.ros_topics import Topic
from quest.errors import RecordingError
from quest.extras import require
from quest.untrusted import reading


class McapMessages:
    """The messages of an MCAP file.

    Args:
        path: the file.

    Raises:
        RecordingError: the file is corrupt, is not MCAP, or has no ROS 2 messages.
        MissingExtraError: the extra ``ros`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        require("mcap")
        require("mcap_ros2")
        with self._reader() as reader:
            summary = reader.get_summary()
        self._indexed = summary is not None and bool(summary.chunk_indexes)
        self.topics = self._find_topics()
        if not self.topics:
            raise RecordingError(f"MCAP {path}: it has no messages; record it again")
        self._check_encodings()

    def _find_topics(self) -> dict[str, Topic]:
        """The topics of the file; one without a summary is read through for them."""
        found: dict[str, Topic] = {}
        for schema, channel, number in self._channels:
            kind = "" if schema is None else schema.name.replace("/msg/", "/")
            before = found.get(channel.topic)
            found[channel.topic] = Topic(kind, number + (before.number or 0 if before else 0))
        return found

    def read(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of logging in nanoseconds and message; as :class:`quest.data.ros_topics.Messages` says."""
        known = [topic for topic in topics if topic in self.topics]
        if not known:
            return
        with self._reader() as reader:
            for found in reader.iter_decoded_messages(topics=known, log_time_order=self._indexed):
                yield found.channel.topic, found.message.log_time, found.decoded_message

    @cached_property
    def _channels(self) -> list[tuple[Any, Any, int]]:
        """Schema, channel and number of messages."""
        with self._reader() as reader:
            summary = reader.get_summary()
            if summary is not None and summary.statistics is not None:
                counts = summary.statistics.channel_message_counts
                return [
                    (summary.schemas.get(channel.schema_id), channel, counts.get(channel.id, 0))
                    for channel in summary.channels.values()
                ]
        counted: dict[int, tuple[Any, Any, int]] = {}
        with self._reader() as reader:
            for schema, channel, _ in reader.iter_messages(log_time_order=False):
                counted[channel.id] = (schema, channel, counted.get(channel.id, (None, None, 0))[2] + 1)
        return list(counted.values())

    def _check_encodings(self) -> None:
        """Refuse a file none of whose topics can be decoded, naming their types."""
        found = {
            (channel.message_encoding, schema.encoding if schema else "no schema")
            for schema, channel, _ in self._channels
        }
        if ("cdr", "ros2msg") in found:
            return
        kinds = sorted({f"{name} ({topic.kind or 'no type'})" for name, topic in self.topics.items()})
        encodings = ", ".join(sorted(f"{message} with {schema} schemas" for message, schema in found))
        raise RecordingError(
            f"MCAP {self.path}: its messages are {encodings}, expected ROS 2 (cdr with ros2msg schemas); topics: "
            f"{', '.join(kinds)}; convert it to ROS 2 messages, or write a recording folder"
        )

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        """A reader of the file at its beginning; errors of the file become ours."""
        exceptions = require("mcap.exceptions")
        remedy = "the file is corrupt, copy it again, or repair it with `mcap recover`"
        with reading(f"MCAP {self.path}", RecordingError, remedy), self.path.open("rb") as file:
            try:
                decoder = require("mcap_ros2.decoder").DecoderFactory()
                yield require("mcap.reader").make_reader(file, validate_crcs=True, decoder_factories=[decoder])
            except exceptions.InvalidMagic as error:
                raise RecordingError(
                    f"MCAP {self.path}: not an MCAP file, or its end is missing ({error}); copy it again, or repair "
                    "it with `mcap recover`"
                ) from error
            except exceptions.DecoderNotFoundError as error:
                raise RecordingError(f"MCAP {self.path}: {error}; name topics of ROS 2 messages") from error


def _open(where: str, options: ReadOptions) -> FrameSource:
    return open_messages(McapMessages(Path(where)), options)


def _accepts(where: str) -> bool:
    return where.lower().endswith(".mcap") and Path(where).is_file()


READER = Reader("an MCAP file", ".mcap", _accepts, _open, BAG_OPTIONS)
