"""ROS bags, read by the rosbags library: folders of ROS 2 (sqlite3 or MCAP inside), ``.db3`` and ROS 1 ``.bag``."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from quest.data.frame_source import FrameSource, Reader, ReadOptions
from quest.data.ros_frames import BAG_OPTIONS, open_messages
from quest.data.ros_topics import Messages, Topic
from quest.errors import RecordingError
from quest.extras import require
from quest.untrusted import reading


class BagMessages(Messages):
    """The messages of a ROS bag. Bags that do not carry their message definitions are taken to be of ROS 2 Humble.

    Args:
        path: the folder or file.

    Raises:
        RecordingError: the bag is corrupt, or holds no messages.
        MissingExtraError: the extra ``ros`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, {})
        with self._reader() as reader:
            for name, info in reader.topics.items():
                self.topics[name] = Topic((info.msgtype or "").replace("/msg/", "/"), info.msgcount)
        if not self.topics:
            raise RecordingError(f"bag {path}: it has no topics; record it again")

    def read(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """As :class:`quest.data.ros_topics.Messages` says."""
        with self._reader() as reader:
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            if not wanted:
                return
            for connection, log_ns, raw in reader.messages(connections=wanted):
                yield connection.topic, log_ns, reader.deserialize(raw, connection.msgtype)

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        """An open reader; errors of the bag become ours."""
        highlevel, typesys = (require(f"rosbags.{name}") for name in ("highlevel", "typesys"))
        reindex = "rosbag reindex" if self.path.suffix.lower() == ".bag" else "ros2 bag reindex"
        remedy = f"the bag is corrupt, copy it again, or rebuild it with `{reindex}`"
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with (
            reading(f"bag {self.path}", RecordingError, remedy),
            highlevel.AnyReader([self.path], default_typestore=store) as reader,
        ):
            yield reader


def _accepts(where: str) -> bool:
    path = Path(where)
    ends = (".bag", ".db3", ".active")
    return (path.suffix.lower() in ends and path.is_file()) or (path / "metadata.yaml").is_file()


def _open(where: str, options: ReadOptions) -> FrameSource:
    if where.lower().endswith(".active"):
        raise RecordingError(
            f"bag {where}: it was never finished: its recorder still runs, or died; close it with `rosbag reindex` and "
            "name the .bag that this makes"
        )
    return open_messages(BagMessages(Path(where)), options)


READER = Reader("a ROS bag", "a folder with metadata.yaml, .db3 or .bag", _accepts, _open, BAG_OPTIONS)
