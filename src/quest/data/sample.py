"""The sample clip that comes with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from quest.errors import RecordingError


def sample_folder() -> Path:
    """Recording folder of the sample: a procedural cabinet whose doors and drawers open one after the other.

    Raises:
        RecordingError: the installed package lacks it.
    """
    folder = Path(str(resources.files("quest") / "assets" / "sample"))
    if not (folder / "camera.json").is_file():
        raise RecordingError(f"{folder}: the sample clip is missing from the installed package; install it again")
    return folder
