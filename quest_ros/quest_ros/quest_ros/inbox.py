"""Pictures that came and are not tracked yet: colours and depth joined by time, the newest only."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

PATIENCE_NS = 500_000_000
"""How much newer pictures have to be before one is tracked without the depth or the pose that it waits for."""
JUMP_NS = 1_000_000_000
"""Colours that are older than those before by more begin a new stream; by less, they are late and left out."""


class Sent(NamedTuple):
    """A message and its time: that of its header, or of its arrival where nobody set that."""

    stamp_ns: int
    message: Any


class Inbox:
    """Keeps what may still be tracked, in bounded size.

    Args:
        depth: whether there is a topic of depth.
        tolerance_ns: largest difference in time of colours and their depth.
        posed: whether the camera's pose at a time is known; such as is not waits.

    Attributes:
        came: how many colours came.
        dropped: how many of them were left out because newer ones were ready.
        late: how many were left out because they were older than those before.
        unmatched: how many were given without depth because none was near enough in time.
    """

    def __init__(self, *, depth: bool, tolerance_ns: int, posed: Callable[[int], bool]) -> None:
        self.came = self.dropped = self.late = self.unmatched = 0
        self._with_depth = depth
        self._tolerance_ns = tolerance_ns
        self._posed = posed
        self._colours: deque[Sent] = deque()
        self._depths: deque[Sent] = deque()
        self._last_ns: int | None = None

    def colours(self, sent: Sent) -> int:
        """Take colours; returns by how many nanoseconds time jumped back, 0 if it did not."""
        self.came += 1
        back_ns = 0 if self._last_ns is None else self._last_ns - sent.stamp_ns
        if 0 < back_ns <= JUMP_NS:
            self.late += 1
            return 0
        if back_ns > JUMP_NS:
            self._colours.clear()
            self._depths = deque(depth for depth in self._depths if depth.stamp_ns <= sent.stamp_ns + PATIENCE_NS)
        self._last_ns = sent.stamp_ns
        self._colours.append(sent)
        while len(self._colours) > 1 and self._ready(self._colours[1].stamp_ns):
            self._colours.popleft()
            self.dropped += 1
        return max(back_ns, 0)

    def depth(self, sent: Sent) -> None:
        """Take depth."""
        if self._depths and sent.stamp_ns < self._depths[-1].stamp_ns - JUMP_NS:
            self._depths.clear()
        self._depths.append(sent)
        self._depths = deque(
            depth
            for depth in self._depths
            if depth.stamp_ns > sent.stamp_ns - PATIENCE_NS or any(self._near(c, depth) for c in self._colours)
        )

    def take(self) -> tuple[Sent, Sent | None] | None:
        """The newest colours that are ready, with their depth; None if none are."""
        ready = [i for i, sent in enumerate(self._colours) if self._ready(sent.stamp_ns)]
        if not ready:
            return None
        self.dropped += ready[-1]
        sent = [self._colours.popleft() for _ in range(ready[-1] + 1)][-1]
        near = min(self._depths, key=lambda depth: abs(depth.stamp_ns - sent.stamp_ns), default=None)
        if near is not None and not self._near(sent, near):
            near = None
        self.unmatched += self._with_depth and near is None
        return sent, near

    def _ready(self, stamp_ns: int) -> bool:
        """Whether nothing better can come for colours of a time."""
        newest_ns = max(sent[-1].stamp_ns for sent in (self._colours, self._depths) if sent)
        if newest_ns - stamp_ns > PATIENCE_NS:
            return True
        depth = not self._with_depth or (bool(self._depths) and self._depths[-1].stamp_ns >= stamp_ns)
        return depth and self._posed(stamp_ns)

    def _near(self, colours: Sent, depth: Sent) -> bool:
        return abs(depth.stamp_ns - colours.stamp_ns) <= self._tolerance_ns
