"""The sample clip that comes with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from quest.data.frame_source import FrameSource, Reader, ReadOptions
from quest.errors import RecordingError

SAMPLE = "sample"


def sample_folder() -> Path:
    """Recording folder of the sample: a procedural cabinet whose doors and drawers open one after the other.

    Raises:
        RecordingError: the installed package lacks it.
    """
    folder = Path(str(resources.files("quest") / "assets" / SAMPLE))
    if not (folder / "camera.json").is_file():
        raise RecordingError(f"{folder}: the sample clip is missing from the installed package; install it again")
    return folder


def _open(where: str, options: ReadOptions) -> FrameSource:
    from quest.data.folder import READER as FOLDER

    return FOLDER.open(str(sample_folder()), options)


READER = Reader("the packaged clip", SAMPLE, lambda where: where == SAMPLE and not Path(where).exists(), _open)
