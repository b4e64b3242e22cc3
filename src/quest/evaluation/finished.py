"""Takes that an evaluation has done, kept while it runs: it can be stopped and go on, or be shared by processes."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

from quest.errors import InputError
from quest.evaluation.records import (
    Discovery,
    EntityRecord,
    Unscored,
    discovery_from_json,
    discovery_to_json,
    read_described,
    write_records,
)


@dataclass(frozen=True)
class TakeOutcome:
    """How all trackers answered in all views of one take."""

    records: tuple[EntityRecord, ...]
    """Per tracker, protocol, view and scored entity."""
    discoveries: tuple[Discovery, ...]
    """Per tracker and view of the semantic protocol."""
    unscored: tuple[Unscored, ...]
    """Entities not scored, per view."""
    moving: bool
    """Whether the take already moves in frames 0 to 7, against the protocol."""


class FinishedTakes:
    """A folder with one file for each take that was evaluated.

    Args:
        folder: made by the first :meth:`write`.
        made_by: digest of what the answers depend on beside the take: code, trackers, weights, protocols.
    """

    def __init__(self, folder: Path, *, made_by: str) -> None:
        self.folder = folder
        self._made_by = made_by

    def write(self, take: str, data_hash: str, outcome: TakeOutcome) -> None:
        """Keep a take; its file is written whole or not at all."""
        rest = {
            "discoveries": [discovery_to_json(d) for d in outcome.discoveries],
            "unscored": [asdict(u) for u in outcome.unscored],
            "moving": outcome.moving,
        }
        about = {"made_by": self._made_by, "take_hash": data_hash, "outcome": json.dumps(rest)}
        self.folder.mkdir(parents=True, exist_ok=True)
        write_records(outcome.records, self._path(take), about=about)

    def read(self, take: str, data_hash: str) -> TakeOutcome | None:
        """What was kept of a take; None where nothing was, or of other code, weights or data.

        Raises:
            InputError: the file is damaged.
        """
        path = self._path(take)
        if not path.exists():
            return None
        records, about = read_described(path)
        try:
            if about["made_by"] != self._made_by or about["take_hash"] != data_hash:
                return None
            rest = json.loads(about["outcome"])
            return TakeOutcome(
                records,
                tuple(discovery_from_json(d) for d in rest["discoveries"]),
                tuple(Unscored(**u) for u in rest["unscored"]),
                rest["moving"],
            )
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"finished take {path}: damaged ({error}); delete it and run again") from error

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, take: str) -> Path:
        return self.folder / f"{take}.parquet"
