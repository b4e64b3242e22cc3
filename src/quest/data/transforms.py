"""Transforms between named frames over time, as ROS publishes them on ``/tf`` and ``/tf_static``.

Reference: Foote, "tf: the transform library", 2013.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from quest.data.ros_images import header_ns
from quest.errors import RecordingError

STALE_S = 0.5
"""A pose from longer before or after is said to be stale."""
_KEEP_NS = 30_000_000_000
"""How long what moved is remembered."""


Sample = tuple[int, np.ndarray, np.ndarray]
"""Time in nanoseconds, position, and quaternion x, y, z, w."""


def _stamp_ns(sample: Sample) -> int:
    return sample[0]


@dataclass
class Edge:
    """One frame in another over time."""

    parent: str
    static: bool
    samples: list[Sample] = field(default_factory=list)
    """By time; one if it is static."""

    def add(self, sample: Sample) -> None:
        """Take one more sample."""
        if self.static:
            self.samples.clear()
        insort(self.samples, sample, key=_stamp_ns)

    def at(self, stamp_ns: int) -> np.ndarray:
        """``parent_from_child``: between two samples on the line and the shortest arc, outside that of the nearest."""
        after = min(bisect_left(self.samples, stamp_ns, key=_stamp_ns), len(self.samples) - 1)
        before = max(after - 1, 0) if self.samples[after][0] > stamp_ns else after
        (first_ns, *first), (last_ns, *last) = self.samples[before], self.samples[after]
        share = 0.0 if last_ns == first_ns else (stamp_ns - first_ns) / (last_ns - first_ns)
        matrix = np.eye(4)
        matrix[:3, :3] = Slerp([0.0, 1.0], Rotation.from_quat(np.stack((first[1], last[1]))))(share).as_matrix()
        matrix[:3, 3] = (1 - share) * first[0] + share * last[0]
        return matrix

    def gap(self, stamp_ns: int) -> float:
        """Seconds to the nearest sample if ``stamp_ns`` lies outside of them, else 0."""
        outside_ns = max(self.samples[0][0] - stamp_ns, stamp_ns - self.samples[-1][0], 0)
        return 0.0 if self.static else outside_ns * 1e-9

    def forget(self, before_ns: int) -> None:
        """Drop samples that are not needed from a time on."""
        old = bisect_left(self.samples, before_ns, key=_stamp_ns) - 1
        if not self.static:
            del self.samples[: max(old, 0)]


class Transforms:
    """A tree of frames, fed as messages come; of what moves, the last half minute is kept."""

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}

    def add(self, message: Any, *, static: bool, log_ns: int = 0) -> None:
        """Take the transforms of one TFMessage; those that are no transforms (a quaternion of zeros) are left out.

        Static ones hold throughout; those without a time of their own are of the time of logging.
        """
        for stamped in message.transforms:
            moved, turned = stamped.transform.translation, stamped.transform.rotation
            quaternion = np.array([turned.x, turned.y, turned.z, turned.w], dtype=np.float64)
            position = np.array([moved.x, moved.y, moved.z], dtype=np.float64)
            norm = np.linalg.norm(quaternion)
            if not np.isfinite(position).all() or not np.isfinite(norm) or norm < 1e-6:
                continue
            parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
            edge = self._edges.get(child)
            if edge is None or edge.parent != parent or edge.static != static:
                edge = self._edges[child] = Edge(parent, static)
            edge.add((header_ns(stamped) or log_ns, position, quaternion / norm))

    def root(self, frame: str) -> str:
        """The frame that everything around ``frame`` hangs on; itself if nothing is known of it."""
        return self._line(frame)[-1]

    def lookup(self, target: str, source: str, stamp_ns: int) -> Float[np.ndarray, "4 4"] | None:
        """``target_from_source`` at a time in nanoseconds; None where no chain joins them."""
        ups, downs = self._line(source), self._line(target)
        shared = next((name for name in ups if name in downs), None)
        if shared is None:
            return None
        return np.linalg.inv(self._up(downs, shared, stamp_ns)) @ self._up(ups, shared, stamp_ns)

    def gap(self, target: str, source: str, stamp_ns: int) -> float:
        """How far outside of what was published a lookup reaches, seconds; 0 where every step is known or static."""
        ups, downs = self._line(source), self._line(target)
        steps = set(ups) ^ set(downs)  # what is above both cancels
        return max((self._edges[name].gap(stamp_ns) for name in steps if name in self._edges), default=0.0)

    def forget(self, stamp_ns: int) -> None:
        """Drop what is not needed for times from ``stamp_ns`` on, but for half a minute."""
        for edge in self._edges.values():
            edge.forget(stamp_ns - _KEEP_NS)

    def _line(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root.

        Raises:
            RecordingError: there is no root.
        """
        line = [frame_name(frame)]
        while (edge := self._edges.get(line[-1])) is not None:
            if edge.parent in line:
                raise RecordingError(f"tf: {', '.join(line)} hang on each other in a ring; record the transforms again")
            line.append(edge.parent)
        return line

    def _up(self, line: list[str], top: str, stamp_ns: int) -> np.ndarray:
        matrix = np.eye(4)
        for name in line[: line.index(top)]:
            matrix = self._edges[name].at(stamp_ns) @ matrix
        return matrix


def frame_name(name: str) -> str:
    """A frame's name without the leading slash of ROS 1."""
    return name.removeprefix("/")
