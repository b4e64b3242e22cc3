"""What becomes of hidden entities (suite occlusion), and how often identities switch among likes (suite lockers).

    quest eval --takes SUITES --trackers quest quest-ungrounded lk --out RUN.json
    python benchmarks/reappearance.py RUN.records.parquet --out benchmarks/results/grounding/reappearance.json

An episode is the first run of at least 20 frames in which a moved entity is hidden, after it was seen moving. It is
judged five frames after its entity is seen again. Protocol point.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from quest.evaluation.reappearance import AFTER_FRAMES, LEAST_HIDDEN, MOVING, ReappearanceRow, Share, reappearances
from quest.evaluation.report import gather, origins_json, provenance, shown, write_report
from quest.evaluation.summary import Row, summarise
from quest.evaluation.take_suite import TakeSuite


@dataclass(frozen=True)
class Reappearance:
    """Identities after occlusion and among look-alikes, with intervals."""

    records: tyro.conf.Positional[tuple[Path, ...]]
    """Files of records (.records.parquet)."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Judge, print, write."""
        records, origins = gather(self.records)
        hidden = reappearances(records, resamples=self.resamples, seed=self.seed)
        lockers = summarise(
            [r for r in records if TakeSuite.of(r.take).name == "lockers" and r.subject.protocol == "point"],
            resamples=self.resamples,
            seed=self.seed,
        )
        console = Console(width=230)
        console.print(_hidden_table(hidden))
        console.print(_lockers_table(lockers))
        if self.out is not None:
            report = provenance() | {
                "least_hidden": LEAST_HIDDEN,
                "after_frames": AFTER_FRAMES,
                "moving": MOVING,
                "resamples": self.resamples,
                "seed": self.seed,
                "origins": origins_json(origins),
                "occlusion": [asdict(row) for row in hidden],
                "lockers": [asdict(row) for row in lockers],
            }
            write_report(report, self.out)
        return 0


def _hidden_table(rows: tuple[ReappearanceRow, ...]) -> Table:
    table = Table(
        title=f"suite occlusion: moved entities hidden for {LEAST_HIDDEN} frames or more after they were seen moving",
        box=box.SIMPLE_HEAD,
        caption="shares in percent with exact 95 % intervals, distances with 95 % bootstrap over objects",
    )
    headings = ("objects", "beside", "tracker", "objects/takes", "hidden", "held before", "APE hidden")
    for heading in (*headings, "held again", "of those held before", "median then", "at the end"):
        table.add_column(heading, justify="left" if heading in ("objects", "beside", "tracker") else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.beside,
            row.tracker,
            f"{row.objects}/{row.takes}",
            f"{row.hidden_frames:.0f}",
            _share(row.held_before),
            shown(row.ape_hidden),
            _share(row.held_again),
            _share(row.held_again_if_before),
            shown(row.distance_again),
            shown(row.distance_end),
        )
    return table


def _lockers_table(rows: tuple[Row, ...]) -> Table:
    table = Table(title="suite lockers", box=box.SIMPLE_HEAD, caption="95 % bootstrap over objects")
    for heading in ("objects", "of", "tracker", "objects/takes/tracks", "switches per 1,000 frames", "Acc %"):
        table.add_column(heading, justify="left" if heading in ("objects", "of", "tracker") else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.reading,
            row.tracker,
            f"{row.objects}/{row.takes}/{row.tracks}",
            shown(row.metrics.switches, decimals=2),
            shown(row.metrics.acc, factor=100, decimals=1),
        )
    return table


def _share(share: Share | None) -> str:
    if share is None:
        return "-"
    return f"{100 * share.share:.0f} ({100 * share.low:.0f} to {100 * share.high:.0f}) of {share.trials}"


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Reappearance).run())
