"""The file of calibrations: one for streams with depth, one for colours alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Final, Literal, get_args

from quest.errors import WeightsError
from quest.monitor.calibration import Calibration
from quest.untrusted import read_json, reading
from quest.whole_file import whole_file

Inputs = Literal["depth", "colours"]
"""What the frames of a stream bring: colours with depth, or colours alone."""

_PACKAGED: Final = ("assets", "monitor.json")


def read_calibrations(path: Path | None = None) -> dict[Inputs, Calibration]:
    """Read the calibrations of a file.

    Args:
        path: a file of `quest calibrate`; None for the one that comes with the package.

    Returns:
        By what the frames bring; empty if none comes with the package.

    Raises:
        WeightsError: there is no such file, or it is damaged.
    """
    file = resources.files("quest").joinpath(*_PACKAGED) if path is None else path
    if path is None and not file.is_file():
        return {}
    remedy = "make it with `quest calibrate`"
    with reading(f"monitor {file}", WeightsError, remedy):
        raw = json.loads(file.read_text(encoding="utf-8")) if path is None else read_json(path, WeightsError, remedy)
    if not isinstance(raw, dict) or not raw or not raw.keys() <= set(get_args(Inputs)):
        known = " or ".join(get_args(Inputs))
        raise WeightsError(f"monitor {file}: expected calibrations for {known}; make it with `quest calibrate`")
    try:
        return {inputs: Calibration.from_json(json.dumps(value)) for inputs, value in raw.items()}
    except WeightsError as error:
        raise WeightsError(f"{file}: {error}") from error


def write_calibrations(path: Path, calibrations: Mapping[Inputs, Calibration]) -> None:
    """Write calibrations to a file, whole or not at all.

    Args:
        path: the file.
        calibrations: by what the frames bring, at least one.
    """
    raw = {inputs: json.loads(calibration.to_json()) for inputs, calibration in calibrations.items()}
    with whole_file(path) as partial:
        partial.write_text(json.dumps(raw, separators=(",", ":")) + "\n", encoding="utf-8")
