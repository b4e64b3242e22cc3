"""A recording as a stream: its camera is known at once, its frames come one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from quest.depth import check_units
from quest.errors import InputError, QuestError, RecordingError
from quest.types import Camera, Clip, Frame
from quest.untrusted import reading
from quest.wording import counted

_ENOUGH_DEPTH = 0.05


@dataclass(frozen=True)
class Parts:
    """Which parts of a recording to read, where it has several or does not say."""

    view: int = 0
    """Which camera of a take."""
    episode: int = 0
    """Which episode of a LeRobot dataset."""
    camera_key: str | None = None
    """Which camera of a LeRobot dataset, such as observation.images.front or front; default: the first."""
    topic_rgb: str | None = None
    """Topic of the colours in a bag; default: found by its type and name."""
    topic_depth: str | None = None
    """Topic of the depth in a bag, or none to omit it; default: found likewise."""
    topic_info: str | None = None
    """Topic of the colours' CameraInfo; default: beside the colours."""
    topic_depth_info: str | None = None
    """Topic of the depth's CameraInfo; default: beside the depth."""
    world_frame: str | None = None
    """tf frame that is the world; default: the root of the camera's tf tree."""
    sync_s: float = 0.02
    """How far apart colour and depth of a bag may be, seconds."""


@dataclass(frozen=True)
class ReadOptions(Parts):
    """Everything that a reader may be asked for; each knows some of it (:attr:`Reader.options`)."""

    depth: Path | None = None
    """Folder of 16-bit depth images."""
    camera: Path | Camera | None = None
    """Camera file, or the intrinsics themselves."""
    depth_scale_m: float | None = None
    """Metres per unit of depth images."""
    fov_deg: float | None = None
    """Field of view across the longer side, for recordings without a camera."""

    def given(self) -> dict[str, object]:
        """The options that are not as usual."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value != getattr(ReadOptions, name)}


@dataclass(frozen=True)
class Reader:
    """One kind of recording: how to recognise it, and how to read it."""

    kind: str
    """In messages, such as ``a ROS bag``."""
    form: str
    """How one looks, such as ``a folder with metadata.yaml``."""
    accepts: Callable[[str], bool]
    """Whether a path or URL is of this kind, by its name or by files in it."""
    open: Callable[[str, ReadOptions], FrameSource]
    """The frames, which are read when they are asked for."""
    options: tuple[str, ...] = ()
    """Fields of :class:`ReadOptions` that mean something here; others are refused."""


@contextmanager
def naming(where: str) -> Iterator[None]:
    """What is wrong with an input becomes an error of the recording that names where it stands."""
    try:
        yield
    except RecordingError:
        raise
    except InputError as error:
        raise RecordingError(f"{where}: {error}") from error


class Notes:
    """Degradations of a recording, in words: of the whole, or counted over its frames."""

    def __init__(self) -> None:
        self._said: list[str] = []
        self._counted: dict[str, list[int]] = {}

    def say(self, words: str) -> None:
        """Note something of the whole recording, once."""
        if words not in self._said:
            self._said.append(words)

    def count(self, words: str, frame: int) -> None:
        """Note something of one frame."""
        self._counted.setdefault(words, [0, frame])[0] += 1

    def restart(self) -> None:
        """Forget what was counted: the frames begin again."""
        self._counted.clear()

    @property
    def words(self) -> tuple[str, ...]:
        """All notes; those of frames with how many and which was the first."""
        often = (f"{words}: {counted(n, 'frame')}, first {first}" for words, (n, first) in self._counted.items())
        return (*self._said, *often)


@dataclass(frozen=True)
class FrameSource:
    """Frames of one camera, read as they are asked for; every loop over them begins anew."""

    name: str
    camera: Camera
    """Intrinsics of every frame, without distortion."""
    frames: Callable[[], Iterator[Frame]]
    """Begins to read."""
    length: int | None = None
    """Number of frames, or about that many where ``exact`` is False; None where only reading tells."""
    exact: bool = True
    """Whether ``length`` is the number of frames that come."""
    notes: Notes = field(default_factory=Notes)
    """Degradations; complete when the last frame has come."""
    units: tuple[str, float] = ("the recording", 1.0)
    """Where the depth comes from and metres per unit of it, for the message about wrong units."""
    live: bool = False
    """Whether frames come at a camera's pace and without an end; those that come meanwhile are dropped."""

    @property
    def flags(self) -> tuple[str, ...]:
        """Degradations in words."""
        return self.notes.words

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order.

        Raises:
            RecordingError: the recording is corrupt or inconsistent, has no frames, or its depth is in the wrong units.
        """
        self.notes.restart()
        unchecked, before = True, -np.inf
        for t, frame in enumerate(self._guarded()):
            if frame.rgb.shape[:2] != (self.camera.height, self.camera.width):
                raise RecordingError(
                    f"recording {self.name}: frame {t} is {frame.rgb.shape[1]} x {frame.rgb.shape[0]} but the camera "
                    f"is for {self.camera.width} x {self.camera.height}; give the intrinsics of these frames"
                )
            if frame.stamp_s < before:
                raise RecordingError(
                    f"recording {self.name}: time goes back by {before - frame.stamp_s:.3f} s at frame {t}; cut the "
                    "recording there"
                )
            if frame.stamp_s == before:
                self.notes.count("time stands still", t)
            before = frame.stamp_s
            if unchecked and frame.depth_m is not None and (frame.depth_m > 0).mean() > _ENOUGH_DEPTH:
                check_units(frame.depth_m[None], *self.units)
                unchecked = False
            yield frame
        if before == -np.inf:
            raise RecordingError(f"recording {self.name}: expected at least one frame, got none; record it again")

    def _guarded(self) -> Iterator[Frame]:
        where, frames = f"recording {self.name}", None
        while True:
            with reading(where, RecordingError, known=QuestError):
                frames = self.frames() if frames is None else frames
                frame = next(frames, None)
            if frame is None:
                return
            yield frame

    def clip(self, *, report: Callable[[int], object] | None = None) -> Clip:
        """All frames in memory; depth is zero in frames that have none. Reports how many frames are read, after each.

        Raises:
            RecordingError: as in reading frame by frame, every pixel of the depth is missing, or it is a live camera.
        """
        if self.live:
            raise RecordingError(f"recording {self.name}: a live camera has no end; use quest live or quest monitor")
        frames: list[Frame] = []
        for frame in self:
            frames.append(frame)
            if report is not None:
                report(len(frames))
        depth_m = None
        if any(frame.depth_m is not None for frame in frames):
            none = np.zeros((self.camera.height, self.camera.width), np.float32)
            depth_m = np.stack([none if frame.depth_m is None else frame.depth_m for frame in frames])
            check_units(depth_m, *self.units)
        return Clip(
            self.name,
            self.camera,
            np.stack([frame.rgb for frame in frames]),
            depth_m,
            np.array([frame.stamp_s for frame in frames], dtype=np.float64),
            np.stack([frame.cam_from_world for frame in frames]).astype(np.float64),
            notes=self.flags,
        )


def source_of_clip(clip: Clip) -> FrameSource:
    """A clip in memory as a source."""
    count = len(clip)
    return FrameSource(
        clip.name, clip.camera, lambda: map(clip.frame, range(count)), length=count, units=(clip.name, 1.0)
    )
