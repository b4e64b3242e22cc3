"""What happens in a stream, told apart from what goes on: alarms, losses, degradations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from quest.monitor import Alarm
from quest.track.state import StreamState
from quest.types import State

Happening = Literal["bound", "alarm", "cleared", "lost", "found", "degraded"]


@dataclass(frozen=True)
class Event:
    """Something that happened in a frame."""

    frame: int
    """Index of the frame."""
    stamp_s: float
    """Its time, seconds."""
    kind: Happening
    """``bound`` queries are followed from here on; an ``alarm`` was raised or ``cleared``; without an alarm, a query
    was ``lost`` or ``found`` again; the frame is ``degraded``."""
    name: str
    """Of the query; empty where it is about the frame."""
    text: str
    """A few words for people."""


class Events:
    """Compares the states of one stream, frame by frame; counts the alarms that were ``raised`` and ``cleared``."""

    def __init__(self) -> None:
        self.raised = 0
        self.cleared = 0
        self._alarm: dict[int, Alarm | None] = {}
        self._lost: dict[int, bool] = {}
        self._flags: tuple[str, ...] = ()

    def step(self, frame: int, state: StreamState) -> tuple[Event, ...]:
        """What is new in the stream's answer to a frame."""
        told: list[tuple[Happening, str, str]] = []
        new = [name for number, name in zip(state.query, state.names, strict=True) if number not in self._lost]
        if new:
            told.append(("bound", "", f"now following {', '.join(new)}"))
        for k, number in enumerate(state.query):
            for kind, text in self._compare(frame, state, k, number):
                told.append((kind, state.names[k], text))
        # What follows the colon may differ in every frame: how late it is.
        flags = tuple(flag.partition(":")[0] for flag in state.flags)
        if flags and flags != self._flags:
            told.append(("degraded", "", "; ".join(state.flags)))
        self._flags = flags
        self._alarm = dict(zip(state.query, state.alarm, strict=True))
        self._lost = {number: value is State.LOST for number, value in zip(state.query, state.state, strict=True)}
        return tuple(Event(frame, state.stamp_s, kind, name, text) for kind, name, text in told)

    def _compare(self, frame: int, state: StreamState, k: int, number: int) -> list[tuple[Happening, str]]:
        before, now = self._alarm.get(number), state.alarm[k]
        told: list[tuple[Happening, str]] = []
        # An alarm is the same under another name.
        same = before is not None and now is not None and before.frame == now.frame
        if before is not None and not same:
            self.cleared += 1
            told.append(("cleared", f"alarm cleared after {frame - before.frame} frames"))
        if now is not None and not same:
            self.raised += 1
            return [*told, ("alarm", f"ALARM: {now.reason}")]
        # With an alarm the query is lost and found by it; that is told already.
        was_lost, lost = self._lost.get(number, False), state.state[k] is State.LOST
        if before is None and lost and not was_lost:
            told.append(("lost", f"lost: {_doubt(state, k)}"))
        elif before is None and was_lost and not lost:
            told.append(("found", f"found again: {_doubt(state, k)}"))
        return told


def _doubt(state: StreamState, k: int) -> str:
    """What a query's state goes by."""
    if np.isfinite(state.lost_p[k]):
        return f"P(lost) {state.lost_p[k]:.2f}"
    return f"confidence {state.confidence[k]:.2f}"
