"""Write the figures table of the README out of the result files of `quest eval`.

    python benchmarks/update_readme.py            # rewrite README.md
    python benchmarks/update_readme.py --check    # fail if it would change

Result files are all `benchmarks/results/*.json`; nothing in the table is typed in.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from quest.evaluation.bootstrap import Value
from quest.evaluation.results import Results, read_results
from quest.evaluation.summary import Row

ROOT = Path(__file__).parents[1]
BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"

COLUMNS = (
    ("median px", "median_px", ".1f", 1),
    ("APE", "ape", ".3f", 1),
    ("D@100", "d100", ".3f", 1),
    ("Acc %", "acc", ".1f", 100),
    ("prec %", "precision", ".1f", 100),
    ("recall %", "recall", ".1f", 100),
)


@dataclass(frozen=True)
class UpdateReadme:
    """Rewrite the figures table of the README from the result files."""

    readme: Path = ROOT / "README.md"
    results: Path = ROOT / "benchmarks" / "results"
    check: bool = False
    """Change nothing; exit with 1 if the table is out of date."""

    def run(self) -> int:
        """Return 0, or 1 if --check finds the table out of date."""
        text = self.readme.read_text(encoding="utf-8")
        updated = with_figures(text, figures(self.results))
        if self.check:
            if updated != text:
                print(f"{self.readme} is out of date: python benchmarks/update_readme.py", file=sys.stderr)
            return int(updated != text)
        self.readme.write_text(updated, encoding="utf-8")
        return 0


def with_figures(text: str, table: str) -> str:
    """The README's text with another table between the markers."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not rest or END not in rest:
        raise SystemExit(f"expected the markers {BEGIN} and {END} in the README")
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
