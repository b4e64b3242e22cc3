"""Measurements of a tracker on takes beside ``quest eval``: what studies share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.report import provenance, write_report
from quest.evaluation.selection import Chosen, hash_of, select_takes
from quest.evaluation.tables import shown

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
        takes = select_in(list(map(TakeStore, self.takes)), split=self.split, levels=self.level, objects=self.objects)
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


def select_in(stores: Sequence[TakeStore], **choice: Any) -> Chosen:
    """:func:`select_takes` of several stores together; stores of which no take is left are omitted.

    Raises:
        ConfigError: as there, or two stores have a take of one name.
    """
    infos = [store.infos() for store in stores]
    names = [name for own in infos for name in own]
    if twice := sorted(name for name in set(names) if names.count(name) > 1):
        raise ConfigError(f"takes: expected different names in all stores, {twice[0]!r} comes twice; omit one of them")
    parts = select_takes({name: info for own in infos for name, info in own.items()}, **choice)
    found: list[tuple[TakeStore, dict[str, SplitPart]]] = [
        (store, {name: parts[name] for name in own if name in parts}) for store, own in zip(stores, infos, strict=True)
    ]
    return [each for each in found if each[1]]


def rows_table(title: str, rows: Sequence[Mapping[str, Any]]) -> RenderableType:
    """The rows of a report as they are in its file; what all of them share stands in the title."""
    flat = [
        {
            f"{key} {inner}".strip(): value
            for key, item in row.items()
            for inner, value in (item.items() if isinstance(item, Mapping) else [("", item)])
            if not isinstance(value, list | tuple)
        }
        for row in rows
    ]
    columns = {key: [shown(row.get(key)) for row in flat] for key in dict.fromkeys(key for row in flat for key in row)}
    shared = {key: cells[0] for key, cells in columns.items() if len(flat) > 1 and len(set(cells)) == 1}
    about = ", ".join(f"{key.replace('_', ' ')} {cell}" for key, cell in shared.items() if cell != "-")
    table = Table(box=box.SIMPLE_HEAD)
    kept = {key: cells for key, cells in columns.items() if key not in shared}
    for key in kept:
        table.add_column(key.replace("_", " "), overflow="fold")
    for cells in zip(*kept.values(), strict=True):
        table.add_row(*cells)
    return Group(Text(f"{title}: {about}" if about else title), table)
