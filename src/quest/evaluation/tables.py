"""Result rows as a table in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from quest.evaluation.bootstrap import Value
from quest.evaluation.results import Results
from quest.evaluation.summary import Row
from quest.evaluation.take_suite import STANDARD


@dataclass(frozen=True)
class Column:
    """A metric's column."""

    field: str
    """Of :class:`quest.evaluation.summary.Metrics`."""
    heading: str
    """Above it."""
    decimals: int
    """Shown."""
    factor: float
    """100 for shares that are shown in percent."""
    rank: int
    """Columns of high rank go first where the terminal is narrow."""


COLUMNS = (
    Column("ape", "APE", 3, 1.0, 0),
    Column("ape_vis", "APE_vis", 3, 1.0, 5),
    Column("d50", "D@50", 3, 1.0, 7),
    Column("d100", "D@100", 3, 1.0, 3),
    Column("acc", "Acc %", 1, 100.0, 1),
    Column("switches", "switches", 1, 1.0, 6),
    Column("slope", "slope", 3, 1.0, 9),
    Column("median_px", "med px", 1, 1.0, 2),
    Column("ape_px", "APE_px", 1, 1.0, 4),
    Column("ape_2d", "APE_2d", 3, 1.0, 10),
    Column("precision", "prec %", 1, 100.0, 1),
    Column("recall", "rec %", 1, 100.0, 1),
    Column("place_recall", "place %", 1, 100.0, 8),
)
"""What a wide table shows, in this order; the result file has everything."""

PART_TITLES = {"train": "TRAINING OBJECTS, no measure of generalisation", "unlisted": "objects outside the split"}
FULL_WIDTH = 170
"""Enough for every column; for output that goes to a file."""

GAP = 3
"""Characters between columns: padding on both sides and the box's divider."""

LEGEND = (
    "cells: mean over frames, entities and views; below it the 95 % bootstrap interval over objects (two objects or "
    "more). n: objects/takes/tracks. Distances in normalised units, pixels of a 224 x 224 input"
)


def results_table(results: Results, *, width: int = FULL_WIDTH) -> RenderableType:
    """All rows as tables, one per protocol, part of the split, source and suite, followed by notes and what made them.

    Args:
        results: what to show.
        width: of the terminal in characters; columns that do not fit are left out whole.
    """
    parts: list[RenderableType] = []
    dropped: set[str] = set()
    for (protocol, part, source, suite), group in groupby(
        results.rows, key=lambda r: (r.protocol, r.part, r.source, r.suite)
    ):
        rows = list(group)
        columns = [c for c in COLUMNS if any(getattr(row.metrics, c.field) is not None for row in rows)]
        heads = [("L", "of", "tracker", "n"), *(_head(row) for row in rows)]
        kept = fitting(columns, heads, lambda column, rows=rows: [_value(row, column) for row in rows], width)
        dropped |= {c.heading for c in columns if c not in kept}
        title = f"{protocol} · {source} · {PART_TITLES.get(part, f'{part} objects')}"
        parts.append(_table(title if suite == STANDARD else f"{title} · suite {suite}", rows, kept))
    run = results.run
    small = [LEGEND, *results.notes]
    if dropped:
        small.append(f"not shown for want of width: {', '.join(sorted(dropped))}")
    small.append(
        f"commit {run.commit}, data {run.data_hash[:12]}" + (f", weights {run.weights}" if run.weights else "")
    )
    parts += [Text(line, style="dim") for line in small]
    return Group(*parts)


def fitting(
    columns: Sequence[Column],
    heads: Sequence[tuple[str, ...]],
    values: Callable[[Column], Sequence[Value | None]],
    width: int,
) -> list[Column]:
    """Columns by rank as long as they fit; a number is never cut.

    Args:
        columns: to choose from.
        heads: the texts to the left of them, the headings first.
        values: what a column shows.
        width: of the terminal in characters.
    """
    left = width - sum(max(map(len, texts)) + GAP for texts in zip(*heads, strict=True))
    kept = []
    for column in sorted(columns, key=lambda c: c.rank):
        cells = [line for value in values(column) for line in cell(value, column).plain.split("\n")]
        left -= max(len(text) for text in [column.heading, *cells]) + GAP
        if left < 0:
            break
        kept.append(column)
    return [c for c in columns if c in kept]


def _table(title: str, rows: list[Row], columns: list[Column]) -> Table:
    style = "bold red" if rows[0].part == "train" else "bold"
    table = Table(
        title=title, title_justify="left", title_style=style, box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1)
    )
    for heading in ("L", "of", "tracker", "n"):
        table.add_column(heading, no_wrap=True)
    for column in columns:
        table.add_column(column.heading, justify="right", no_wrap=True)
    for _, group in groupby(rows, key=lambda r: (r.level, r.reading)):
        for i, row in enumerate(group):
            level, reading, tracker, count = _head(row)
            lead = (level, reading) if i == 0 else ("", "")
            table.add_row(*lead, tracker, count, *(cell(_value(row, column), column) for column in columns))
        table.add_section()
    return table


def _head(row: Row) -> tuple[str, str, str, str]:
    return str(row.level), row.reading, row.tracker, f"{row.objects}/{row.takes}/{row.tracks}"


def _value(row: Row, column: Column) -> Value | None:
    return getattr(row.metrics, column.field)


def cell(value: Value | None, column: Column) -> Text:
    """A number, and below it its interval."""
    if value is None:
        return Text("-", style="dim")

    def show(number: float) -> str:
        return f"{column.factor * number:.{column.decimals}f}"

    text = Text(show(value.mean))
    if value.low is not None and value.high is not None:
        text.append(f"\n{_short(show(value.low))}–{_short(show(value.high))}", style="dim")
    return text


def _short(number: str) -> str:
    """A number without the zero before its point."""
    return number.replace("0.", ".", 1) if number.startswith(("0.", "-0.")) else number
