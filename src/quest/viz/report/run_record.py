"""``run.json``: how a run of ``quest track`` was made."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from quest.errors import InputError
from quest.types import Camera, Query
from quest.untrusted import build, read_json, reading
from quest.whole_file import whole_file

FILE = "run.json"
VERSION = 1
_REMEDY = "track again, or delete it: the report then does without"


@dataclass(frozen=True)
class Recorded:
    """The recording that was tracked."""

    given: str
    """As it was given on the command line."""
    view: int
    """Which view of it, where it is a take."""
    name: str
    """Its name."""
    frames: int
    """How many were tracked."""
    camera: Camera
    """Intrinsics of every frame."""
    has_depth: bool
    """Whether it brought any depth."""
    notes: tuple[str, ...]
    """Its degradations in words."""


@dataclass(frozen=True)
class RunRecord:
    """How a run was made."""

    quest: str
    """Version of quest."""
    date: str
    """When tracking ended, ISO 8601 with the offset of its time zone."""
    command: str
    """The command that does it again, in a shell's words."""
    recording: Recorded
    """What was tracked."""
    weights: str
    """Name or file of the weights."""
    weights_hash: str | None
    """SHA-256 of their file."""
    alpha: float
    """Of the monitor."""
    alpha_frames: int | None
    """Frames that alpha is for; None for the whole recording."""
    device: str
    """Where the networks ran."""
    queries: tuple[Query, ...] | None
    """As asked; None where entities were discovered."""
    overlay: bool
    """Whether the run drew ``overlay.mp4``."""
    took_s: float
    """Seconds that tracking took, without reading and drawing."""


def write_run(run: RunRecord, folder: Path) -> None:
    """Write ``run.json`` into a folder, whole or not at all."""
    with whole_file(folder / FILE) as partial:
        partial.write_text(json.dumps({"version": VERSION, **asdict(run)}, allow_nan=False, indent=1) + "\n")


def read_run(folder: Path) -> RunRecord | None:
    """The record in a folder; None where it has none.

    Raises:
        InputError: it is damaged or of another format version.
    """
    path = folder / FILE
    if not path.exists():
        return None
    value = read_json(path, InputError, _REMEDY)
    with reading(path, InputError, _REMEDY):
        value = build(dict, value, "run")
        version = value.pop("version", None)
        if version != VERSION:
            raise ValueError(f"format version {version!r}, expected {VERSION}")
        return build(RunRecord, value, "run")
