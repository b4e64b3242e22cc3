"""The live view of a stream in a terminal, and its events as plain lines where there is no terminal."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from quest.monitor import Budget
from quest.track import StreamState
from quest.track.events import Event, Events, Happening
from quest.tracks import describe_joint
from quest.types import Query, State
from quest.viz.palette import query_colour
from quest.wording import counted

REFRESH_S = 0.2
"""Time between two pictures of the table."""

EVENTS_SHOWN = 6

WIDE = 110
"""Columns of a terminal from which labels and pixels have room."""

STATE_STYLE = {State.TRACKING: "green", State.HELD: "yellow", State.LOST: "bold red"}

EVENT_STYLE: dict[Happening, str] = {
    "bound": "", "alarm": "bold red", "cleared": "green", "lost": "red", "found": "green", "degraded": "yellow",
}  # fmt: skip

_RATE_FRAMES = 20
_BAR_WIDTH = 6
_LIKELY, _POSSIBLE = 0.5, 0.2


class LiveView:
    """Shows a stream while it is stepped; a context manager.

    In a terminal it is a table that refreshes itself; elsewhere one line per event. ``frames`` is None where only the
    end tells how many there will be, ``budget`` where nothing raises alarms.
    """

    def __init__(self, console: Console, *, name: str, frames: int | None, budget: Budget | None) -> None:
        self._console, self._name, self._frames, self._budget = console, name, frames, budget
        terminal = console.is_interactive
        self._live = Live(console=console, auto_refresh=False, redirect_stdout=False) if terminal else None
        self._events = Events()
        self._last: deque[Event] = deque(maxlen=EVENTS_SHOWN)
        self._drawn_s, self._frame = 0.0, -1
        self._begin()
        self._state: StreamState | None = None
        self._waiting: tuple[Query, ...] = ()
        self._behind_s = 0.0

    def _begin(self) -> None:
        self._begun_s = time.monotonic()
        self._ends_s = deque([self._begun_s], maxlen=_RATE_FRAMES)

    def __enter__(self) -> LiveView:
        self._begin()
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.update(self.picture(), refresh=True)
            self._live.stop()

    def show(
        self, frame: int, state: StreamState, *, waiting: Sequence[Query] = (), behind_s: float = 0.0
    ) -> tuple[Event, ...]:
        """Take in the answers of the next frame; gives what happened in it.

        Queries that wait have not found their entity; the view is so much behind the recording's own pace.
        """
        self._frame, self._state, self._waiting, self._behind_s = frame, state, tuple(waiting), behind_s
        now_s = time.monotonic()
        self._ends_s.append(now_s)
        events = self._events.step(frame, state)
        self._last.extend(events)
        if self._live is None:
            for event in events:
                self._console.print(event_line(event), soft_wrap=True)
        elif now_s - self._drawn_s >= REFRESH_S:
            self._live.update(self.picture(), refresh=True)
            self._drawn_s = now_s
        return events

    def picture(self) -> RenderableType:
        """The view as it stands."""
        parts: list[RenderableType] = [self._head()]
        if self._state is not None:
            state = self._state
            parts += [Text(f"degraded: {flag}", style="yellow") for flag in state.flags]
            for alarm in filter(None, state.alarm):
                age = counted(self._frame - alarm.frame, "frame")
                parts.append(Text(f"alarm: {alarm.name}, open for {age}: {alarm.reason}", "bold red"))
            # Below the alarms, because a terminal that is too low cuts off what is at the end.
            if state.names:
                parts.append(_state_table(state, self._frame, wide=self._console.width >= WIDE))
        if self._waiting:
            parts.append(Text(f"not followed: {', '.join(query_words(q) for q in self._waiting)}", style="yellow"))
        parts += [Text(), *(event_line(event) for event in self._last)] if self._last else []
        return Group(*parts)

    def summary(self) -> Text:
        """What has been seen so far, for the end."""
        seconds, frames = max(self._ends_s[-1] - self._begun_s, 1e-6), self._frame + 1
        seen = counted(frames, "frame") if self._frames is None else f"{frames} of {counted(self._frames, 'frame')}"
        text = Text(f"{self._name}: {seen} in {seconds:.1f} s ({frames / seconds:.1f} per s)")
        if self._budget is None:
            text.append("; no alarms, because the monitor has no calibration", style="yellow")
        else:
            raised, cleared = self._events.raised, self._events.cleared
            open_now = raised - cleared
            text.append(f"; alarms: {raised} raised, {cleared} cleared, ")
            text.append(f"{open_now} left open", style="bold red" if open_now else "green")
        return text

    def _head(self) -> Text:
        parts = [f"frame {max(self._frame, 0)}" + ("" if self._frames is None else f" (0 to {self._frames - 1})")]
        if self._state is not None:
            parts.append(f"{self._state.stamp_s:.2f} s")
        took_s = self._ends_s[-1] - self._ends_s[0]
        if took_s > 0:
            parts.append(f"{(len(self._ends_s) - 1) / took_s:.1f} frames/s")
        late = f"   {self._behind_s:.1f} s behind" if self._behind_s > REFRESH_S else ""
        watched = ("no alarms: monitor without calibration", "yellow") if self._budget is None else f"{self._budget}"
        said = "".join(f"   {part}" for part in parts)
        return Text.assemble((self._name, "bold"), said, (late, "yellow"), "   ", watched)


def _state_table(state: StreamState, frame: int, *, wide: bool) -> Table:
    """One row per query; where it is wide, with labels and pixels."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    right = {"justify": "right", "no_wrap": True}
    columns: dict[str, dict[str, Any]] = {
        "query": {"no_wrap": True, "max_width": 24}, "label": {"no_wrap": True}, "state": {"no_wrap": True},
        "pixel": right, "x, y, z (m)": right, "joint": {"no_wrap": wide}, "P(lost)": right,
        "": {"width": _BAR_WIDTH}, "alarm": {"no_wrap": True},
    }  # fmt: skip
    shown = [name for name in columns if wide or name not in ("label", "pixel")]
    for name in shown:
        table.add_column(name, **columns[name])
    for k, number in enumerate(state.query):
        alarm, lost_p, joint = state.alarm[k], float(state.lost_p[k]), state.joint[k]
        colour = "red" if lost_p >= _LIKELY else "yellow" if lost_p >= _POSSIBLE else "green"
        bar = ProgressBar(1.0, lost_p, width=_BAR_WIDTH, complete_style=colour, finished_style=colour)
        known, q = np.isfinite(lost_p), float(state.q[k])
        cells: dict[str, RenderableType] = {
            "query": Text(state.names[k], style="rgb({},{},{})".format(*query_colour(number))),
            "label": Text(state.labels[k] or ""),
            "state": Text(state.state[k].value, style=STATE_STYLE[state.state[k]]),
            "pixel": Text(_vector(state.uv_px[k], 1)),
            "x, y, z (m)": Text(_vector(state.point_world[k], 2)),
            "joint": Text("?" if joint is None else describe_joint(joint.kind.value, joint.lower, joint.upper, q=q)),
            "P(lost)": Text(f"{lost_p:.2f}" if known else "?"),
            "": bar if known else "",
            "alarm": Text("" if alarm is None else counted(frame - alarm.frame, "frame"), style="bold red"),
        }
        table.add_row(*(cells[name] for name in shown))
    return table


def event_line(event: Event) -> Text:
    """An event in one line."""
    when = f"frame {event.frame:>4} {event.stamp_s:>7.2f} s  "
    name = f"{event.name}  " if event.name else ""
    return Text.assemble((when, "dim"), name, (event.text, EVENT_STYLE[event.kind]))


def query_words(query: Query) -> str:
    """A query that has found nothing yet, as it was asked."""
    if query.uv_px is not None:
        return f"{query.name or 'point'} (from frame {query.frame} on)"
    return query.name or query.label or query.kind


def _vector(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{v:z.{digits}f}" for v in values) if np.isfinite(values).all() else "?"
