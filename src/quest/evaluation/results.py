"""A finished evaluation: its rows, what made them, and the file that keeps both."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from quest.data.provenance import code_commit, command_line, file_hash, machine, package_versions
from quest.errors import InputError
from quest.evaluation.bootstrap import Value
from quest.evaluation.records import Discovery, EntityRecord, Unscored, write_records
from quest.evaluation.summary import Metrics, Row
from quest.untrusted import read_json, reading
from quest.whole_file import whole_file

FORMAT = 1
"""Version of the result file."""
_OF_RECORDS = ("records", "records_hash")


@dataclass(frozen=True)
class Run:
    """What made the numbers."""

    command: str
    """The command line."""
    commit: str
    """Commit of the checkout, with ``+dirty`` where files differ from it; the version where there is none."""
    data_hash: str
    """Over the hashes of all takes that were evaluated."""
    weights: str | None
    """What was loaded for the tracker ``quest``; None if it did not take part."""
    weights_hash: str | None
    """SHA-256 of the weights file, where it is known."""
    resamples: int
    """Of the bootstrap over objects."""
    seed: int
    """Of the bootstrap."""
    machine: str
    """Operating system, processor and cores."""
    versions: dict[str, str]
    """Of Python and the packages that compute."""
    stamp: str
    """Date and time of the end, UTC."""
    seconds: float
    """Duration."""

    @classmethod
    def ended(
        cls, start_s: float, *, data_hash: str, weights: str | None, weights_hash: str | None, resamples: int, seed: int
    ) -> Run:
        """The run of this process, which began at a reading of the monotonic clock and ends now."""
        return cls(
            command=command_line(),
            commit=code_commit(),
            data_hash=data_hash,
            weights=weights,
            weights_hash=weights_hash,
            resamples=resamples,
            seed=seed,
            machine=machine(),
            versions=package_versions(),
            stamp=datetime.now(UTC).isoformat(timespec="seconds"),
            seconds=round(time.monotonic() - start_s, 1),
        )


@dataclass(frozen=True)
class Results:
    """Rows and what they rest on."""

    run: Run
    """What made them."""
    rows: tuple[Row, ...]
    """The table."""
    discoveries: tuple[Discovery, ...] = ()
    """Answers and matches per view, in the semantic protocol."""
    unscored: tuple[Unscored, ...] = ()
    """Entities that were not scored."""
    notes: tuple[str, ...] = ()
    """What a reader must know, in words."""


def records_path(path: str | Path) -> Path:
    """Where the records of a result file are: ``results.json`` has ``results.records.parquet`` beside it."""
    path = Path(path)
    return path.with_name(f"{path.stem}.records.parquet")


def write_report(report: Mapping[str, Any], path: Path) -> None:
    """Write a report as JSON, whole or not at all.

    Args:
        report: plain values and dataclasses of such.
        path: the file; its folder is made.
    """
    text = json.dumps(report, indent=1, allow_nan=False, default=asdict)
    with whole_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())


def write_results(results: Results, path: str | Path, *, records: tuple[EntityRecord, ...] = ()) -> None:
    """Write the result file, and the records beside it; each is written whole or not at all.

    Args:
        results: what to write.
        path: a file ending in ``.json``.
        records: what the rows were computed from; nothing is written beside where empty.

    Raises:
        InputError: the name does not end in ``.json``.
    """
    path = Path(path)
    if path.suffix != ".json":
        raise InputError(f"results {path}: expected a file name that ends in .json; the records go beside it")
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = records_path(path)
    if records:
        write_records(records, beside)
    else:
        beside.unlink(missing_ok=True)  # of an earlier run
    about = {"records": beside.name, "records_hash": file_hash(beside)} if records else dict.fromkeys(_OF_RECORDS)
    write_report({"format": FORMAT} | about | vars(results), path)


def read_results(path: str | Path) -> Results:
    """Read a result file back, equal to what was written.

    Raises:
        InputError: the file is missing, damaged, or of another format version.
    """
    remedy = "expected a file written by `quest eval --out`"
    raw = read_json(Path(path), InputError, remedy)
    with reading(f"results {path}", InputError, remedy):
        if raw["format"] != FORMAT:
            raise InputError(f"results {path}: expected format {FORMAT}, got {raw['format']}; run `quest eval` again")
        return Results(
            run=Run(**raw["run"]),
            rows=tuple(_row(row) for row in raw["rows"]),
            discoveries=tuple(map(Discovery.from_json, raw["discoveries"])),
            unscored=tuple(Unscored(**u) for u in raw["unscored"]),
            notes=tuple(raw["notes"]),
        )


def _row(raw: dict[str, Any]) -> Row:
    values = raw["metrics"]
    metrics = {name: None if value is None else Value(**value) for name, value in values.items()}
    return Row(**{**raw, "metrics": Metrics(**metrics)})
