"""The sample clips that come with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from quest.data.frame_source import FrameSource, Reader, ReadOptions
from quest.errors import RecordingError

SAMPLES = ("sample", "sample-alarm")
"""In both a door and a drawer open. In the first their handles are occluded for a while; in the second the door's is
lost while it is occluded, which an alarm says, and found again."""


def sample_folder(name: str = "sample") -> Path:
    """Recording folder of a sample clip: a procedural cabinet, in colours and depth.

    Args:
        name: one of :data:`SAMPLES`.

    Raises:
        RecordingError: there is no such clip, or the installed package lacks it.
    """
    if name not in SAMPLES:
        raise RecordingError(f"sample clip {name!r}: expected one of {', '.join(SAMPLES)}")
    folder = Path(str(resources.files("quest") / "assets" / name))
    if not (folder / "camera.json").is_file():
        raise RecordingError(f"{folder}: the sample clip is missing from the installed package; install it again")
    return folder


def _open(where: str, options: ReadOptions) -> FrameSource:
    from quest.data.folder import open_folder

    return open_folder(str(sample_folder(where)), options)


def _accepts(where: str) -> bool:
    return where in SAMPLES and not Path(where).exists()


READERS = (Reader("a packaged clip", SAMPLES[0], _accepts, _open),)
