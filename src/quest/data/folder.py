"""Recordings as folders, in any known layout, or as videos: read frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from quest.data.camera_file import CameraFile, find_setup
from quest.data.depth_file import read_depth_file
from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions
from quest.data.layouts import Layout, find_layout, is_layout, list_depth
from quest.data.pictures import TURNED, colours_of, is_turned, open_image, upright
from quest.data.registration import Rig
from quest.data.video import SUFFIXES, play_video, probe_video
from quest.depth import metres
from quest.errors import RecordingError
from quest.types import Frame


@dataclass(frozen=True)
class _Colours:
    """Where the colours come from: images in order, or a video."""

    images: tuple[Path, ...]
    """Paths; empty for a video."""
    video: Path | None
    """Its path; None for images."""
    number: int | None
    """Of frames; for a video by its header."""
    size: tuple[int, int]
    """Width and height, upright."""
    turned: bool
    """Whether the pixels of the video are not upright."""

    @classmethod
    def of(cls, source: Path, layout: Layout) -> _Colours:
        if not layout.colours:
            raise RecordingError(
                f"recording {source}: no frames; expected images in {source / 'rgb'}, or a video such as rgb.mp4"
            )
        first = layout.colours[0]
        if source.is_file() or first.suffix.lower() in SUFFIXES:
            info = probe_video(first)
            return cls((), first, info.frames or None, (info.width, info.height), info.turns != 0)
        return cls(layout.colours, None, len(layout.colours), upright(open_image(first)).size, False)

    def pictures(self, *, paired: bool) -> Iterator[tuple[np.ndarray, float]]:
        """Upright pictures and their times; those of images follow a nominal rate of 30 a second.

        Args:
            paired: whether depth images of the same pixels go with them, which must not be turned then.
        """
        if self.video is not None:
            if self.turned and paired:
                raise RecordingError(f"video {self.video}: {TURNED}")
            yield from play_video(self.video)
            return
        for t, path in enumerate(self.images):
            pixels = open_image(path)
            if paired and is_turned(pixels):
                raise RecordingError(f"image {path}: {TURNED}")
            image = upright(pixels)
            if image.size != self.size:
                raise RecordingError(
                    f"image {path}: {image.width} x {image.height}, but {self.images[0].name} is {self.size[0]} x "
                    f"{self.size[1]}; all frames must be of one size"
                )
            yield colours_of(image, f"image {path}"), t / 30.0


def _accepts(where: str) -> bool:
    path = Path(where)
    return path.is_file() if not path.is_dir() else is_layout(path)


def _open(where: str, options: ReadOptions) -> FrameSource:
    source, notes = Path(where), Notes()
    layout = find_layout(source)
    if options.depth is not None:
        layout = replace(layout, depth_folder=options.depth, depths=list_depth(options.depth), paired=False)
    colours, depths = _Colours.of(source, layout), layout.depths
    own = layout.setup(colours.size)
    setup = find_setup(where, options, own, size=colours.size, depth=depths is not None, notes=notes)
    for note in layout.notes:
        notes.say(note)
    if colours.size != (setup.camera.width, setup.camera.height):
        raise RecordingError(
            f"recording {source}: frames are {colours.size[0]} x {colours.size[1]} but the camera is for "
            f"{setup.camera.width} x {setup.camera.height}; give the intrinsics of these frames in the camera file"
        )
    exact = colours.video is None and layout.numbered
    if exact:
        _check_counts(source, setup, layout, len(colours.images), partners=True)
    elif depths is not None and not depths:
        raise _unequal(layout.depth_folder, 0, colours.number or 0)
    first = next((path for path in depths or () if path is not None), None)
    unit_m = setup.unit_m
    if first is not None and read_depth_file(first).dtype.kind == "f":
        unit_m = options.depth_scale_m or 1.0  # floats are metres, unless the user says otherwise
    return FrameSource(
        source.stem if source.is_file() else source.resolve().name,
        setup.camera,
        lambda: _frames(source, setup, colours, layout, unit_m, notes),
        length=colours.number,
        exact=exact,
        notes=notes,
        units=(str(layout.depth_folder), unit_m),
    )


READER = Reader(
    "a folder or video",
    "images, or rgb/ with images or a video such as rgb.mp4; .mp4 and the like",
    _accepts,
    _open,
    options=("depth", "camera", "depth_scale_m", "fov_deg"),
)


def _frames(
    source: Path, setup: CameraFile, colours: _Colours, layout: Layout, unit_m: float, notes: Notes
) -> Iterator[Frame]:
    number, first_s, depths = 0, 0.0, layout.depths
    known = [length for _, length in setup.lengths] + ([] if depths is None else [len(depths)])
    for t, (rgb, time_s) in enumerate(colours.pictures(paired=depths is not None)):
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
        colour_of = {path.stem for path in layout.colours}
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
