"""What an evaluation has done, kept while it runs: it can be stopped and go on, or be shared by processes."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from quest.errors import InputError
from quest.evaluation.records import Discovery, TakeOutcome, Unscored, read_records, write_records
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


class FinishedTakes(KeptAnswers):
    """A folder with one file for each take that was evaluated."""

    def write(self, take: str, data_hash: str, outcome: TakeOutcome) -> None:
        """Keep a take; its file is written whole or not at all."""
        table = io.BytesIO()
        write_records(outcome.records, table)
        plain = json.dumps(vars(outcome) | {"records": ()}, default=asdict)
        records = np.frombuffer(table.getvalue(), np.uint8)
        self.keep(take, {"plain": np.array(plain), "records": records}, of=data_hash)

    def read(self, take: str, data_hash: str) -> TakeOutcome | None:
        """What was kept of a take; None where nothing was, or of other code, weights or data.

        Raises:
            InputError: the file is damaged.
        """
        known = self.find(take, of=data_hash)
        if known is None:
            return None
        plain = json.loads(str(known["plain"]))
        return TakeOutcome(
            read_records(io.BytesIO(known["records"].tobytes())),
            tuple(map(Discovery.from_json, plain["discoveries"])),
            tuple(Unscored(**u) for u in plain["unscored"]),
            plain["moving"],
        )
