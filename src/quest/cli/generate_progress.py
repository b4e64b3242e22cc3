"""The bar of ``quest generate``, and the lines beside it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from quest.wording import counted

if TYPE_CHECKING:
    from types import TracebackType

    from quest.sim.production import Event


_LEAST_S = 5.0
"""Less says nothing of the speed: takes are written while the next ones are rendered, so two may end together."""


class GenerateProgress:
    """Shows what a production reports; a context manager that sums up at the end.

    Args:
        console: where to show it.
        store: folder or URL of the store, for the last line.
        total: how many takes are to be made.
    """

    def __init__(self, console: Console, store: str, total: int) -> None:
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[speed]}"),
            TimeElapsedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        self.made = self.skipped = 0
        self._console, self._store = console, store
        self._bar = Progress(*columns, console=console)
        self._task = self._bar.add_task("warming up (shaders)", total=total, speed="")
        self._said: set[str] = set()
        self._frames, self._first, self._last = 0, 0.0, 0.0

    def __enter__(self) -> GenerateProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        if self.made or self.skipped:
            speed = f" at {self._speed()}" if self._speed() else ""
            made = f"{counted(self.made, 'take')} written{speed}, {self.skipped} skipped"
            # To the log as one line, whatever the width of the terminal.
            self._console.print(f"{made}; store {escape(self._store)}", soft_wrap=True)

    def __call__(self, event: Event) -> None:
        """Show an event."""
        from quest.sim.production import Notice, TakeMade

        if isinstance(event, Notice):
            self._warn(event.text)
            return
        if isinstance(event, TakeMade):
            self._count(event.frames)
            for warning in event.warnings:
                self._warn(f"{event.spec.object_id}: {warning}")
        else:
            self.skipped += 1
            self._warn(f"skipped {event.spec.object_id}: {event.reason}")
        self._bar.update(self._task, advance=1, description=escape(event.spec.name), speed=self._speed())

    def _count(self, frames: int) -> None:
        self.made, self._last = self.made + 1, time.perf_counter()
        if self.made == 1:  # the first take pays for the shaders
            self._first = self._last
        else:
            self._frames += frames

    def _speed(self) -> str:
        took_s = self._last - self._first
        return f"{self._frames / took_s:.1f} frames/s" if took_s >= _LEAST_S else ""

    def _warn(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._console.print(f"[yellow]{escape(line)}[/]")
