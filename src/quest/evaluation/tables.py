"""Result rows as tables in the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from quest.evaluation.bootstrap import Value
from quest.evaluation.results import Results
from quest.evaluation.summary import STANDARD


@dataclass(frozen=True)
class Column:
    """A metric's column."""

    field: str
    """Of a row's values, such as :class:`quest.evaluation.summary.Metrics`."""
    heading: str
    decimals: int
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

    Columns that do not fit into so many characters are left out whole.
    """
    parts: list[RenderableType] = []
    dropped: set[str] = set()
    for (protocol, part, source, suite), group in groupby(
        results.rows, key=lambda r: (r.protocol, r.part, r.source, r.suite)
    ):
        rows = [
            ((str(r.level), r.reading, r.tracker, f"{r.objects}/{r.takes}/{r.tracks}"), vars(r.metrics)) for r in group
        ]
        title = f"{protocol} · {source} · {PART_TITLES.get(part, f'{part} objects')}"
        title += "" if suite == STANDARD else f" · suite {suite}"
        style = "bold red" if part == "train" else "bold"
        table = columns_table(title, ("L", "of", "tracker", "n"), rows, COLUMNS, width, style=style, once=2)
        known = {c.heading for c in COLUMNS if any(values[c.field] for _, values in rows)}
        dropped |= known - {str(column.header) for column in table.columns}
        parts.append(table)
    run = results.run
    small = [LEGEND, *results.notes]
    if dropped:
        small.append(f"not shown for want of width: {', '.join(sorted(dropped))}")
    weights = f", weights {run.weights}" if run.weights else ""
    small.append(f"commit {run.commit}, data {run.data_hash[:12]}{weights}")
    return Group(*parts, *(Text(line, style="dim") for line in small))


def columns_table(
    title: str,
    headings: tuple[str, ...],
    rows: Sequence[tuple[tuple[str, ...], Mapping[str, Value | None]]],
    columns: Sequence[Column],
    width: int,
    *,
    style: str = "bold",
    once: int = 0,
) -> Table:
    """Rows as a table, of which columns without any value are omitted, and by rank those that do not fit.

    Args:
        title: above it.
        headings: of the texts that begin a row.
        rows: the texts that begin each row, and its values by field.
        columns: to choose from; a number is never cut.
        width: of the terminal in characters.
        style: of the title.
        once: how many of the first headings stand once for rows that agree in them, with a rule below these.
    """
    left = width - sum(max(map(len, texts)) + GAP for texts in zip(headings, *(head for head, _ in rows), strict=True))
    kept = []
    for column in sorted((c for c in columns if any(values.get(c.field) for _, values in rows)), key=lambda c: c.rank):
        lines = [line for _, values in rows for line in _cell(values.get(column.field), column).plain.split("\n")]
        left -= max(map(len, [column.heading, *lines])) + GAP
        if left < 0:
            break
        kept.append(column)
    kept = [c for c in columns if c in kept]
    table = Table(
        title=title, title_justify="left", title_style=style, box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1)
    )
    for heading in headings:
        table.add_column(heading, no_wrap=True)
    for column in kept:
        table.add_column(column.heading, justify="right", no_wrap=True)
    before = None
    for head, values in rows:
        if once and before is not None and head[:once] != before:
            table.add_section()
        lead = ("",) * once if head[:once] == before else head[:once]
        table.add_row(*lead, *head[once:], *(_cell(values.get(column.field), column) for column in kept))
        before = head[:once]
    return table


def _cell(value: Value | None, column: Column) -> Text:
    """A number, and below it its interval without the zeros before the points."""
    if value is None:
        return Text("-", style="dim")
    texts = [
        "" if number is None else f"{column.factor * number:.{column.decimals}f}"
        for number in (value.mean, value.low, value.high)
    ]
    low, high = (text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text for text in texts[1:])
    return Text.assemble(texts[0], (f"\n{low}–{high}" if low and high else "", "dim"))


def shown(value: Any, *, decimals: int = 3, factor: float = 1.0, none: str = "-") -> str:
    """A number, with its interval if it has one, or a word."""
    if value is None or isinstance(value, bool | int | str):
        return none if value is None else str(value)
    if isinstance(value, float):
        return f"{factor * value:.{decimals}f}"
    middle, low, high = value.mean, value.low, value.high
    if low is None and high is None:
        return f"{factor * middle:.{decimals}f}"
    ends = ["∞" if end is None else f"{factor * end:.{decimals}f}" for end in (low, high)]
    return f"{factor * middle:.{decimals}f} ({(' to ' if '-' in ends[0] else '–').join(ends)})"
