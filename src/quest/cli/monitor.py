"""``quest monitor``: watch the tracker at work on a recording, live, with its alarms."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from quest.cli.console import Console
from quest.cli.source import Source, say_flags, say_shortfall
from quest.data.frame_source import FrameSource
from quest.errors import InputError
from quest.wording import counted

if TYPE_CHECKING:
    from quest.track import Stream, StreamState

EXIT_ALARM = 3

NOTHING_FOUND = (
    "nothing to follow was found; point at it with --point FRAME,X,Y (a pixel of that frame), "
    "or name it with --label handle, knob, rim or front, which are taken at less confidence"
)


@dataclass(frozen=True)
class Monitor(Source):
    """Watch a recording or a take live: states, joints and alarms, frame by frame.

    Without queries the entities are discovered. Exit code: 0 if no alarm is open at the end, 3 if one is.
    """

    jsonl: Path | None = None
    """Write one JSON object per frame to this file; - is standard output, and then the view goes to standard error."""
    realtime: bool = False
    """Play at the recording's own pace; no frame is skipped, so a slow machine falls behind."""

    def run(self) -> int:
        """Step through the recording as it is read, show, write."""
        from quest.track.state_lines import StateLines
        from quest.viz.live import LiveView, query_words

        self.check_alpha()
        console = self._console()
        source = self.open()
        length = source.length
        queries = self.queries(source)
        tracker = self.tracker()
        budget = self.budget(tracker, source)
        stream = tracker.stream(
            source.camera,
            queries,
            online=self.online or (source.live and queries is None),
            wait=not (self.realtime or source.live),
            alpha=budget.alpha,
            alpha_frames=budget.frames,
        )
        frames = "" if length is None else f"{counted(length, 'frame')}, "
        console.print(f"watching {source.name}: {frames}{self.weights} on {tracker.device}")
        if stream.budget is None:
            console.note(
                "no calibration of the monitor: no alarms, P(lost) is unknown, and exit code 0 says nothing; "
                "`quest calibrate` makes one"
            )
        say_shortfall(tracker, console, budget, frames=length)
        view = LiveView(console, name=source.name, frames=length if source.exact else None, budget=stream.budget)
        state, last = None, -1
        try:
            with contextlib.nullcontext() if self.jsonl is None else StateLines(self.jsonl) as lines, view:
                for t, state, behind_s in self._play(stream, source):
                    last = t
                    if lines is not None:
                        lines.write(state, frame=t)
                    view.show(t, state, waiting=stream.unbound, behind_s=behind_s)
                    if not (state.names or stream.looking):
                        break
        except KeyboardInterrupt:
            console.print(view.summary())
            raise
        late = next((q for q in stream.unbound if q.kind == "point" and q.frame > last), None)
        if late is not None:
            raise InputError(f"{query_words(late)}: expected a frame of {source.name!r}, which ended at frame {last}")
        if state is None or not state.names:
            raise InputError(f"clip {source.name!r}: {NOTHING_FOUND}")
        for query in stream.unbound:
            console.note(f"{query_words(query)}: found no entity; ask for it by --point")
        say_flags(source, console)
        console.print(view.summary())
        return EXIT_ALARM if any(alarm is not None for alarm in state.alarm) else 0

    def _console(self) -> Console:
        to_output = str(self.jsonl) == "-"
        # A table that redraws itself would run into lines that come out in the same terminal.
        clash = to_output and sys.stdout.isatty()
        console = Console(stderr=to_output, force_interactive=False if clash else None)
        console.soft_wrap = not console.is_interactive
        return console

    def _play(self, stream: Stream, source: FrameSource) -> Iterator[tuple[int, StreamState, float]]:
        """Index and answers of every frame, and how many seconds they come too late for the recording's pace."""
        begun_s = 0.0
        for t, frame in enumerate(source):
            if t == 0:
                begun_s = time.monotonic() - frame.stamp_s
            if self.realtime:
                time.sleep(max(0.0, begun_s + frame.stamp_s - time.monotonic()))
            state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
            yield t, state, max(0.0, time.monotonic() - begun_s - frame.stamp_s) if self.realtime else 0.0
