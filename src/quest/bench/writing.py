"""Rows of a report as Markdown, LaTeX and pictures; columns are said in one small language."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quest.extras import require
from quest.whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Table:
    """One table of a page."""

    file: str
    """The report, below the folder of results."""
    title: str
    columns: str
    """Columns as ``heading = where``, divided by ``|``. Where in a row a value is: keys joined by dots; ``%`` first for
    percent, ``!%`` for the percentage of the complement; ``/``, ``of`` or ``to`` between several values."""
    rows: str = "rows"
    """Key of the rows: a list, or a mapping whose keys become ``key``; empty if the report is the only row."""
    each: str = ""
    """Key of a list in a row of which every entry makes a line; its values come after ``each.``."""
    only: Mapping[str, Any] = field(default_factory=dict)
    """Values that a row must have."""
    about: str = ""
    """A sentence above the table."""


@dataclass(frozen=True)
class Figure:
    """A picture of a table: one panel for each group of rows and measure, one line for each name."""

    across: str
    """Key of what goes along the horizontal axis; its values are numbers."""
    axis: str
    """What that axis is called."""
    measures: tuple[tuple[str, str], ...]
    """Keys of measures, joined by dots, and what they are called."""
    panel: tuple[str, ...] = ("takes_of", "source")
    """Keys that tell panels apart."""


SHARED = ("part", "level", "suite", "in frames", "reading", "of")
"""Columns that are said once above a table where all its rows agree."""


def matches(row: Mapping[str, Any], values: Mapping[str, Any]) -> bool:
    """Whether a row has all of these values."""
    return all(row[key] == value for key, value in values.items())


def cells_of(table: Table, report: Mapping[str, Any]) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Columns with their cells, empty ones left out, and what is the same in all rows and said once."""
    found: Any = report.get(table.rows, []) if table.rows else [report] if report else []
    if isinstance(found, dict):
        found = [{"key": key, **row} for key, row in found.items()]
    rows: list[dict[str, Any]] = [row for row in found if matches(row, table.only)]
    entries = [row | {"each": entry} for row in rows for entry in (row[table.each] if table.each else [{}])]
    wanted = dict(column.strip().split(" = ") for column in table.columns.split("|"))
    columns = {heading: [cell(entry, where) for entry in entries] for heading, where in wanted.items()}
    shared = {h: cells[0] for h, cells in columns.items() if h in SHARED and len(cells) > 1 and len(set(cells)) == 1}
    return {h: cells for h, cells in columns.items() if h not in shared and any(cells)}, shared


def markdown(table: Table, report: Mapping[str, Any], notes: Sequence[str] = (), *, before: str = "") -> str:
    """One table with its heading and notes; empty where there is nothing to show."""
    columns, shared = cells_of(table, report)
    if not columns:
        return ""
    lines = [line(columns), line("---" for _ in columns), *map(line, zip(*columns.values(), strict=True))]
    common = "; ".join(f"{heading}: {value}" for heading, value in shared.items() if value)
    parts = [f"## {table.title}", before, table.about, common, "\n".join(lines), "\n".join(notes)]
    return "\n\n".join(part for part in parts if part)


_LATEX = {"\\": r"\textbackslash{}", **{c: f"\\{c}" for c in "&%$#_{}"}, "~": r"\textasciitilde{}"}
_LATEX |= {"^": r"\textasciicircum{}", "–": "--", "Δ": r"$\Delta$", "<": "$<$", ">": "$>$", "∞": r"$\infty$"}


def latex(table: Table, report: Mapping[str, Any]) -> str:
    """One table for a paper, with the rules of booktabs; empty where there is nothing to show."""
    columns, shared = cells_of(table, report)
    if not columns:
        return ""

    def row(cells: Iterable[str]) -> str:
        return " & ".join("".join(_LATEX.get(letter, letter) for letter in text) for text in cells) + r" \\"

    said = "; ".join([table.title, *(f"{heading}: {value}" for heading, value in shared.items() if value)])
    caption = "".join(_LATEX.get(letter, letter) for letter in said)
    body = [row(columns), r"\midrule", *map(row, zip(*columns.values(), strict=True))]
    head = [r"\begin{table}", rf"\caption{{{caption}}}", rf"\begin{{tabular}}{{{'l' * len(columns)}}}", r"\toprule"]
    return "\n".join([*head, *body, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def draw(figure: Figure, title: str, rows: Sequence[Mapping[str, Any]], paths: Sequence[Path]) -> None:
    """Write a picture of rows, in the formats that the names of the files say.

    Bands are 95 % intervals; hollow marks are what was published.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
    """
    require("matplotlib")
    from matplotlib.figure import Figure as Canvas

    panels = list(dict.fromkeys(tuple(row.get(key) for key in figure.panel) for row in rows))
    canvas = Canvas(figsize=(4.2 * len(figure.measures), 3.0 * len(panels) + 0.6), layout="constrained")
    axes = canvas.subplots(len(panels), len(figure.measures), squeeze=False)
    for panel, line_of_axes in zip(panels, axes, strict=True):
        chosen = [row for row in rows if tuple(row.get(key) for key in figure.panel) == panel]
        for (where, called), ax in zip(figure.measures, line_of_axes, strict=True):
            _panel(ax, figure.across, where, chosen)
            ax.set(xlabel=figure.axis, ylabel=called)
            ax.set_title(", ".join(str(part) for part in panel if part), fontsize=9)
    handles, labels = axes[0][0].get_legend_handles_labels()
    canvas.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    canvas.suptitle(title, fontsize=11)
    undated: dict[str, Any] = {"Date": None}
    for path in paths:
        with whole_file(path) as partial:
            canvas.savefig(
                partial, format=path.suffix[1:], dpi=120, metadata=undated if path.suffix == ".svg" else None
            )


def _panel(ax: Axes, across: str, where: str, rows: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(str(row["line"]) for row in rows))
    for i, name in enumerate(names):
        own = sorted((row for row in rows if row["line"] == name and find(row, where)), key=lambda r: r[across])
        if not own:
            continue
        colour = f"C{i % 10}"
        values = [find(row, where) for row in own]
        x, y = [row[across] for row in own], [value["mean"] for value in values]
        ax.plot(x, y, marker="o", markersize=3, linewidth=1.2, color=colour, label=name)
        low, high = ([y[j] if v[end] is None else v[end] for j, v in enumerate(values)] for end in ("low", "high"))
        ax.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)
        said = [(row[across], find(row, where.replace("metrics.", "published."))) for row in own]
        said = [(at, value) for at, value in said if value is not None]
        if said:
            ax.plot(*zip(*said, strict=True), "o", markerfacecolor="none", color=colour)
    ax.set_xticks(sorted({row[across] for row in rows}))
    ax.grid(alpha=0.3)


def find(row: Mapping[str, Any], where: str) -> Any:
    """The value at keys joined by dots; None where there is none."""
    value: Any = row
    for key in where.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def cell(row: Mapping[str, Any], where: str) -> str:
    """What a column says of a row."""
    for between in (" of ", " to ", "/"):
        if between in where:
            return between.join(cell(row, part) for part in where.split(between))
    value = find(row, where.lstrip("!%"))
    if where.startswith("!") and value is not None:
        value = {"mean": 1 - value["mean"], "low": less(value["high"]), "high": less(value["low"])}
    return shown(value, percent="%" in where[:2])


def less(bound: float | None) -> float | None:
    """The complement of a share."""
    return None if bound is None else 1 - bound


def shown(value: Any, *, percent: bool = False) -> str:
    """A value as text: a number, or a number with its interval."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, Mapping):
        middle, low, high = value.get("share", value.get("mean")), value.get("low"), value.get("high")
        if middle is None or low is None:
            return shown(middle, percent=percent)
        texts = [number(v, percent=percent, fixed=True) if v is not None else "∞" for v in (middle, low, high)]
        return f"{texts[0]} ({texts[1]}{' to ' if texts[1].startswith('-') else '–'}{texts[2]})"
    return number(value, percent=percent) if isinstance(value, float) else str(value)


def number(value: float, *, percent: bool = False, fixed: bool = False) -> str:
    """A number with as many digits as mean something."""
    if percent:
        return f"{100 * value:.{int(0 < abs(value) < 0.1)}f}"
    if abs(value) >= 1000:
        return f"{value:.0f}"
    if fixed and abs(value) < 1:
        return f"{value:.{4 if 0 < abs(value) < 0.0095 else 3}f}"
    return f"{value:.3g}"


def line(cells: Iterable[str]) -> str:
    """One line of a Markdown table."""
    return f"| {' | '.join(cells)} |"
