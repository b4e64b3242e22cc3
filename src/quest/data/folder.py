"""Recordings as folders: images or a video, 16-bit depth images, and a camera file; read frame by frame."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from quest.data.camera_file import CameraFile, find_setup
from quest.data.frame_source import FrameSource, Notes, Reader, ReadOptions
from quest.data.pictures import TURNED, colours_of, is_turned, upright
from quest.data.registration import Rig
from quest.data.video import SUFFIXES, play_video, probe_video
from quest.depth import metres
from quest.errors import RecordingError
from quest.types import Frame
from quest.untrusted import reading, require_file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


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
    turned: bool = False
    """Whether the pixels of the video are not upright."""
    paired: bool = False
    """Whether depth images of the same pixels go with them."""

    def __iter__(self) -> Iterator[tuple[np.ndarray, float]]:
        """Upright pictures and their times; those of images follow a nominal rate of 30 a second."""
        if self.video is not None:
            if self.turned and self.paired:
                raise RecordingError(f"video {self.video}: {TURNED}")
            yield from play_video(self.video)
            return
        for t, path in enumerate(self.images):
            pixels = _open_image(path)
            if self.paired and is_turned(pixels):
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
    if not path.is_dir():
        return path.is_file()
    return (path / "camera.json").is_file() or (path / "rgb").is_dir() or any(map(_is_colours, path.iterdir()))


def _is_colours(path: Path) -> bool:
    return path.suffix.lower() in (*IMAGE_SUFFIXES, *SUFFIXES) and not path.name.startswith(".")


def _open(where: str, options: ReadOptions) -> FrameSource:
    source, notes = Path(where), Notes()
    root = source if source.is_dir() else source.parent
    colours = _find_colours(source)
    folder = root / "depth" if options.depth is None else options.depth
    paired = options.depth is not None or folder.exists()
    own = root / "camera.json"
    setup = find_setup(where, options, own if own.exists() else None, size=colours.size, depth=paired, notes=notes)
    if colours.size != (setup.camera.width, setup.camera.height):
        raise RecordingError(
            f"recording {source}: frames are {colours.size[0]} x {colours.size[1]} but the camera is for "
            f"{setup.camera.width} x {setup.camera.height}; give the intrinsics of these frames in the camera file"
        )
    if colours.video is None:
        assert colours.number is not None
        _check_numbers(source, setup, colours.number)
    depths = None
    if paired:
        depths = _list_depth(folder)
        if colours.video is None:
            _check_partners(folder, depths, colours.images)
            _check_depth_number(folder, len(depths), len(colours.images))
        if not depths:
            _check_depth_number(folder, 0, colours.number or 0)
        colours = replace(colours, paired=True)
    return FrameSource(
        source.stem if source.is_file() else source.resolve().name,
        setup.camera,
        lambda: _frames(source, setup, colours, depths, folder),
        length=colours.number,
        exact=colours.video is None,
        notes=notes,
        units=(str(folder), setup.depth_scale_m),
    )


READER = Reader(
    "a folder or video",
    "images, or rgb/ with images or a video such as rgb.mp4; .mp4 and the like",
    _accepts,
    _open,
    options=("depth", "camera", "depth_scale_m", "fov_deg"),
)


def _find_colours(source: Path) -> _Colours:
    videos = [source] if source.is_file() else []
    if not videos and not (source / "rgb").is_dir():
        videos = sorted(p for p in source.iterdir() if _is_colours(p) and p.suffix.lower() in SUFFIXES)
        if len(videos) > 1:
            found = ", ".join(video.name for video in videos)
            raise RecordingError(f"recording {source}: expected one video, got {found}; name the video itself")
    if videos:
        info = probe_video(videos[0])
        return _Colours((), videos[0], info.frames or None, (info.width, info.height), info.turns != 0)
    folder = source / "rgb" if (source / "rgb").is_dir() else source
    paths = _list_images(folder, IMAGE_SUFFIXES)
    if not paths:
        raise RecordingError(
            f"recording {source}: no frames; expected images in {source / 'rgb'}, or a video such as rgb.mp4"
        )
    return _Colours(tuple(paths), None, len(paths), upright(_open_image(paths[0])).size)


def _frames(
    source: Path, setup: CameraFile, colours: _Colours, depths: list[Path] | None, folder: Path
) -> Iterator[Frame]:
    rig, number, first_s = setup.rig, 0, 0.0
    known = [length for _, length in setup.lengths] + ([] if depths is None else [len(depths)])
    for t, (rgb, time_s) in enumerate(colours):
        number, first_s = t + 1, time_s if t == 0 else first_s
        if known and t >= min(known):
            continue  # only counted, so that the message can say how many there are
        depth_m = None if depths is None else rig.depth(_read_depth(depths[t], rig, setup.depth_scale_m))
        yield Frame(rig.rgb(rgb), depth_m, setup.stamp(t, fallback_s=time_s - first_s), setup.pose(t))
    _check_numbers(source, setup, number)
    if depths is not None:
        _check_depth_number(folder, len(depths), number)


def _check_numbers(source: Path, setup: CameraFile, frames: int) -> None:
    for what, number in setup.lengths:
        if number != frames:
            raise RecordingError(f"recording {source}: {what} of the camera is for {number} frames, expected {frames}")


def _check_partners(folder: Path, depths: Sequence[Path], images: Sequence[Path]) -> None:
    """Where depth images are named as colours are, each must have its own; where none is, they go in order."""
    depth_of, colour_of = ({path.stem for path in paths} for paths in (depths, images))
    alone = sorted(depth_of ^ colour_of)
    if alone and depth_of & colour_of:
        what = "colours" if alone[0] in depth_of else "depth"
        raise RecordingError(
            f"depth {folder}: {len(depths)} depth images for {len(images)} colour frames, and {alone[0]} has no "
            f"{what}; expected one for each, drop frames without a partner"
        )


def _check_depth_number(folder: Path, depths: int, frames: int) -> None:
    if depths != frames:
        raise RecordingError(
            f"depth {folder}: {depths} depth images for {frames} colour frames; expected one for each, "
            "cut the longer one or drop frames without a partner"
        )


def _list_depth(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise RecordingError(f"depth {folder}: no such folder; expected one 16-bit PNG per colour frame")
    found = _list_images(folder, (".png",))
    others = sorted(path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    if others and not found:
        raise RecordingError(f"depth {folder}: expected 16-bit PNG images, got files such as {others[0]}; convert them")
    return found


def _read_depth(path: Path, rig: Rig, scale_m: float) -> np.ndarray:
    """Depth in metres of one image, float32, 0 where missing."""
    image = _open_image(path)
    if image.mode not in ("I;16", "I;16B", "I"):
        raise RecordingError(
            f"depth image {path}: expected 16-bit grey, got mode {image.mode}; "
            "write depth as 16-bit PNGs (millimetres, say), not as a coloured or 8-bit picture"
        )
    size, whose = rig.depth_grid, "colour frames are" if rig.depth_camera is None else "depth_camera is for"
    if image.size != (size.width, size.height):
        raise RecordingError(
            f"depth image {path}: {image.width} x {image.height}, but {whose} {size.width} x {size.height}; align "
            "the depth to the colour camera first, or give depth_camera and colour_from_depth in the camera file"
        )
    return metres(np.asarray(image), scale_m)


def _list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    return sorted(paths, key=_natural)


def _natural(path: Path) -> list[tuple[float, float, str]]:
    """Sorts frame 2 before frame 10, and names that are times by these."""
    time = re.fullmatch(r"\d+\.\d+", path.stem)
    parts = ["", path.stem, ""] if time else re.split(r"(\d+)", path.stem)
    key: list[tuple[float, float, str]] = []
    for part in parts:
        key.append((1, float(part), "") if (time and part) or part.isdecimal() else (0, 0, part))
    return [*key, (0, 0, path.suffix)]


def _open_image(path: Path) -> Image.Image:
    require_file(path, RecordingError)
    remedy = "the file is torn, copy or record it again"
    with reading(f"image {path}", RecordingError, remedy), Image.open(path) as image:
        image.load()
        return image
