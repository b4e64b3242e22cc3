"""``quest live`` and ``quest pick``: pages of this machine, to follow a camera and to choose what to follow."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

from quest.cli.console import Console
from quest.cli.monitor import EXIT_ALARM
from quest.cli.source import Source, say_flags, say_shortfall
from quest.data.queries_file import read_queries
from quest.wording import counted


@dataclass(frozen=True)
class Live(Source):
    """Follow a camera live on a page of this machine: click to add, remove, rename, and answer alarms.

    A recording is played at its own pace. Frames that come while one is worked on are dropped. Without queries,
    entities are found by and by. Ctrl-C ends it. Exit code: 0 if no alarm is open at the end, 3 if one is.
    """

    out: Path | None = None
    """Folder for frames.jsonl, the answers in one line a frame, and edits.jsonl, what was asked on the page."""
    port: int = 0
    """Port of the page on 127.0.0.1; 0 takes a free one."""
    browser: bool = True
    """Open the page in a browser; a recording begins when the page is there."""

    def run(self) -> int:
        """Serve, step, summarise."""
        from quest.data.live_camera import as_live
        from quest.live.server import Feed, Server
        from quest.live.session import Session
        from quest.viz.live import event_line

        self.check_alpha()
        console = Console()
        recording = self.open()
        source = as_live(recording)
        queries, tracker = self.queries(source), self.tracker()
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
        budget = self.budget(tracker, source)
        session = Session(tracker, source, queries, alpha=budget.alpha, alpha_frames=budget.frames, record=self.out)
        say_shortfall(tracker, console, budget, frames=None)
        with console.status("warming up"):
            session.warm_up()
        feed = Feed()
        feed.begin(session)
        with Server(f"quest live {source.name}", "live", {"GET /feed": feed.serve}, port=self.port) as server:
            console.print(f"page: {server.url}")
            words = "the recording is over"
            try:
                if self.browser:
                    webbrowser.open(server.url)
                    if not recording.live:
                        feed.opened.wait()
                for events in session.run():
                    for event in events:
                        console.print(event_line(event))
            except KeyboardInterrupt:
                words = "ended by Ctrl-C"
            finally:
                feed.end(words)
        say_flags(source, console)
        raised, cleared = session.events.raised, session.events.cleared
        console.print(
            f"{source.name}: {session.stream.frame} frames; alarms: {raised} raised, {cleared} cleared, "
            f"{raised - cleared} left open"
        )
        if self.out is not None:
            console.print(f"kept: {self.out}")
        still = session.state is not None and any(alarm is not None for alarm in session.state.alarm)
        return EXIT_ALARM if still else 0


@dataclass(frozen=True)
class Pick(Source):
    """Choose what to follow on a page of this machine: click points, drag boxes, take what the finder sees, preview.

    What is saved is a file of queries that every command takes with --queries.
    """

    out: Path = Path("queries.json")
    """The file of queries; what is in it already is shown first."""
    port: int = 0
    """Port of the page on 127.0.0.1; 0 takes a free one."""
    browser: bool = True
    """Open the page in a browser."""

    def run(self) -> int:
        """Serve until the page is closed by its button, or Ctrl-C."""
        from quest.live.picking import Picking
        from quest.live.server import Server

        console = Console()
        clip = self.read(console)
        queries = self.queries(clip)
        if queries is None and self.out.exists():
            queries = read_queries(self.out)
        picking = Picking(self.tracker(), clip, queries or [], self.out)
        with Server(f"quest pick {clip.name}", "pick", picking.routes, port=self.port) as server:
            console.print(f"page: {server.url}")
            if self.browser:
                webbrowser.open(server.url)
            try:
                picking.done.wait()
            except KeyboardInterrupt:
                pass
            finally:
                picking.stop()
        if picking.saved:
            console.print(f"{counted(picking.saved, 'query', 'queries')}: {self.out}")
            console.print(f"use them: quest track {self.clip} --queries {self.out}")
        else:
            console.print("nothing was saved")
        return 0
