"""Compare grounding switched on with grounding switched off, on the same frames of one run of `quest eval`.

    quest eval --takes STORE --trackers quest quest-ungrounded --out RUN.json
    python benchmarks/grounding.py RUN.records.parquet --out benchmarks/results/grounding/grounding.json

Moved entities only. A frame is well seen where its entity is visible in it and in the two frames before and after, and
the tracker without grounding follows the right entity. Frames that are chosen by the success of one tracker favour it,
so that the test is a hard one for grounding. Below zero is better for differences, below one for ratios.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from quest.evaluation.paired import AROUND_FRAMES, MARGIN, PairedRow, compare
from quest.evaluation.report import gather, origins_json, provenance, shown, write_report


@dataclass(frozen=True)
class Grounding:
    """Distances with and without grounding, paired, with intervals over objects."""

    records: tyro.conf.Positional[tuple[Path, ...]]
    """Files of records (.records.parquet)."""
    on: str = "quest"
    """The tracker with grounding."""
    off: str = "quest-ungrounded"
    """The tracker without."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Compare, print, write."""
        records, origins = gather(self.records)
        rows = compare(records, on=self.on, off=self.off, resamples=self.resamples, seed=self.seed)
        Console(width=215).print(_table(rows))
        if self.out is not None:
            report = provenance() | {
                "on": self.on,
                "off": self.off,
                "around_frames": AROUND_FRAMES,
                "margin": MARGIN,
                "resamples": self.resamples,
                "seed": self.seed,
                "origins": origins_json(origins),
                "rows": [asdict(row) for row in rows],
            }
            write_report(report, self.out)
        return 0


def _table(rows: tuple[PairedRow, ...]) -> Table:
    table = Table(
        title="moved entities, distance with / without grounding, normalised units; 95 % bootstrap over objects",
        box=box.SIMPLE_HEAD,
        caption=f"worse, better: share of well-seen frames that differ by more than {MARGIN}; n: objects/takes/tracks",
    )
    headings = ("objects", "L", "suite", "n", "APE on/off", "ratio", "visible on/off", "well-seen on/off")
    for heading in (*headings, "difference", "worse %", "better %", "well-seen is"):
        table.add_column(heading, justify="left" if heading in ("objects", "suite") else "right")
    for row in rows:
        pairs = [f"{shown(c.on).split()[0]}/{shown(c.off).split()[0]}" for c in (row.ape, row.visible, row.well_seen)]
        table.add_row(
            f"{row.source}, {row.part}, {row.protocol}",
            str(row.level),
            row.suite,
            f"{row.objects}/{row.takes}/{row.tracks}",
            pairs[0],
            shown(row.ape.ratio, decimals=2),
            pairs[1],
            pairs[2],
            shown(row.well_seen.difference, decimals=4),
            shown(row.worse, factor=100, decimals=1).split()[0],
            shown(row.better, factor=100, decimals=1).split()[0],
            row.verdict,
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Grounding).run())
