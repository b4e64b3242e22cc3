"""Recordings as folders, in any known layout, or as videos: read frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from quest.data.camera_file import CameraFile, find_setup
from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions
from quest.data.layouts import Layout, find_layout, is_layout, list_depth
from quest.data.pictures import read_depth_file
from quest.data.registration import Rig
from quest.depth import metres
from quest.errors import RecordingError
from quest.types import Frame


def _accepts(where: str) -> bool:
    path = Path(where)
    return path.is_file() if not path.is_dir() else is_layout(path)


def open_folder(where: str, options: ReadOptions) -> FrameSource:
    """A recording folder or a video."""
    source, notes = Path(where), Notes()
    layout = find_layout(source)
    if options.depth is not None:
        layout = replace(layout, depth_folder=options.depth, depths=list_depth(options.depth), paired=False)
    colours, depths = layout.colours, layout.depths
    setup = find_setup(where, options, layout.setup, size=colours.size, depth=depths is not None, notes=notes)
    for note in layout.notes:
        notes.say(note)
    if colours.size != (setup.camera.width, setup.camera.height):
        raise RecordingError(
            f"recording {source}: frames are {colours.size[0]} x {colours.size[1]} but the camera is for "
            f"{setup.camera.width} x {setup.camera.height}; give the intrinsics of these frames in the camera file"
        )
    exact = layout.numbered and not colours.video
    if exact:
        _check_counts(source, setup, layout, len(colours.paths), partners=True)
    elif depths is not None and not depths:
        raise _unequal(layout.depth_folder, 0, colours.number or 0)
    first = next((path for path in depths or () if path is not None), None)
    unit_m = setup.unit_m
    if first is not None and read_depth_file(first).dtype.kind == "f":
        unit_m = options.depth_scale_m or 1.0  # floats are metres, unless the user says otherwise
    return FrameSource(
        source.stem if source.is_file() else source.resolve().name,
        setup.camera,
        lambda: _frames(source, setup, layout, unit_m, notes),
        length=colours.number,
        exact=exact,
        notes=notes,
        units=(str(layout.depth_folder), unit_m),
    )


_FORM = "images, or rgb/ with images or a video such as rgb.mp4; .mp4 and the like"
READERS = (Reader("a folder or video", _FORM, _accepts, open_folder, ("depth", "camera", "depth_scale_m", "fov_deg")),)


def _frames(source: Path, setup: CameraFile, layout: Layout, unit_m: float, notes: Notes) -> Iterator[Frame]:
    number, first_s, depths = 0, 0.0, layout.depths
    known = [length for _, length in setup.lengths] + ([] if depths is None else [len(depths)])
    for t, (rgb, time_s) in enumerate(layout.colours.pictures(paired=depths is not None)):
        number, first_s = t + 1, time_s if t == 0 else first_s
        if known and t >= min(known):
            continue  # only counted, so that the message can say how many there are
        depth_m = None
        if depths is not None and (path := depths[t]) is not None:
            depth_m = setup.depth(_read_depth(path, setup, unit_m))
        elif depths is not None:
            notes.count("no depth", t)
        yield Frame(setup.rgb(rgb), depth_m, setup.stamp(t, fallback_s=time_s - first_s), setup.pose(t))
    if layout.numbered:
        _check_counts(source, setup, layout, number)
    elif any(length != number for length in known):
        least, most = min(*known, number), max(*known, number)
        notes.say(
            f"of some things there are {least}, of others {most} (pictures: {number}); the first {least} are read"
        )


def _check_counts(source: Path, setup: CameraFile, layout: Layout, frames: int, *, partners: bool = False) -> None:
    """Raise RecordingError unless whatever goes by frames is for as many as there are colours."""
    for what, number in setup.lengths:
        if number != frames:
            raise RecordingError(f"recording {source}: {what} of the camera is for {number} frames, expected {frames}")
    if layout.depths is None:
        return
    if partners and not layout.paired:
        # Where depth images are named as colours are, each must have its own; where none is, they go in order.
        depth_of = {path.stem for path in layout.depths if path is not None}
        colour_of = {path.stem for path in layout.colours.paths}
        alone = sorted(depth_of ^ colour_of)
        if alone and depth_of & colour_of:
            raise RecordingError(
                f"depth {layout.depth_folder}: {len(layout.depths)} depth images for {frames} colour frames, and "
                f"{alone[0]} has no {'colours' if alone[0] in depth_of else 'depth'}; expected one for each, drop "
                "frames without a partner"
            )
    if len(layout.depths) != frames:
        raise _unequal(layout.depth_folder, len(layout.depths), frames)


def _unequal(folder: Path, depths: int, frames: int) -> RecordingError:
    return RecordingError(
        f"depth {folder}: {depths} depth images for {frames} colour frames; expected one for each, cut the longer one "
        "or drop frames without a partner"
    )


def _read_depth(path: Path, rig: Rig, unit_m: float) -> np.ndarray:
    """Depth in metres of one image, float32, 0 where missing."""
    units = read_depth_file(path)
    size, whose = rig.depth_grid, "colour frames are" if rig.depth_camera is None else "depth_camera is for"
    if units.shape != (size.height, size.width):
        raise RecordingError(
            f"depth image {path}: {units.shape[1]} x {units.shape[0]}, but {whose} {size.width} x {size.height}; align "
            "the depth to the colour camera first, or give depth_camera and colour_from_depth in the camera file"
        )
    return metres(units, unit_m)
