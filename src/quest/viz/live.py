"""The live view of a stream in a terminal, and its events as plain lines where there is no terminal."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from types import TracebackType

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from quest.filter.joints import Joint
from quest.monitor import Budget
from quest.track import StreamState
from quest.track.events import Event, Events, Happening
from quest.tracks import describe_joint
from quest.types import Query, State
from quest.viz.palette import query_colour

REFRESH_S = 0.2
"""Time between two pictures of the table."""

EVENTS_SHOWN = 6

WIDE = 110
"""Columns of a terminal from which labels and pixels have room."""

STATE_STYLE = {State.TRACKING: "green", State.HELD: "yellow", State.LOST: "bold red"}

EVENT_STYLE: dict[Happening, str] = {
    "bound": "",
    "alarm": "bold red",
    "cleared": "green",
    "lost": "red",
    "found": "green",
    "degraded": "yellow",
}

_RATE_FRAMES = 20
_BAR_WIDTH = 6
_LIKELY, _POSSIBLE = 0.5, 0.2


class LiveView:
    """Shows a stream while it is stepped; a context manager.

    In a terminal it is a table that refreshes itself; elsewhere one line per event.

    Args:
        console: where to show it.
        name: what is being watched.
        frames: how many frames there will be; None where only the end tells.
        budget: of false alarms; None where nothing raises any.
    """

    def __init__(self, console: Console, *, name: str, frames: int | None, budget: Budget | None) -> None:
        self._console = console
        self._name = name
        self._frames = frames
        self._budget = budget
        self._live = (
            Live(console=console, auto_refresh=False, redirect_stdout=False) if console.is_interactive else None
        )
        self._events = Events()
        self._last: deque[Event] = deque(maxlen=EVENTS_SHOWN)
        self._begun_s = time.monotonic()
        self._ends_s: deque[float] = deque([self._begun_s], maxlen=_RATE_FRAMES)
        self._drawn_s = 0.0
        self._frame = -1
        self._state: StreamState | None = None
        self._waiting: tuple[Query, ...] = ()
        self._behind_s = 0.0

    def __enter__(self) -> LiveView:
        self._begun_s = time.monotonic()
        self._ends_s = deque([self._begun_s], maxlen=_RATE_FRAMES)
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.update(self.picture(), refresh=True)
            self._live.stop()

    def show(
        self, frame: int, state: StreamState, *, waiting: Sequence[Query] = (), behind_s: float = 0.0
    ) -> tuple[Event, ...]:
        """Take in the next frame; gives what happened in it.

        Args:
            frame: its index.
            state: what the stream answered.
            waiting: queries that have not found their entity.
            behind_s: by how much the view lags behind the recording's own pace.
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
            parts += [
                Text(f"alarm: {alarm.name}, open for {_frames(self._frame - alarm.frame)}: {alarm.reason}", "bold red")
                for alarm in state.alarm
                if alarm is not None
            ]
            # Below the alarms, because a terminal that is too low cuts off what is at the end.
            if state.names:
                parts.append(state_table(state, self._frame, wide=self._console.width >= WIDE))
        if self._waiting:
            parts.append(Text(f"not followed: {', '.join(query_words(q) for q in self._waiting)}", style="yellow"))
        parts += [Text(), *(event_line(event) for event in self._last)] if self._last else []
        return Group(*parts)

    def summary(self) -> Text:
        """What has been seen so far, for the end."""
        seconds = max(self._ends_s[-1] - self._begun_s, 1e-6)
        frames = self._frame + 1
        text = Text(
            f"{self._name}: {_frames(frames) if self._frames is None else f'{frames} of {_frames(self._frames)}'} "
            f"in {seconds:.1f} s ({frames / seconds:.1f} per s)"
        )
        if self._budget is None:
            text.append("; no alarms, because the monitor has no calibration", style="yellow")
        else:
            raised, cleared = self._events.raised, self._events.cleared
            open_now = raised - cleared
            text.append(f"; alarms: {raised} raised, {cleared} cleared, ")
            text.append(f"{open_now} left open", style="bold red" if open_now else "green")
        return text

    def _head(self) -> Text:
        text = Text(self._name, style="bold")
        of = "" if self._frames is None else f" (0 to {self._frames - 1})"
        text.append(f"   frame {max(self._frame, 0)}{of}", style="not bold")
        if self._state is not None:
            text.append(f"   {self._state.stamp_s:.2f} s", style="not bold")
        took_s = self._ends_s[-1] - self._ends_s[0]
        if took_s > 0:
            text.append(f"   {(len(self._ends_s) - 1) / took_s:.1f} frames/s", style="not bold")
        if self._behind_s > REFRESH_S:
            text.append(f"   {self._behind_s:.1f} s behind", style="not bold yellow")
        if self._budget is None:
            text.append("   no alarms: monitor without calibration", style="not bold yellow")
        else:
            text.append(f"   {self._budget}", style="not bold")
        return text


def state_table(state: StreamState, frame: int, *, wide: bool) -> Table:
    """One row per query.

    Args:
        state: what the stream answered.
        frame: index of the frame, for the age of alarms.
        wide: whether there is room for labels and pixels.
    """
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("query", no_wrap=True, max_width=24)
    if wide:
        table.add_column("label", no_wrap=True)
    table.add_column("state", no_wrap=True)
    if wide:
        table.add_column("pixel", justify="right", no_wrap=True)
    table.add_column("x, y, z (m)", justify="right", no_wrap=True)
    table.add_column("joint", no_wrap=wide)
    table.add_column("P(lost)", justify="right", no_wrap=True)
    table.add_column("", width=_BAR_WIDTH)
    table.add_column("alarm", no_wrap=True)
    for k, number in enumerate(state.query):
        alarm, lost_p = state.alarm[k], float(state.lost_p[k])
        known = np.isfinite(lost_p)
        colour = "red" if lost_p >= _LIKELY else "yellow" if lost_p >= _POSSIBLE else "green"
        label = [Text(state.labels[k] or "")] if wide else []
        pixel = [Text(_vector(state.uv_px[k], 1))] if wide else []
        table.add_row(
            Text(state.names[k], style="rgb({},{},{})".format(*query_colour(number))),
            *label,
            Text(state.state[k].value, style=STATE_STYLE[state.state[k]]),
            *pixel,
            Text(_vector(state.point_world[k], 2)),
            Text(joint_words(state.joint[k], float(state.q[k]))),
            Text(f"{lost_p:.2f}" if known else "?"),
            ProgressBar(1.0, lost_p, width=_BAR_WIDTH, complete_style=colour, finished_style=colour) if known else "",
            Text("" if alarm is None else _frames(frame - alarm.frame), style="bold red"),
        )
    return table


def joint_words(joint: Joint | None, q: float) -> str:
    """Kind of a joint, where on it a query is, and in brackets the range that was seen, in metres or degrees.

    Args:
        joint: in the world, metres; None where it is unknown.
        q: where on it, metres or radians; NaN where it is unknown.
    """
    if joint is None:
        return "?"
    return describe_joint(joint.kind.value, joint.lower, joint.upper, q=q)


def event_line(event: Event) -> Text:
    """An event in one line."""
    text = Text(f"frame {event.frame:>4} {event.stamp_s:>7.2f} s  ", style="dim")
    return text.append(f"{event.name}  " if event.name else "", "not dim").append(
        event.text, f"not dim {EVENT_STYLE[event.kind]}"
    )


def query_words(query: Query) -> str:
    """A query that has found nothing yet, as it was asked."""
    if query.uv_px is not None:
        return f"{query.name or 'point'} (from frame {query.frame} on)"
    return query.name or query.label or query.kind


def _vector(values: np.ndarray, digits: int) -> str:
    return " ".join(f"{v:z.{digits}f}" for v in values) if np.isfinite(values).all() else "?"


def _frames(count: int) -> str:
    return f"{count} frame" if count == 1 else f"{count} frames"
