"""Files of ROS messages: MCAP, read by its makers' libraries, and bags of ROS 1 and 2, read by the rosbags library.

Reference: the MCAP specification, mcap.dev/spec.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from quest.data.frame_source import Reader
from quest.data.ros_frames import BAG_OPTIONS, Messages, Topic, open_messages
from quest.errors import RecordingError
from quest.extras import require
from quest.untrusted import reading


def open_mcap(path: Path) -> Messages:
    """The messages of an MCAP file; one without a summary is read through for its topics.

    Raises:
        RecordingError: the file is corrupt, is not MCAP, or has no ROS 2 messages.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    with _mcap_reader(path) as reader:
        summary = reader.get_summary()
        if summary is not None and summary.statistics is not None:
            channels, numbers = summary.channels, summary.statistics.channel_message_counts
            schemas = {c.id: summary.schemas.get(c.schema_id) for c in channels.values()}
        else:
            schemas, channels, numbers = {}, {}, {}
            for schema, channel, _ in reader.iter_messages(log_time_order=False):
                schemas[channel.id], channels[channel.id] = schema, channel
                numbers[channel.id] = numbers.get(channel.id, 0) + 1
    topics: dict[str, Topic] = {}
    for number, channel in channels.items():
        kind = "" if schemas[number] is None else schemas[number].name.replace("/msg/", "/")
        before = topics[channel.topic].number or 0 if channel.topic in topics else 0
        topics[channel.topic] = Topic(kind, before + numbers.get(number, 0))
    if not topics:
        raise RecordingError(f"MCAP {path}: it has no messages; record it again")
    encodings = {(channels[n].message_encoding, s.encoding if s else "no schema") for n, s in schemas.items()}
    if ("cdr", "ros2msg") not in encodings:
        found = ", ".join(sorted(f"{message} with {schema} schemas" for message, schema in encodings))
        kinds = sorted({f"{name} ({topic.kind or 'no type'})" for name, topic in topics.items()})
        raise RecordingError(
            f"MCAP {path}: its messages are {found}, expected ROS 2 (cdr with ros2msg schemas); topics: "
            f"{', '.join(kinds)}; convert it to ROS 2 messages, or write a recording folder"
        )
    indexed = summary is not None and bool(summary.chunk_indexes)
    return Messages(path, topics, lambda wanted: _read_mcap(path, [t for t in wanted if t in topics], indexed))


def _read_mcap(path: Path, topics: list[str], indexed: bool) -> Iterator[tuple[str, int, Any]]:
    if not topics:  # none would mean all
        return
    with _mcap_reader(path) as reader:
        for found in reader.iter_decoded_messages(topics=topics, log_time_order=indexed):
            yield found.channel.topic, found.message.log_time, found.decoded_message


@contextmanager
def _mcap_reader(path: Path) -> Iterator[Any]:
    """A reader of the file at its beginning; errors of the file become ours."""
    exceptions, decoder = require("mcap.exceptions"), require("mcap_ros2.decoder").DecoderFactory()
    remedy = "the file is corrupt, copy it again, or repair it with `mcap recover`"
    with reading(f"MCAP {path}", RecordingError, remedy), path.open("rb") as file:
        try:
            yield require("mcap.reader").make_reader(file, validate_crcs=True, decoder_factories=[decoder])
        except exceptions.InvalidMagic as error:
            raise RecordingError(
                f"MCAP {path}: not an MCAP file, or its end is missing ({error}); copy it again, or repair it with "
                "`mcap recover`"
            ) from error
        except exceptions.DecoderNotFoundError as error:
            raise RecordingError(f"MCAP {path}: {error}; name topics of ROS 2 messages") from error


def open_bag(path: Path) -> Messages:
    """The messages of a bag. Bags that do not carry their message definitions are taken to be of ROS 2 Humble.

    Raises:
        RecordingError: the bag is corrupt, was never finished, or holds no messages.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    if path.suffix.lower() == ".active":
        raise RecordingError(
            f"bag {path}: it was never finished: its recorder still runs, or died; close it with `rosbag reindex` and "
            "name the .bag that this makes"
        )
    with _bag_reader(path) as reader:
        found = {
            name: ((info.msgtype or "").replace("/msg/", "/"), info.msgcount) for name, info in reader.topics.items()
        }
    if not found:
        raise RecordingError(f"bag {path}: it has no topics; record it again")
    return Messages(
        path, {name: Topic(*about) for name, about in found.items()}, lambda topics: _read_bag(path, topics)
    )


def _read_bag(path: Path, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
    with _bag_reader(path) as reader:
        wanted = [connection for connection in reader.connections if connection.topic in topics]
        for connection, log_ns, raw in reader.messages(connections=wanted) if wanted else ():  # none would mean all
            yield connection.topic, log_ns, reader.deserialize(raw, connection.msgtype)


@contextmanager
def _bag_reader(path: Path) -> Iterator[Any]:
    """An open reader; errors of the bag become ours."""
    highlevel, typesys = (require(f"rosbags.{name}") for name in ("highlevel", "typesys"))
    reindex = "rosbag reindex" if path.suffix.lower() == ".bag" else "ros2 bag reindex"
    remedy = f"the bag is corrupt, copy it again, or rebuild it with `{reindex}`"
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with reading(f"bag {path}", RecordingError, remedy), highlevel.AnyReader([path], default_typestore=store) as reader:
        yield reader


def _is_mcap(where: str) -> bool:
    return where.lower().endswith(".mcap") and Path(where).is_file()


def _is_bag(where: str) -> bool:
    path = Path(where)
    return (path.suffix.lower() in (".bag", ".db3", ".active") and path.is_file()) or (path / "metadata.yaml").is_file()


def _reader(kind: str, form: str, accepts: Callable[[str], bool], messages: Callable[[Path], Messages]) -> Reader:
    return Reader(
        kind, form, accepts, lambda where, options: open_messages(messages(Path(where)), options), BAG_OPTIONS
    )


READERS = (
    _reader("an MCAP file", ".mcap", _is_mcap, open_mcap),
    _reader("a ROS bag", "a folder with metadata.yaml, .db3 or .bag", _is_bag, open_bag),
)
