"""How far a long job is: a bar in a terminal, lines where the output is piped."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from quest.cli.console import Console

_LINE_EVERY_S = 10.0


Report = Callable[..., None]
"""To be called with the number that is done, and with that of all where it was not known before."""


def bars(console: Console, *, transient: bool = False, disable: bool = False) -> Progress:
    """Bars with what is being done, how much of it is, and the time."""
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(TextColumn("{task.description}"), *columns, console=console, transient=transient, disable=disable)


@contextmanager
def advancing(console: Console, total: int) -> Iterator[Callable[[str, int], None]]:
    """A bar that is told what is being done, and how many are done since it was told before."""
    with bars(console, transient=True) as progress:
        task = progress.add_task("", total=total)
        yield lambda doing, done: progress.update(task, description=doing, advance=done)


@contextmanager
def counting(console: Console, doing: str, total: int | None, noun: str = "frames") -> Iterator[Report]:
    """Shows how many of all are done of a work such as ``tracking``, and the time left."""
    if console.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(f"{noun},"))
        with Progress(*columns, TimeRemainingColumn(), TextColumn("left"), console=console, transient=True) as progress:
            task = progress.add_task(doing, total=total)
            yield lambda done, of=None, /: progress.update(task, completed=done, total=of or total)
        return
    begun_s = said_s = time.monotonic()

    def line(done: int, of: int | None = None, /) -> None:
        nonlocal said_s
        now_s, of = time.monotonic(), of or total
        if now_s - said_s >= _LINE_EVERY_S and done != of:
            said_s = now_s
            left = "" if of is None else f", {(now_s - begun_s) / done * (of - done):.0f} s left"
            console.print(f"{doing}: {done} {'' if of is None else f'of {of} '}{noun}{left}", soft_wrap=True)

    yield line
