"""``quest pick``: choose what to follow in a recording, on a local page."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape

from quest.cli.console import Console
from quest.cli.source import Source
from quest.wording import counted


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
        from quest.data.queries_file import read_queries
        from quest.live.picking import Picking
        from quest.live.server import Server

        console = Console(highlight=False, soft_wrap=True)
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
            console.print(f"{counted(picking.saved, 'query', 'queries')}: {escape(str(self.out))}")
            console.print(f"use them: quest track {escape(self.clip)} --queries {escape(str(self.out))}")
        else:
            console.print("nothing was saved")
        return 0
