"""Sets of labelled real recordings, as they lie on disk; ``docs/metrics.md`` describes the formats.

A set is a folder of labelled clips, or of labelled pictures; which one is told by what is in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image

from quest.data.boxed_pictures import in_boxes, kind_of, may_choose, read_boxed_pictures
from quest.data.columns import read_columns
from quest.data.pictures import read_picture
from quest.data.provenance import combined_hash, file_hash
from quest.data.recording import read_recording
from quest.errors import InputError
from quest.model.finder import PANELS
from quest.types import Clip, Query

STATES = ("visible", "occluded", "out")
EXPECTED = (
    "expected folders of clips that each hold labels.csv or truth.csv, or pictures/ and labels.csv (docs/metrics.md)"
)
Part = Literal["choosing", "teaching", "all"]
"""Part of a set of pictures: a fifth of them chooses between settings, the rest may teach."""

_BAR_PX = 12.0


@dataclass(frozen=True)
class Labels:
    """Labels of K tracks of one clip, one row a label, N in all."""

    names: tuple[str, ...]
    moves: Bool[np.ndarray, " K"]
    """Whether the part that a track is on is moved against its surroundings."""
    track: Int[np.ndarray, " N"]
    """Index of the label's track."""
    frame: Int[np.ndarray, " N"]
    uv_px: Float[np.ndarray, "N 2"]
    """Pixels, centres at half-integers; NaN where nothing is known."""
    state: np.ndarray
    """One of :data:`STATES`."""

    @cached_property
    def asked(self) -> Int[np.ndarray, " K"]:
        """The label of each track with which a tracker is asked for it: the first visible one."""
        seen = np.flatnonzero(self.state == "visible")
        return seen[np.unique(self.track[seen], return_index=True)[1]]

    @property
    def scored(self) -> Int[np.ndarray, " S"]:
        """The labels that are scored: those after the one with which a track is asked for."""
        return np.flatnonzero(self.frame > self.frame[self.asked][self.track])

    def queries(self) -> list[Query]:
        """A point query per track, in their order."""
        return [
            Query.point(int(self.frame[i]), *map(float, self.uv_px[i]), name=f"query-{k}")
            for k, i in enumerate(self.asked)
        ]

    @property
    def step_px(self) -> float:
        """Median way of visible points from frame to frame, pixels."""
        steps = [
            np.linalg.norm(np.diff(self.uv_px[i], axis=0), axis=1) / np.diff(self.frame[i])
            for k in range(len(self.names))
            if len(i := np.flatnonzero((self.track == k) & (self.state == "visible"))) > 1
        ]
        return float(np.median(np.concatenate(steps))) if steps else 0.0


@dataclass(frozen=True)
class LabelledClip:
    """A recording with labelled tracks."""

    folder: Path
    """A recording folder (``docs/recordings.md``); without a camera file the camera is guessed."""
    file: Path

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name

    @cached_property
    def labels(self) -> Labels:
        """The labels.

        Raises:
            InputError: the file cannot be understood.
        """
        return read_labels(self.file)

    def read(self) -> Clip:
        """The frames.

        Raises:
            InputError: the recording is damaged, or labels are for frames that it has not.
        """
        clip = read_recording(self.folder)
        if len(clip) <= self.labels.frame.max():
            raise InputError(
                f"{self.file}: expected frames below {len(clip)}, which {self.folder} has, got "
                f"{self.labels.frame.max()}; frames count from 0"
            )
        return clip


@dataclass(frozen=True)
class Picture:
    """A picture with H labelled handles: boxes, or bars between two ends."""

    path: Path
    boxes: Float[np.ndarray, "H 4"]
    """X0, y0, x1, y1 of each handle's box, or the two ends of its bar, pixels."""
    wanted: Bool[np.ndarray, " H"]
    """Which handles count; answers at the others are neither right nor wrong."""
    panels: Mapping[str, Float[np.ndarray, "M 4"]] = field(default_factory=dict)
    """Boxes of doors and drawers by their kind; none where they are not labelled."""
    bars: bool = False

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    def read(self) -> UInt8[np.ndarray, "H W 3"]:
        """The picture, sRGB.

        Raises:
            InputError: the file is damaged.
        """
        return read_picture(self.path)

    def closeness(self, uv_px: Float[np.ndarray, "A 2"]) -> Float[np.ndarray, "A H"]:
        """How far answers are from handles, in parts of the handle; infinite where they are not right.

        Right is an answer in a box (see :func:`quest.data.boxed_pictures.in_boxes`), or within 12 px of a bar.
        """
        low, high = self.boxes[:, :2], self.boxes[:, 2:]
        if self.bars:
            along = np.maximum(np.square(high - low).sum(axis=-1), 1e-9)
            share = np.clip(((uv_px[:, None] - low) * (high - low)).sum(axis=-1) / along, 0, 1)
            gap = np.linalg.norm(uv_px[:, None] - low - share[..., None] * (high - low), axis=-1) / _BAR_PX
            return np.where(gap <= 1, gap, np.inf)
        gap = np.abs((uv_px[:, None] - (low + high) / 2) / np.maximum((high - low) / 2, 1)).max(axis=-1)
        return np.where(in_boxes(self.boxes, uv_px), gap, np.inf)

    def sizes_px(self) -> Float[np.ndarray, " H"]:
        """The longer side of each handle in a picture 640 pixels wide."""
        with Image.open(self.path) as image:
            return np.abs(self.boxes[:, 2:] - self.boxes[:, :2]).max(axis=-1, initial=0) * 640 / image.width


@dataclass(frozen=True)
class RealSet:
    """A set of labelled recordings: clips with tracks, pictures with handles, or both."""

    folder: Path
    clips: tuple[LabelledClip, ...]
    pictures: tuple[Picture, ...]
    far_px: float = 16.0
    """Beyond this a tracker's answer is far off, where its P(lost) should be high."""

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.resolve().name

    def data_hash(self) -> str:
        """Over all files that answers and scores depend on."""
        files = [path for clip in self.clips for path in clip.folder.rglob("*") if path.is_file()]
        files += [picture.path for picture in self.pictures]
        files += [
            path for path in (self.folder / "labels.csv", self.folder / "handles" / "handles.csv") if path.exists()
        ]
        root = self.folder
        return combined_hash((f.relative_to(root).as_posix(), file_hash(f) or "") for f in dict.fromkeys(files))


def open_set(folder: Path, *, part: Part = "choosing") -> RealSet:
    """Find out what a folder holds.

    Raises:
        InputError: it is no set, or its labels cannot be understood.
    """
    if not folder.is_dir():
        raise InputError(f"real set {folder}: no such folder; {EXPECTED}")
    if (folder / "pictures").is_dir():
        return RealSet(folder, (), tuple(_boxed_pictures(folder, part)))
    clips = [
        LabelledClip(own, file)
        for own in sorted(path for path in folder.iterdir() if path.is_dir())
        for file in (own / "labels.csv", own / "truth.csv")
        if file.is_file()
    ]
    stills = tuple(_stills(folder / "handles")) if (folder / "handles" / "handles.csv").is_file() else ()
    if not clips and not stills:
        raise InputError(f"real set {folder}: {EXPECTED}, found neither")
    for clip in clips:
        assert clip.labels  # read now: a wrong label must not come to light after an hour
    exact = all(clip.file.name == "truth.csv" for clip in clips)
    return RealSet(folder, tuple(clips), stills, far_px=40.0 if exact else 16.0)


def read_labels(path: Path) -> Labels:
    """Read ``labels.csv`` (pixel centres at half-integers) or ``truth.csv`` (at integers).

    Raises:
        InputError: a column is missing, a value makes no sense, or a track is nowhere visible.
    """
    rows = read_columns(path, {"track": str, "frame": int, "x": float, "y": float, "state": str}, moves=str)
    order = np.lexsort((rows["frame"], rows["track"]))
    name, frame, x, y, state, moves = (rows[key][order] for key in ("track", "frame", "x", "y", "state", "moves"))
    uv_px = np.stack([x, y], axis=-1) + (0.5 if path.name == "truth.csv" else 0.0)
    seen = state == "visible"
    for wrong, what in (
        (~np.isin(state, STATES), f"state {', '.join(STATES)}"),
        (frame < 0, "a frame from 0 on"),
        (seen & ~np.isfinite(uv_px).all(axis=-1), "x and y of what is visible"),
        (~np.isin(name, name[seen]), "a visible label of every track"),
    ):
        if wrong.any():
            i = int(wrong.argmax())
            raise InputError(
                f"{path}: expected {what}, got track {name[i]}, frame {frame[i]}, state {state[i] or None}"
            )
    if not len(name):
        raise InputError(f"{path}: expected labels, got none")
    names, track = np.unique(name, return_inverse=True)
    return Labels(tuple(names.tolist()), np.isin(names, name[moves == "yes"]), track, frame, uv_px, state)


def _boxed_pictures(folder: Path, part: Part) -> Iterator[Picture]:
    for picture in read_boxed_pictures(folder):
        if part == "all" or may_choose(picture.path.name) == (part == "choosing"):
            kind = np.array([kind_of(name)[0] for name in picture.names], object)
            own = kind == "grip"
            panels = {name: picture.box_px[kind == name] for name in PANELS}
            yield Picture(picture.path, picture.box_px[own], np.ones(own.sum(), bool), panels=panels)


def _stills(folder: Path) -> Iterator[Picture]:
    """Pictures whose handles are bars, pixel centres at integers."""
    ends = ("x1", "y1", "x2", "y2")
    rows = read_columns(folder / "handles.csv", {"frame": int, "use": int, **dict.fromkeys(ends, float)})
    for frame in np.unique(rows["frame"]):
        own = rows["frame"] == frame
        yield Picture(
            folder / f"{frame:04d}.jpg",
            np.stack([rows[key][own] for key in ends], axis=-1) + 0.5,
            rows["use"][own] > 0,
            bars=True,
        )
