"""A finished evaluation: its rows, what made them, and the file that keeps both."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quest.data.provenance import command_line, file_hash
from quest.errors import InputError
from quest.evaluation.bootstrap import Value
from quest.evaluation.records import Discovery, EntityRecord, Unscored, write_records
from quest.evaluation.report import provenance, write_report
from quest.evaluation.summary import Metrics, Row
from quest.untrusted import read_json, reading
from quest.whole_file import whole_file

FORMAT = 1
"""Version of the result file."""


@dataclass(frozen=True)
class Run:
    """What made the numbers."""

    command: str
    commit: str
    """Commit of the checkout, with ``+dirty`` where files differ from it; the version where there is none."""
    data_hash: str
    """Over the hashes of all takes that were evaluated."""
    weights: str | None
    """What was loaded for the tracker ``quest``; None if it did not take part."""
    weights_hash: str | None
    """SHA-256 of the weights file, where it is known."""
    resamples: int
    seed: int
    machine: str
    """Operating system, processor and cores."""
    versions: dict[str, str]
    stamp: str
    """Date and time of the end, UTC."""
    seconds: float

    @classmethod
    def ended(cls, start_s: float, **about: Any) -> Run:
        """The run of this process, which began at a reading of the monotonic clock and ends now.

        ``about`` has the hash of the data, weights and their hash, and resamples and seed of the bootstrap.
        """
        seconds = round(time.monotonic() - start_s, 1)
        return cls(**provenance() | about | {"command": command_line(), "seconds": seconds})


@dataclass(frozen=True)
class Results:
    """Rows and what they rest on."""

    run: Run
    rows: tuple[Row, ...]
    discoveries: tuple[Discovery, ...] = ()
    """Answers and matches per view, in the semantic protocol."""
    unscored: tuple[Unscored, ...] = ()
    notes: tuple[str, ...] = ()
    """What a reader must know, in words."""


def records_path(path: str | Path) -> Path:
    """Where the records of a result file are: ``results.json`` has ``results.records.parquet`` beside it."""
    path = Path(path)
    return path.with_name(f"{path.stem}.records.parquet")


def write_results(results: Results, path: str | Path, *, records: tuple[EntityRecord, ...] = ()) -> None:
    """Write the result file, and the records beside it; each is written whole or not at all.

    The name ends in ``.json``; nothing is written beside without records.

    Raises:
        InputError: the name does not end in ``.json``.
    """
    path = Path(path)
    if path.suffix != ".json":
        raise InputError(f"results {path}: expected a file name that ends in .json; the records go beside it")
    beside, about = records_path(path), {"records": None, "records_hash": None}
    if records:
        with whole_file(beside) as partial:
            write_records(records, partial)
        about = {"records": beside.name, "records_hash": file_hash(beside)}
    else:
        beside.unlink(missing_ok=True)  # of an earlier run
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
            rows=tuple(Row(**row | {"metrics": _metrics(row["metrics"])}) for row in raw["rows"]),
            discoveries=tuple(map(Discovery.from_json, raw["discoveries"])),
            unscored=tuple(Unscored(**u) for u in raw["unscored"]),
            notes=tuple(raw["notes"]),
        )


def _metrics(raw: dict[str, Any]) -> Metrics:
    return Metrics(**{name: None if value is None else Value(**value) for name, value in raw.items()})
