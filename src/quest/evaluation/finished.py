"""What an evaluation has done, kept while it runs: it can be stopped and go on, or be shared by processes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from quest.errors import InputError
from quest.evaluation.records import PER_FRAME, Discovery, EntityRecord, Subject, Unscored
from quest.whole_file import whole_file


class KeptAnswers:
    """A folder of answers, one file each.

    Args:
        folder: made by the first answer.
        made_by: digest of what answers depend on beside their name: code, trackers, weights, data, questions.
    """

    def __init__(self, folder: Path, *, made_by: str) -> None:
        self.folder = folder
        self._made_by = made_by

    def find(self, name: str, of: str = "") -> dict[str, np.ndarray] | None:
        """Answers of a name; None where nothing is kept, or what was made by something else or of other data.

        Raises:
            InputError: the file is damaged.
        """
        path = self.folder / f"{name}.npz"
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as known:
                same = str(known["made_by"]) == self._made_by + of
                return {key: known[key] for key in known if key != "made_by"} if same else None
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise InputError(f"kept answers {path}: damaged ({error}); delete the file and run again") from error

    def keep(self, name: str, answers: Mapping[str, np.ndarray], of: str = "") -> None:
        """Write answers, whole or not at all."""
        with whole_file(self.folder / f"{name}.npz") as unfinished:
            np.savez(unfinished, made_by=np.array(self._made_by + of), **answers)  # type: ignore[arg-type]

    def get(self, name: str, make: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
        """Answers of a name, made where they are not kept."""
        known = self.find(name)
        if known is None:
            known = make()
            self.keep(name, known)
        return known

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


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


class FinishedTakes(KeptAnswers):
    """A folder with one file for each take that was evaluated."""

    def write(self, take: str, data_hash: str, outcome: TakeOutcome) -> None:
        """Keep a take; its file is written whole or not at all."""
        flat = [{f.name: getattr(r, f.name) for f in fields(r) if f.name not in PER_FRAME} for r in outcome.records]
        plain = vars(outcome) | {"records": flat}
        stacked = {n: np.array([getattr(r, n) for r in outcome.records], t) for n, t in PER_FRAME.items()}
        self.keep(take, {"plain": np.array(json.dumps(plain, default=asdict)), **stacked}, of=data_hash)

    def read(self, take: str, data_hash: str) -> TakeOutcome | None:
        """What was kept of a take; None where nothing was, or of other code, weights or data.

        Raises:
            InputError: the file is damaged.
        """
        known = self.find(take, of=data_hash)
        if known is None:
            return None
        plain = json.loads(str(known["plain"]))
        records = (
            EntityRecord(**flat | {"subject": Subject(**flat["subject"])}, **{n: known[n][i] for n in PER_FRAME})
            for i, flat in enumerate(plain["records"])
        )
        discoveries = map(Discovery.from_json, plain["discoveries"])
        return TakeOutcome(
            tuple(records), tuple(discoveries), tuple(Unscored(**u) for u in plain["unscored"]), plain["moving"]
        )
