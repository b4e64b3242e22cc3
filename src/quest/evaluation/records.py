"""What an evaluation keeps: one record per tracker, take, view and entity, with its distance in every frame.

Every number in a table can be computed again from these; they are stored as Parquet beside the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float32, Int16

from quest.errors import InputError


@dataclass(frozen=True)
class Subject:
    """What a table row is about: records with equal subjects but for the object belong to one row."""

    tracker: str
    protocol: str
    """``point`` or ``semantic``."""
    part: str
    """``train``, ``validation``, ``test``, or ``unlisted`` where the split does not know the object."""
    source: str
    """As of :class:`quest.types.TakeInfo`."""
    level: int
    """How many joints move one after the other."""
    object_id: str


@dataclass(frozen=True)
class EntityRecord:
    """How one tracker answered for one entity in one view of one take."""

    subject: Subject
    take: str
    view: int
    entity: int
    """Index of the entity in the take."""
    name: str
    label: str
    moved: bool
    """Whether it is at some time more than 0.1 from rest."""
    found: bool
    """Whether an answer was given to it at all (always so in the point protocol)."""
    first_frame: int
    """Frames before it are not scored."""
    distance: Float32[np.ndarray, " T"]
    """Normalised units; 1 where the prediction is missing."""
    distance_px: Float32[np.ndarray, " T"]
    """Pixels of the letterboxed input; NaN where the entity has no true pixel."""
    follows: Int16[np.ndarray, " T"]
    """Index of the entity that the prediction follows, -1 for none."""
    visible: Bool[np.ndarray, " T"]
    """Whether the entity is seen."""

    @property
    def counted(self) -> Bool[np.ndarray, " T"]:
        """Which frames are scored."""
        return np.arange(len(self.distance)) >= self.first_frame


@dataclass(frozen=True)
class Discovery:
    """How many answers a tracker gave unasked in one view, and how many of them were entities."""

    subject: Subject
    take: str
    view: int
    slots: int
    """Answers."""
    matched: int
    """Answers that were assigned to an entity."""
    placed: int | None = None
    """Answers that are assigned to an entity if labels do not count; None in files from before there was this."""
    entities: int | None = None
    """That could be discovered; None there too."""

    @classmethod
    def from_json(cls, raw: dict[str, Any]) -> Discovery:
        """Out of plain values."""
        return cls(**{**raw, "subject": Subject(**raw["subject"])})


@dataclass(frozen=True)
class Unscored:
    """An entity that is not scored in a view, because it is not visible in frames 0 to 7."""

    take: str
    view: int
    name: str
    label: str


@dataclass(frozen=True)
class TakeOutcome:
    """How all trackers answered in all views of one take."""

    records: tuple[EntityRecord, ...]
    """Per tracker, protocol, view and scored entity."""
    discoveries: tuple[Discovery, ...]
    """Per tracker and view of the semantic protocol."""
    unscored: tuple[Unscored, ...]
    moving: bool
    """Whether the take already moves in frames 0 to 7, against the protocol."""


PER_FRAME = {"distance": np.float32, "distance_px": np.float32, "follows": np.int16, "visible": np.bool_}
"""Fields of a record that have a value in every frame, and their types."""
_OF_SUBJECT = tuple(f.name for f in fields(Subject))


def write_records(records: Sequence[EntityRecord], file: Path | BytesIO) -> None:
    """Write records as Parquet, one row each with lists over frames."""
    own = [f.name for f in fields(EntityRecord)[1:]]
    columns = {name: pa.array([getattr(r.subject, name) for r in records]) for name in _OF_SUBJECT}
    for name in own:
        kind = pa.list_(pa.from_numpy_dtype(PER_FRAME[name])) if name in PER_FRAME else None
        columns[name] = pa.array([getattr(r, name) for r in records], type=kind)
    pq.write_table(pa.table(columns), file, compression="zstd")


def read_records(path: str | Path | BytesIO) -> tuple[EntityRecord, ...]:
    """Read what :func:`write_records` wrote.

    Raises:
        InputError: the file is missing or is no such file.
    """
    records = []
    try:
        for row in pq.read_table(path).to_pylist():
            subject = Subject(**{name: row.pop(name) for name in _OF_SUBJECT})
            per_frame: dict[str, Any] = {name: np.array(row.pop(name), kind) for name, kind in PER_FRAME.items()}
            records.append(EntityRecord(subject=subject, **row, **per_frame))
    except (OSError, pa.ArrowInvalid, KeyError, TypeError) as error:
        raise InputError(f"records {path}: expected a Parquet file written by `quest eval --out` ({error})") from error
    return tuple(records)
