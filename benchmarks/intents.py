"""Measure whether what opens a thing and what lifts it are told apart and followed, both asked for by the same label.

    quest generate --out TAKES --objects procedural:laptop-112000,...
    python benchmarks/intents.py --takes TAKES --split test --out benchmarks/results/intents/intents.json

Judged are views in which exactly one entity of a label opens and exactly one lifts, such as the rims of a laptop.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich import box
from rich.console import Console
from rich.table import Table

import quest
from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.intents import IntentAnswer, IntentRow, intent_rows, judge_intents
from quest.evaluation.report import provenance, shown, write_report
from quest.evaluation.selection import select_takes


@dataclass(frozen=True)
class Intents:
    """Shares of views in which both intents give distinct, stable tracks."""

    takes: tuple[str, ...]
    """Folders of take stores."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation",)
    """Parts of the object split."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    apart_px: float = 0.0
    """Begin each stream with the first frame in which both are seen this far apart; 0 begins with the take."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Track, print, write."""
        console, tracker = Console(width=150, highlight=False), quest.load(self.weights)
        answers: list[IntentAnswer] = []
        hashes: list[tuple[str, str]] = []
        for store in map(TakeStore, self.takes):
            for name, part in select_takes(store.infos(), split=self.split).items():
                if name in {known for known, _ in hashes}:
                    raise ConfigError(f"--takes: expected different names in all stores, {name!r} comes twice")
                take, before = store.read(name), len(answers)
                for view in range(len(take.views)):
                    answers += judge_intents(tracker, take, view, part=part, apart_px=self.apart_px)
                if len(answers) > before:
                    hashes.append((name, store.data_hash(name)))
                    console.print(f"{name}: {len(answers)} views so far")
        rows = intent_rows(answers, resamples=self.resamples, seed=self.seed)
        if self.out is not None:
            about = {"weights": self.weights, "weights_hash": tracker.weights_hash, "data_hash": combined_hash(hashes)}
            about |= {
                "apart_px": self.apart_px,
                "resamples": self.resamples,
                "seed": self.seed,
                "rows": [asdict(row) for row in rows],
            }
            write_report(provenance() | about | {"answers": [asdict(a) for a in answers]}, self.out)
        console.print(_table(rows))
        return 0


def _table(rows: tuple[IntentRow, ...]) -> Table:
    table = Table(title="open and lift", box=box.SIMPLE_HEAD, caption="95 % bootstrap over objects; APE: 3D distance")
    for heading in (
        "objects",
        "objects/takes/views",
        "both stable %",
        "both on their link %",
        "APE open",
        "APE lift",
        "Acc open %",
        "Acc lift %",
        "bound open",
        "bound lift",
    ):
        table.add_column(heading)
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            f"{row.objects}/{row.takes}/{row.views}",
            shown(row.both, decimals=0, factor=100),
            shown(row.kept, decimals=0, factor=100),
            shown(row.open_ape),
            shown(row.lift_ape),
            shown(row.open_acc, decimals=0, factor=100),
            shown(row.lift_acc, decimals=0, factor=100),
            shown(row.open_bound),
            shown(row.lift_bound),
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Intents).run())
