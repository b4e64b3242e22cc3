"""Reports made from records: what they are read from, what they carry beside their numbers, how they are written."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from quest.data.provenance import code_commit, file_hash, machine, package_versions
from quest.errors import InputError
from quest.evaluation.records import EntityRecord, read_records
from quest.evaluation.results import Run, read_results
from quest.evaluation.results import write_report as write_report

RECORDS_SUFFIX = ".records.parquet"


@dataclass(frozen=True)
class Origin:
    """A file of records that a report is made from."""

    records: str
    """Name of the file."""
    sha256: str | None
    """Of the file."""
    run: Run | None
    """What made the records, out of the result file beside them; None where there is none."""


def gather(paths: Sequence[Path]) -> tuple[tuple[EntityRecord, ...], tuple[Origin, ...]]:
    """Records of several files, and where they come from.

    Args:
        paths: files that `quest eval --out` wrote.

    Raises:
        InputError: a file is missing or of another format, or an answer is in them twice.
    """
    records = [record for path in paths for record in read_records(path)]
    known: set[tuple] = set()
    for record in records:
        s = record.subject
        key = (s.tracker, s.protocol, record.take, record.view, record.entity)
        if key in known:
            raise InputError(
                f"records: expected each answer once, got tracker {s.tracker!r} in take {record.take!r}, view "
                f"{record.view}, entity {record.name!r} twice ({s.protocol}); leave one of the files out"
            )
        known.add(key)
    return tuple(records), tuple(_origin(path) for path in paths)


def _origin(path: Path) -> Origin:
    beside = path.with_name(f"{path.name.removesuffix(RECORDS_SUFFIX)}.json")
    if not beside.is_file():
        return Origin(path.name, file_hash(path), None)
    run, own = read_results(beside).run, file_hash(path)
    if json.loads(beside.read_text(encoding="utf-8")).get("records_hash", own) != own:
        raise InputError(f"records {path}: they are not those of {beside.name}; run `quest eval` again")
    return Origin(path.name, own, run)


def provenance() -> dict[str, Any]:
    """What a report must carry to be made again: command, commit, machine, versions and time."""
    script, spec = Path(sys.argv[0]), sys.modules["__main__"].__spec__
    program = [f"{script.parent.name}/{script.name}"] if spec is None else ["-m", spec.name]
    return {
        "command": shlex.join(["python", *program, *sys.argv[1:]]),
        "commit": code_commit(),
        "machine": machine(),
        "versions": package_versions(),
        "stamp": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def device_name(device: torch.device) -> str:
    """What a network ran on, as people call it."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def shown(value: Any, *, decimals: int = 3, factor: float = 1.0, none: str = "-") -> str:
    """A number, with its interval if it has one, or a word for a table in the terminal."""
    if value is None or isinstance(value, bool | int | str):
        return none if value is None else str(value)
    if isinstance(value, float):
        return f"{factor * value:.{decimals}f}"
    middle, low, high = value.share if hasattr(value, "share") else value.mean, value.low, value.high
    if low is None and high is None:
        return f"{factor * middle:.{decimals}f}"
    ends = ["∞" if end is None else f"{factor * end:.{decimals}f}" for end in (low, high)]
    return f"{factor * middle:.{decimals}f} ({(' to ' if '-' in ends[0] else '–').join(ends)})"


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
