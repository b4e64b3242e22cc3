"""How far a long job is: a bar in a terminal, lines where the output is piped."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

_LINE_EVERY_S = 10.0


@contextmanager
def counting(console: Console, doing: str, total: int | None, noun: str = "frames") -> Iterator[Callable[[int], None]]:
    """Shows how many of something are done, and the time left.

    Args:
        console: where to show it.
        doing: what is done, such as ``tracking``.
        total: how many there are; None if only the end tells.
        noun: what they are.

    Yields:
        To be called with the number that is done.
    """
    if console.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(f"{noun},"))
        with Progress(*columns, TimeRemainingColumn(), TextColumn("left"), console=console, transient=True) as progress:
            task = progress.add_task(doing, total=total)
            yield lambda done: progress.update(task, completed=done)
        return
    begun_s = said_s = time.monotonic()

    def line(done: int) -> None:
        nonlocal said_s
        now_s = time.monotonic()
        if now_s - said_s >= _LINE_EVERY_S and done != total:
            said_s = now_s
            left = "" if total is None else f", {(now_s - begun_s) / done * (total - done):.0f} s left"
            console.print(f"{doing}: {done} {'' if total is None else f'of {total} '}{noun}{left}", soft_wrap=True)

    yield line
