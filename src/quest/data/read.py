"""The one door to what can be tracked: recordings of any kind, views of simulated takes, and the packaged sample."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from quest.data.frame_source import FrameSource, Parts, source_of_clip
from quest.data.recording import open_recording, refuse_parts
from quest.data.sample import sample_folder
from quest.data.store import open_clip
from quest.errors import RecordingError
from quest.types import Camera, Clip

SAMPLE = "sample"
"""Name of the clip that comes with the package."""


def open_source(
    path: str | Path,
    *,
    view: int = 0,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
    parts: Parts | None = None,
) -> FrameSource:
    """Open what can be tracked; its frames are read when they are asked for.

    Args:
        path: a recording (see :func:`~quest.data.recording.open_recording`: a folder, a video, a bag, an MCAP file, a
            LeRobot dataset), a take (``STORE/NAME.zarr``), or the word ``sample`` for the clip that comes with the
            package.
        view: which camera of a take.
        depth: folder of depth images of a recording folder or a video.
        camera: camera file of a recording, or the intrinsics.
        depth_scale_m: metres per unit of a recording's depth images.
        parts: what to read of a dataset or a bag.

    Raises:
        RecordingError: there is no such recording, or it is not as expected, or an argument is not for its kind.
        TakeError: there is no such take or view, or the take is torn.
        MissingExtraError: bags need the extra ``ros``.
    """
    if str(path).rstrip("/\\").endswith(".zarr"):
        if (depth, camera, depth_scale_m) != (None, None, None):
            raise RecordingError(f"take {path}: it has depth and a camera of its own; leave those options out")
        refuse_parts(f"take {path}", Parts() if parts is None else parts, allowed=())
        return source_of_clip(open_clip(path, view=view))
    if view != 0:
        raise RecordingError(f"recording {path}: view {view} is for takes (STORE/NAME.zarr); leave it out")
    where = sample_folder() if str(path) == SAMPLE else path
    return open_recording(where, depth=depth, camera=camera, depth_scale_m=depth_scale_m, parts=parts)


def read(
    path: str | Path,
    *,
    view: int = 0,
    depth: str | Path | None = None,
    camera: str | Path | Camera | None = None,
    depth_scale_m: float | int | None = None,
    parts: Parts | None = None,
) -> Clip:
    """All frames of a recording, of a view of a take, or of the packaged ``sample``, in memory.

    Arguments and errors are those of :func:`open_source`; what is less than it could be is in the clip's ``notes``.
    """
    source = open_source(path, view=view, depth=depth, camera=camera, depth_scale_m=depth_scale_m, parts=parts)
    clip = source.clip()
    return replace(clip, notes=source.flags)
