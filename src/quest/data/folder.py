"""Folders as recorders and data sets leave them, and videos: what they hold, and their frames one by one.

Known are recording folders of our own, and those of Open3D, ScanNet, TUM RGB-D, 7-Scenes, 3RScan, Record3D, Stray
Scanner and nerfstudio. Poses in them are ``world_from_cam``; those of Record3D and nerfstudio have OpenGL's axes.

Reference: the pages of these data sets and tools that describe their formats; Sturm et al. 2012 (TUM RGB-D, with the
calibration of its three cameras); Shotton et al. 2013 (7-Scenes).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from quest.data.camera_file import CameraFile, completed, find_setup, read_camera
from quest.data.frame_source import FrameSource, Notes, Parts, Reader, ReadOptions
from quest.data.pictures import (
    DEPTH_SUFFIXES,
    PICTURES,
    TURNED,
    colours_of,
    is_turned,
    open_image,
    read_depth_file,
    upright,
)
from quest.data.registration import Distortion, Rig
from quest.data.transforms import STALE_S, Edge
from quest.data.video import SUFFIXES, play_video, probe_video
from quest.depth import metres
from quest.errors import RecordingError
from quest.geometry.poses import is_rigid, nearest_rigid
from quest.types import Camera, Frame
from quest.untrusted import MOST_TEXT, is_inside, read_json, reading, require_file
from quest.wording import counted

Size = tuple[int, int]
"""Width and height, pixels."""

_COLOURS = ("rgb", "color", "colour", "images", "image")
_POSES = ("pose", "poses")
_MATRICES = (
    *("K.txt", "cam_K.txt", "intrinsics.txt", "intrinsic.txt", "camera_intrinsics.txt", "camera-intrinsics.txt"),
    *("intrinsic/intrinsic_color.txt", "intrinsics/intrinsic_color.txt", "camera_matrix.csv"),
)
_OPEN3D = ("intrinsic.json", "camera_intrinsic.json", "camera_primesense.json")
_SIDE_BY_SIDE = re.compile(r"(.+[._-])colou?r\.[^.]+", re.IGNORECASE)
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
_FREIBURG = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""Intrinsics and lens of the three cameras of TUM RGB-D, pixel centres at integers."""
_QUATERNION = ("qx", "qy", "qz", "qw")
_PLUMB_BOB = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Colours:
    """Where the colours come from: images in order, or a video."""

    paths: tuple[Path, ...]
    """The images, or the one video."""
    size: Size
    """Width and height, upright."""
    number: int | None
    """Of frames; for a video by its header, None where that does not tell."""
    video: bool = False
    turned: bool = False
    """Whether the pixels of the video are not upright."""

    @classmethod
    def of(cls, source: Path, paths: Sequence[Path]) -> Colours:
        """Those of a recording; a RecordingError where there are none."""
        if not paths:
            raise RecordingError(
                f"recording {source}: no frames; expected images in {source / 'rgb'}, or a video such as rgb.mp4"
            )
        if source.is_file() or paths[0].suffix.lower() in SUFFIXES:
            info = probe_video(paths[0])
            return cls(tuple(paths), (info.width, info.height), info.frames or None, True, info.turns != 0)
        return cls(tuple(paths), upright(open_image(paths[0])).size, len(paths))

    def pictures(self, *, paired: bool) -> Iterator[tuple[np.ndarray, float]]:
        """Upright pictures and their times; those of images follow a nominal rate of 30 a second.

        Where depth images of the same pixels go with them, none may have to be turned.
        """
        if self.video:
            if self.turned and paired:
                raise RecordingError(f"video {self.paths[0]}: {TURNED}")
            yield from play_video(self.paths[0])
            return
        for t, path in enumerate(self.paths):
            pixels = open_image(path)
            if paired and is_turned(pixels):
                raise RecordingError(f"image {path}: {TURNED}")
            image = upright(pixels)
            if image.size != self.size:
                raise RecordingError(
                    f"image {path}: {image.width} x {image.height}, but {self.paths[0].name} is {self.size[0]} x "
                    f"{self.size[1]}; all frames must be of one size"
                )
            yield colours_of(image, f"image {path}"), t / 30.0


@dataclass(frozen=True)
class Layout:
    """The pictures of a recording, in order, and what its files say of the camera."""

    colours: Colours
    depth_folder: Path
    """Where depth is or would be, for messages."""
    depths: tuple[Path | None, ...] | None = None
    """One for every frame, None where a frame has none; None where there is no depth at all."""
    setup: CameraFile | None = None
    """What is known of the camera."""
    paired: bool = False
    """Whether its own lists tell which depth goes with which colours; else their names or their order do."""
    numbered: bool = True
    """Whether all that goes by frames must be as many as the colours; else the shortest counts."""
    notes: tuple[str, ...] = ()
    """Degradations in words."""


def find_layout(source: Path) -> Layout:
    """What a video, or a folder of one of the known layouts, holds.

    Raises:
        RecordingError: there are no colours, or a file is missing, or says what makes no sense.
    """
    if source.suffix.lower() == ".r3d":
        raise RecordingError(f"recording {source}: .r3d is compressed as LZFSE; export it from Record3D as EXR + RGB")
    if source.is_file():
        root, colours = source.parent, Colours.of(source, [source])
        found = Layout(colours, root / "depth", _depth_beside(root), _own_camera(root, colours.size))
    else:
        root = source / "EXR_RGBD" if (source / "EXR_RGBD" / "metadata.json").is_file() else source
        there = {path.name for path in root.iterdir()}
        if "rgb.txt" in there:
            found = _tum(root)
        elif "metadata.json" in there and any((root / "depth").glob("*.exr")):
            found = _record3d(root)
        elif "transforms.json" in there:
            found = _nerfstudio(root)
        elif {"odometry.csv", "camera_matrix.csv"} <= there:
            found = _stray(root)
        else:
            found = _side_by_side(root) or _folders(root)
    if not (root / "camera.json").exists():
        return found
    camera = read_camera(root / "camera.json")
    return replace(found, setup=camera if found.setup is None else completed(camera, found.setup))


def _first_of(root: Path, *names: str) -> Path | None:
    """The first of some files that is there."""
    return next((path for name in names if (path := root / name).is_file()), None)


def is_layout(folder: Path) -> bool:
    """Whether a folder holds colours."""
    marks = ("camera.json", "rgb.txt", "transforms.json", "EXR_RGBD", *_COLOURS)
    return any((folder / name).exists() for name in marks) or bool(list_images(folder, (*PICTURES, *SUFFIXES)))


def list_images(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Files with some endings, in the natural order of their names."""
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


def list_depth(folder: Path) -> tuple[Path, ...]:
    """Depth pictures of a folder, in order.

    Raises:
        RecordingError: there is no such folder, or only other files in it.
    """
    if not folder.is_dir():
        raise RecordingError(f"depth {folder}: no such folder; expected one 16-bit PNG per colour frame")
    found = list_images(folder, DEPTH_SUFFIXES)
    others = sorted(path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    if others and not found:
        raise RecordingError(f"depth {folder}: expected 16-bit PNG images, got files such as {others[0]}; convert them")
    return tuple(found)


# --- Frames ---------------------------------------------------------------------------------------------------------


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


_FORM = "images, or rgb/ with images or a video such as rgb.mp4; .mp4 and the like"
READERS = (Reader("a folder or video", _FORM, _accepts, open_folder, ("depth", "camera", "depth_scale_m", "fov_deg")),)


# --- Layouts ----------------------------------------------------------------------------------------------------------


def _pictures(root: Path) -> Layout:
    """Colours in a folder of their own, or in the root, and depth beside them."""
    inner = next((root / name for name in _COLOURS if (root / name).is_dir()), root)
    videos = [] if inner != root else list_images(root, SUFFIXES)
    if len(videos) > 1:
        found = ", ".join(video.name for video in videos)
        raise RecordingError(f"recording {root}: expected one video, got {found}; name the video itself")
    return Layout(Colours.of(root, videos or list_images(inner, PICTURES)), root / "depth", _depth_beside(root))


def _depth_beside(root: Path) -> tuple[Path, ...] | None:
    return list_depth(root / "depth") if (root / "depth").exists() else None


def _folders(root: Path) -> Layout:
    """Pictures in folders; poses and intrinsics beside them."""
    found = _pictures(root)
    poses, notes = (None, ()) if found.colours.video else _beside(root, len(found.colours.paths))
    own = _own_camera(root, found.colours.size)
    return replace(found, setup=own and replace(own, cam_from_world=poses), notes=notes)


def _side_by_side(root: Path) -> Layout | None:
    """7-Scenes, 3RScan and others: ``frame-000000.color.png``, ``.depth.png`` and ``.pose.txt``."""
    paths = {m[1]: p for p in list_images(root, PICTURES) if (m := _SIDE_BY_SIDE.fullmatch(p.name)) is not None}
    if not paths:
        return None
    there = {path.name.lower(): path for path in root.iterdir()}
    depths = [
        next((there[name] for end in DEPTH_SUFFIXES if (name := f"{stem}depth{end}".lower()) in there), None)
        for stem in paths
    ]
    poses = [there.get(f"{stem}pose.txt".lower()) for stem in paths]
    cam_from_world, notes = _poses_of_files(poses) if None not in poses else (None, ())
    colours = Colours.of(root, list(paths.values()))
    info = _first_of(root, "_info.txt", "info.txt")
    known = _own_camera(root, colours.size) or (None if info is None else _scan_info(info))
    if known is None and colours.size == (640, 480) and all(stem.startswith("frame-") for stem in paths):
        known = CameraFile(Camera(585.0, 585.0, 320.0, 240.0, 640, 480))  # as the page of 7-Scenes has it
    setup = known and replace(known, cam_from_world=cam_from_world)
    return Layout(colours, root, _some(depths), setup, paired=True, notes=notes)


def _tum(root: Path) -> Layout:
    """TUM RGB-D and those who follow it: lists of pictures by time, and where the camera was."""
    listed = _timed_files(root, "rgb.txt")
    stamp_s = np.array([time for time, _ in listed])
    depths: list[Path | None] = []
    if (root / "depth.txt").is_file():
        timed = _timed_files(root, "depth.txt")
        near = [timed[i] for i in nearest(np.array([time for time, _ in timed]), stamp_s)]
        depths = [
            path if abs(at_s - t) <= Parts.sync_s else None for (at_s, path), t in zip(near, stamp_s, strict=True)
        ]
    poses, notes = None, list[str]()
    if (truth := root / "groundtruth.txt").is_file():
        poses, stale = _poses_at(_table(truth, 8), stamp_s, truth)
        notes += [f"no pose within {STALE_S:g} s: the nearest is used in {counted(stale, 'frame')}"] * (stale > 0)
    colours = Colours.of(root, [path for _, path in listed])
    camera = re.search(r"freiburg([123])", root.resolve().name)
    values, lens = ((525.0, 525.0, 319.5, 239.5), ()) if camera is None else _FREIBURG[camera[1]]
    setup = _own_camera(root, colours.size)
    if setup is None and camera is None and not (root / "camera.json").exists():
        notes.append("no camera file: the intrinsics are those that TUM RGB-D recommends for any of its cameras")
    if setup is None and colours.size == (640, 480):
        setup = CameraFile(_camera(np.array(values), colours.size), distortion=Distortion(coefficients=lens))
    if setup is not None:
        scale_m = setup.depth_scale_m or 1 / 5000
        setup = replace(setup, depth_scale_m=scale_m, stamp_s=stamp_s - stamp_s[0], cam_from_world=poses)
    return Layout(colours, root / "depth", _some(depths), setup, paired=True, notes=tuple(notes))


def _record3d(root: Path) -> Layout:
    """What Record3D exports as EXR + RGB: ``rgb/``, ``depth/`` in metres, and ``metadata.json``."""
    file = root / "metadata.json"
    fields, found = _object(file), _pictures(root)
    with _asking(file):
        width, height = int(fields["w"]), int(fields["h"])
        lenses = np.array(fields.get("perFrameIntrinsicCoeffs") or [], np.float64).reshape(-1, 4)
        matrix = np.array(fields["K"], np.float64).reshape(3, 3).T  # column by column
        values = np.median(lenses, 0) if len(lenses) else matrix
        depth_size = int(fields.get("dw") or width), int(fields.get("dh") or height)
        stamps = np.array(fields.get("frameTimestamps") or [], np.float64)
        poses = np.array(fields.get("poses") or [], np.float64).reshape(-1, 7)
        camera = _camera(values, (width, height))
        setup = CameraFile(
            camera,
            frames_per_s=float(fields["fps"]) if fields.get("fps") else None,
            stamp_s=stamps - stamps[0] if len(stamps) else None,
            cam_from_world=_cam_from_world(_matrices(poses[:, 4:], poses[:, :4]) @ _GL_FROM_CV) if len(poses) else None,
            depth_camera=None if depth_size == (width, height) else _scaled(camera, depth_size),
        )
    steady = not len(lenses) or np.ptp(lenses[:, 0]) < 0.01 * values[0]
    notes = () if steady else ("the focal length changes: its median is used",)
    return replace(found, setup=setup, notes=notes, numbered=False)


def _stray(root: Path) -> Layout:
    """What the Stray Scanner app leaves: a video, ``depth/``, ``odometry.csv`` and ``camera_matrix.csv``."""
    file = root / "odometry.csv"
    found = _pictures(root)
    with _asking(file):
        names = [name.strip() for name in _lines(file)[0].split(",")]
        column = dict(zip(names, _table(file, len(names), skip=1).T, strict=True))
        stamps = column["timestamp"]
        position, quaternion = (np.stack([column[name] for name in group], -1) for group in ("xyz", _QUATERNION))
        poses = _cam_from_world(_matrices(position, quaternion))
    setup = _own_camera(root, found.colours.size)
    if setup is not None:
        depth_size = read_depth_file(found.depths[0]).shape[::-1] if found.depths and found.depths[0] else None
        small = None if depth_size is None else _scaled(setup.camera, depth_size)
        setup = replace(setup, stamp_s=stamps - stamps[0], cam_from_world=poses, depth_camera=small)
    return replace(found, setup=setup, numbered=False)


def _nerfstudio(root: Path) -> Layout:
    """Nerfstudio's ``transforms.json``; without depth its poses are of unknown scale, and not used."""
    file = root / "transforms.json"
    fields = _object(file)
    with _asking(file):
        frames = sorted(fields["frames"], key=lambda frame: _natural(Path(frame["file_path"])))
        colours = [_inside(root, frame["file_path"], file) for frame in frames]
        named = [frame.get("depth_file_path") for frame in frames]
        depths = _some([None if name is None else _inside(root, name, file) for name in named])
        fx, fy, cx, cy = (float(fields[name]) for name in ("fl_x", "fl_y", "cx", "cy"))
        camera = Camera(fx, fy, cx, cy, int(fields["w"]), int(fields["h"]))
        fisheye = "FISHEYE" in str(fields.get("camera_model"))
        lens = tuple(float(fields.get(n, 0)) for n in (("k1", "k2", "k3", "k4") if fisheye else _PLUMB_BOB))
        poses = _cam_from_world(np.array([frame["transform_matrix"] for frame in frames], np.float64) @ _GL_FROM_CV)
        setup = CameraFile(
            camera,
            depth_scale_m=float(fields.get("depth_unit_scale_factor", 1e-3)),
            cam_from_world=None if depths is None else poses,
            distortion=Distortion("equidistant" if fisheye else "plumb_bob", lens if fisheye or any(lens) else ()),
        )
    notes = () if depths is not None else ("transforms.json has no depth: its poses are of unknown scale and not used",)
    return Layout(Colours.of(root, colours), root, depths, setup, paired=True, notes=notes)


# --- Cameras ----------------------------------------------------------------------------------------------------------


def _own_camera(root: Path, size: Size) -> CameraFile | None:
    """What a folder's own file says of the camera: Open3D's JSON, or a matrix as text."""
    if (open3d := _first_of(root, *_OPEN3D)) is not None:
        return _open3d_camera(open3d)
    matrix = _first_of(root, *_MATRICES)
    return None if matrix is None else _matrix_camera(matrix, size)


def _camera(values: Float[np.ndarray, "..."], size: Size) -> Camera:
    """A camera of fx, fy, cx and cy, or of a matrix, with pixel centres at integers."""
    values = values[[0, 1, 0, 1], [0, 1, 2, 2]] if values.ndim == 2 else values
    fx, fy, cx, cy = values.tolist()
    return Camera(fx, fy, cx + 0.5, cy + 0.5, *size)


def _scaled(camera: Camera, size: Size) -> Camera:
    """The same camera with other pixels."""
    x, y = size[0] / camera.width, size[1] / camera.height
    return Camera(camera.fx * x, camera.fy * y, camera.cx * x, camera.cy * y, *size)


def _open3d_camera(file: Path) -> CameraFile:
    fields = _object(file)
    with _asking(file):
        matrix = np.array(fields["intrinsic_matrix"], np.float64)
        matrix = matrix.reshape(3, 3).T if matrix.ndim == 1 else matrix  # column by column
        units = fields.get("depth_scale")
        camera = _camera(matrix, (int(fields["width"]), int(fields["height"])))
        return CameraFile(camera, depth_scale_m=None if units is None else 1 / float(units))


def _matrix_camera(file: Path, size: Size) -> CameraFile:
    """A camera whose matrix stands in a text, for pictures of a size; ScanNet's has the depth's beside it."""
    with _asking(file):
        camera, turned = _camera(_matrix(file), size), np.eye(4)
        depth, *sides = (file.with_name(f"{n}.txt") for n in ("intrinsic_depth", "extrinsic_color", "extrinsic_depth"))
        if file.name != "intrinsic_color.txt" or not depth.is_file():
            return CameraFile(camera)
        if all(path.is_file() for path in sides):
            colour, other = map(_matrix, sides)
            turned = np.linalg.inv(colour) @ other if is_rigid(colour) and is_rigid(other) else turned
        return CameraFile(camera, depth_camera=_camera(_matrix(depth), (640, 480)), colour_from_depth=turned)


def _scan_info(file: Path) -> CameraFile:
    """The calibration of 3RScan and BundleFusion: lines ``m_colorWidth = 960``."""
    with _asking(file):
        lines = (line.partition("=") for line in _lines(file))
        fields = {name.strip(): value.split() for name, _, value in lines}

        def camera(which: str) -> Camera:
            matrix = np.array(fields[f"m_calibration{which}Intrinsic"], np.float64).reshape(4, 4)
            size = (int(fields[f"m_{which.lower()}{side}"][0]) for side in ("Width", "Height"))
            return _camera(matrix, (next(size), next(size)))

        colours, depth = camera("Color"), camera("Depth")
        unit_m = 1 / float(fields.get("m_depthShift", ["1000"])[0])
        return CameraFile(colours, depth_scale_m=unit_m, depth_camera=None if depth == colours else depth)


# --- Poses ------------------------------------------------------------------------------------------------------------


def _beside(root: Path, frames: int) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Poses in a folder with a matrix for every picture, or in Open3D's ``trajectory.log``; with notes."""
    folder = next((root / name for name in _POSES if (root / name).is_dir()), None)
    if folder is not None and (files := list_images(folder, (".txt",))):
        if len(files) == frames:
            return _poses_of_files(files)
        return None, (f"{len(files)} poses for {frames} pictures: not used",)
    log = _first_of(root, "trajectory.log", "scene/trajectory.log")
    if log is None:
        return None, ()
    with _asking(log):
        lines = [line.split() for t, line in enumerate(_lines(log)) if t % 5]
        rows = np.array(lines, np.float64).reshape(-1, 4, 4)
        if len(rows) != frames:
            return None, (f"{len(rows)} poses for {frames} pictures: not used",)
        return _cam_from_world(rows), ()


def _poses_of_files(files: Sequence[Path | None]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """``cam_from_world`` of files with a matrix each; where the recorder lost itself, the nearest."""
    matrices = [_matrix(file) for file in files if file is not None]
    known = [t for t, matrix in enumerate(matrices) if matrix.shape == (4, 4) and is_rigid(matrix)]
    if not known:
        return None, ("no pose is a rigid transform: not used",)
    chosen = np.array(known)[nearest(np.array(known), np.arange(len(matrices)))]
    lost = len(matrices) - len(known)
    notes = (f"no pose in {counted(lost, 'frame')}: that of the nearest frame is used",) * (lost > 0)
    return _cam_from_world(np.stack([matrices[t] for t in chosen.tolist()])), notes


def _cam_from_world(world_from_cam: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, "T 4 4"]:
    if not is_rigid(world_from_cam):
        raise ValueError("a pose is not a rigid transform")
    return np.linalg.inv(np.stack([nearest_rigid(pose) for pose in world_from_cam]))


def _matrices(position: Float[np.ndarray, "T 3"], quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 4 4"]:
    """Transforms of places and of quaternions x, y, z, w."""
    found = np.tile(np.eye(4), (len(position), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return found


def _poses_at(table: Float[np.ndarray, "N 8"], at_s: Float[np.ndarray, " T"], file: Path) -> tuple[np.ndarray, int]:
    """``cam_from_world`` at some times, of rows of time, place and quaternion; how many are far from any of them."""
    with _asking(file):
        table = table[np.argsort(table[:, 0], kind="stable")]
        edge = Edge("world", False, [(round(1e9 * row[0]), row[1:4], row[4:]) for row in table])
        at_ns = [round(1e9 * time) for time in at_s]
        stale = sum(edge.gap(time) > STALE_S for time in at_ns)
        return _cam_from_world(np.stack([edge.at(time) for time in at_ns])), stale


def nearest(places: Int[np.ndarray, " N"] | Float[np.ndarray, " N"], to: np.ndarray) -> Int[np.ndarray, " T"]:
    """Which of some places, in order, is the nearest to each of others."""
    after = np.clip(np.searchsorted(places, to), 1, max(len(places) - 1, 1))
    before, after = after - 1, np.minimum(after, len(places) - 1)
    return np.where(to - places[before] <= places[after] - to, before, after)


# --- Files ------------------------------------------------------------------------------------------------------------


def _asking(file: Path) -> Any:
    return reading(file, RecordingError, "restore it as its recorder wrote it, or give --camera FILE")


def _object(file: Path) -> dict[str, Any]:
    fields = read_json(file, RecordingError)
    if not isinstance(fields, dict):
        raise RecordingError(f"{file}: expected an object, got {type(fields).__name__}; restore it")
    return fields


def _lines(file: Path) -> list[str]:
    """Lines of a text but for empty ones, and comments after #."""
    require_file(file, RecordingError, most=MOST_TEXT)
    lines = file.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.strip() and not line.startswith("#")]


def _rows(file: Path, *, skip: int = 0) -> np.ndarray:
    return np.array([line.replace(",", " ").split() for line in _lines(file)[skip:]], np.float64)


def _table(file: Path, columns: int, *, skip: int = 0) -> Float[np.ndarray, "N C"]:
    """Numbers in columns with spaces or commas between; lines that begin with # are left out."""
    table = _rows(file, skip=skip).reshape(-1, columns)
    if not len(table) or not np.isfinite(table).all():
        raise ValueError("expected rows of finite numbers")
    return table


def _matrix(file: Path) -> np.ndarray:
    """A matrix of 3 × 3, 3 × 4 or 4 × 4 as text; may hold infinities, where a recorder lost its place."""
    with _asking(file):
        matrix = _rows(file)
        matrix = matrix.reshape(3, 3) if matrix.size == 9 else matrix
        if matrix.shape not in ((3, 3), (3, 4), (4, 4)):
            raise ValueError(f"its numbers are of shape {matrix.shape}, expected 3 x 3 or 4 x 4")
        return matrix


def _timed_files(root: Path, name: str) -> list[tuple[float, Path]]:
    """Times and files of a list, by time."""
    file = root / name
    with _asking(file):
        lines = [line.split() for line in _lines(file)]
        found = [(float(time), _inside(root, path, file)) for time, path in lines]
        if not found or not np.isfinite([time for time, _ in found]).all():
            raise ValueError("expected lines with a time and a file")
        return sorted(found, key=lambda each: each[0])


def _inside(root: Path, name: object, file: Path) -> Path:
    if not is_inside(name):
        raise RecordingError(f"{file}: {name!r} is no file in this folder; restore it")
    return root / str(name)


def _some(depths: Iterable[Path | None]) -> tuple[Path | None, ...] | None:
    found = tuple(depths)
    return found if any(path is not None for path in found) else None
