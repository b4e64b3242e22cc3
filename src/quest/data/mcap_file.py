"""MCAP files with ROS 2 messages, read through the libraries of the format's makers.

Reference: the MCAP specification, mcap.dev/spec.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from quest.data.frame_source import Reader
from quest.data.ros_frames import BAG_OPTIONS, open_messages
from quest.data.ros_topics import Messages, Topic
from quest.errors import RecordingError
from quest.extras import require
from quest.untrusted import reading


class McapMessages(Messages):
    """The messages of an MCAP file; one without a summary is read through for its topics.

    Args:
        path: the file.

    Raises:
        RecordingError: the file is corrupt, is not MCAP, or has no ROS 2 messages.
        MissingExtraError: the extra ``ros`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, {})
        with self._reader() as reader:
            summary = reader.get_summary()
            if summary is not None and summary.statistics is not None:
                channels, numbers = summary.channels, summary.statistics.channel_message_counts
                schemas = {c.id: summary.schemas.get(c.schema_id) for c in channels.values()}
            else:
                schemas, channels, numbers = {}, {}, {}
                for schema, channel, _ in reader.iter_messages(log_time_order=False):
                    schemas[channel.id], channels[channel.id] = schema, channel
                    numbers[channel.id] = numbers.get(channel.id, 0) + 1
        self._indexed = summary is not None and bool(summary.chunk_indexes)
        for number, channel in channels.items():
            kind = "" if schemas[number] is None else schemas[number].name.replace("/msg/", "/")
            before = self.topics[channel.topic].number or 0 if channel.topic in self.topics else 0
            self.topics[channel.topic] = Topic(kind, before + numbers.get(number, 0))
        if not self.topics:
            raise RecordingError(f"MCAP {path}: it has no messages; record it again")
        encodings = {(channels[n].message_encoding, s.encoding if s else "no schema") for n, s in schemas.items()}
        if ("cdr", "ros2msg") not in encodings:
            found = ", ".join(sorted(f"{message} with {schema} schemas" for message, schema in encodings))
            kinds = sorted({f"{name} ({topic.kind or 'no type'})" for name, topic in self.topics.items()})
            raise RecordingError(
                f"MCAP {path}: its messages are {found}, expected ROS 2 (cdr with ros2msg schemas); topics: "
                f"{', '.join(kinds)}; convert it to ROS 2 messages, or write a recording folder"
            )

    def read(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """As :class:`quest.data.ros_topics.Messages` says."""
        known = [topic for topic in topics if topic in self.topics]
        if not known:
            return
        with self._reader() as reader:
            for found in reader.iter_decoded_messages(topics=known, log_time_order=self._indexed):
                yield found.channel.topic, found.message.log_time, found.decoded_message

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        """A reader of the file at its beginning; errors of the file become ours."""
        exceptions, decoder = require("mcap.exceptions"), require("mcap_ros2.decoder").DecoderFactory()
        remedy = "the file is corrupt, copy it again, or repair it with `mcap recover`"
        with reading(f"MCAP {self.path}", RecordingError, remedy), self.path.open("rb") as file:
            try:
                yield require("mcap.reader").make_reader(file, validate_crcs=True, decoder_factories=[decoder])
            except exceptions.InvalidMagic as error:
                raise RecordingError(
                    f"MCAP {self.path}: not an MCAP file, or its end is missing ({error}); copy it again, or repair "
                    "it with `mcap recover`"
                ) from error
            except exceptions.DecoderNotFoundError as error:
                raise RecordingError(f"MCAP {self.path}: {error}; name topics of ROS 2 messages") from error


def _accepts(where: str) -> bool:
    return where.lower().endswith(".mcap") and Path(where).is_file()


READER = Reader(
    "an MCAP file",
    ".mcap",
    _accepts,
    lambda where, options: open_messages(McapMessages(Path(where)), options),
    BAG_OPTIONS,
)
