"""Measurements of a tracker on takes beside ``quest eval``: what the scripts in ``benchmarks/`` share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.evaluation.report import provenance, rows_table, write_report
from quest.evaluation.selection import hash_of, select_in

R = TypeVar("R")


@dataclass(frozen=True)
class Study:
    """Take after take is judged; the result file is written anew after each, and says whether it is complete."""

    takes: tuple[str, ...]
    """Folders of take stores."""
    split: tuple[SplitPart, ...] = ("validation",)
    """Parts of the object split."""
    level: tuple[int, ...] = ()
    """Levels; all by default."""
    objects: tuple[str, ...] = ()
    """Object ids; all by default."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def measure(
        self,
        judge: Callable[[TakeStore, str, SplitPart], list[R]],
        rows_of: Callable[..., list[dict[str, Any]]],
        about: Mapping[str, Any],
        more: Callable[[list[R]], dict[str, Any]] = lambda records: {},
    ) -> int:
        """Judge all takes, print, write.

        Args:
            judge: makes records of a take: of its store, its name, and its object's part of the split.
            rows_of: makes the rows of the table of all records, with ``resamples`` and ``seed`` of the bootstrap.
            about: what the result file says beside them.
            more: what it says beside them of all records so far.

        Raises:
            ConfigError: no take is left, or two stores have one of the same name.
        """
        stores = list(map(TakeStore, self.takes))
        takes = select_in(stores, split=self.split, levels=self.level, objects=self.objects)
        chosen: list[tuple[TakeStore, str, SplitPart]] = [
            (store, name, part) for store, own in takes for name, part in own.items()
        ]
        report = provenance() | {"weights": self.weights} | dict(about) | {"data_hash": hash_of(takes)}
        report |= {"resamples": self.resamples, "seed": self.seed}
        console, records, rows = Console(highlight=False), list[R](), list[dict[str, Any]]()
        for i, (store, name, part) in enumerate(chosen, start=1):
            records += judge(store, name, part)
            rows = rows_of(records, resamples=self.resamples, seed=self.seed)
            console.print(f"{i}/{len(chosen)} {name}: {len(records)} records so far")
            if self.out is not None:
                done = {"takes_done": i, "complete": i == len(chosen), "rows": rows}
                write_report(report | done | more(records), self.out)
        console.print(rows_table(type(self).__name__, rows))
        return 0
