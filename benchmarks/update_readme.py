"""Write the figures of the README and of the model cards out of the result files of `quest eval`.

    python benchmarks/update_readme.py            # rewrite README.md and the cards
    python benchmarks/update_readme.py --check    # fail if one would change

Result files are all `benchmarks/results/*.json`, for weights other than the default those of the folder of their name;
nothing in the tables is typed in.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from quest.evaluation.bootstrap import Value
from quest.evaluation.results import Results, read_results
from quest.evaluation.summary import Row
from quest.model.weights import DEFAULTS

ROOT = Path(__file__).parents[1]
CARDS = ROOT / "src" / "quest" / "assets" / "weights"
BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"

COLUMNS = (
    ("median px", "median_px", ".1f", 1),
    ("APE", "ape", ".3f", 1),
    ("D@100", "d100", ".3f", 1),
    ("Acc %", "acc", ".1f", 100),
    ("prec %", "precision", ".1f", 100),
    ("recall %", "recall", ".1f", 100),
    ("place %", "place_recall", ".1f", 100),
)


@dataclass(frozen=True)
class UpdateReadme:
    """Rewrite the figures from the result files."""

    results: Path = ROOT / "benchmarks" / "results"
    check: bool = False
    """Change nothing; exit with 1 if the table is out of date."""

    def run(self) -> int:
        """Return 0, or 1 if --check finds a page out of date."""
        stale = 0
        for page, folder in pages(self.results).items():
            text = page.read_text(encoding="utf-8")
            updated = with_figures(text, figures(folder))
            if self.check and updated != text:
                print(f"{page} is out of date: python benchmarks/update_readme.py", file=sys.stderr)
                stale = 1
            elif updated != text:
                page.write_text(updated, encoding="utf-8")
        return stale


def pages(results: Path) -> dict[Path, Path]:
    """Every page with a pair of markers, and the folder of what it shows."""
    defaults = DEFAULTS.values()
    cards = {card: results if card.stem in defaults else results / card.stem for card in sorted(CARDS.glob("*.md"))}
    return {ROOT / "README.md": results, **cards}


def with_figures(text: str, table: str) -> str:
    """A page's text with another table between the markers."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not rest or END not in rest:
        raise SystemExit(f"expected the markers {BEGIN} and {END} in the page")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def figures(folder: Path) -> str:
    """All result files of a folder as Markdown."""
    files = sorted(folder.glob("*.json"))
    if not files:
        return "No results yet."
    return "\n\n".join(_section(read_results(file)) for file in files)


def _section(results: Results) -> str:
    headings = ["protocol", "objects", "level", "tracker", "n", *(heading for heading, *_ in COLUMNS)]
    lines = [_line(headings), _line(["---"] * len(headings))]
    lines += [_line(_cells(row)) for row in results.rows if row.reading == "moved" or row.protocol == "semantic"]
    run = results.run
    notes = [
        "n: objects / takes / tracks; in brackets the 95 % bootstrap interval over objects.",
        f"`{run.command}`, commit {run.commit}, data {run.data_hash[:12]}, {run.stamp[:10]}.",
        *results.notes,
    ]
    return "\n".join([*lines, "", *notes])


def _cells(row: Row) -> list[str]:
    objects = f"{row.source}, {row.part}, {row.reading}"
    count = f"{row.objects} / {row.takes} / {row.tracks}"
    values = [_value(getattr(row.metrics, field), form, factor) for _, field, form, factor in COLUMNS]
    return [row.protocol, objects, str(row.level), row.tracker, count, *values]


def _value(value: Value | None, form: str, factor: float) -> str:
    if value is None:
        return ""
    text = format(factor * value.mean, form)
    if value.low is None or value.high is None:
        return text
    return f"{text} ({format(factor * value.low, form)}–{format(factor * value.high, form)})"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(tyro.cli(UpdateReadme).run())
