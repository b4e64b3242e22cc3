"""Reports made from records: what they are read from, what they carry beside their numbers, how they are written."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from quest.data.provenance import code_commit, file_hash, machine, package_versions
from quest.errors import InputError
from quest.evaluation.bootstrap import Value
from quest.evaluation.records import EntityRecord, read_records
from quest.evaluation.results import Run, read_results
from quest.whole_file import whole_file

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
    script = Path(sys.argv[0])
    return {
        "command": shlex.join(["python", f"{script.parent.name}/{script.name}", *sys.argv[1:]]),
        "commit": code_commit(),
        "machine": machine(),
        "versions": package_versions(),
        "stamp": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def device_name(device: torch.device) -> str:
    """What a network ran on, as people call it."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def write_report(report: dict[str, Any], path: Path) -> None:
    """Write a report as JSON, whole or not at all.

    Args:
        report: plain values and origins.
        path: the file; its folder is made.
    """
    with whole_file(path) as partial:
        partial.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def origins_json(origins: Sequence[Origin]) -> list[dict[str, Any]]:
    """Plain values of origins."""
    return [asdict(origin) for origin in origins]


def shown(value: Value | None, *, decimals: int = 3, factor: float = 1.0) -> str:
    """A number with its interval for a table in the terminal."""
    if value is None:
        return "-"
    text = f"{factor * value.mean:.{decimals}f}"
    if value.low is None or value.high is None:
        return text
    return f"{text} ({factor * value.low:.{decimals}f} to {factor * value.high:.{decimals}f})"
