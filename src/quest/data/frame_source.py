"""A recording as a stream: its camera is known at once, its frames come one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from quest.errors import RecordingError
from quest.types import Camera, Clip, Frame

PLAUSIBLE_DEPTH_M = (0.05, 50.0)
"""A clip whose median depth lies outside is taken to be in other units."""

_USUAL_SCALES_M = (1e-3, 1e-4, 2e-4, 1e-2, 1e-5, 1e-6, 0.1, 1.0)
_USUAL_DEPTH_M = 1.5
_ENOUGH_DEPTH = 0.05


@dataclass(frozen=True)
class Parts:
    """Which parts of a recording to read, where it has several or does not say.

    Attributes:
        episode: Which episode of a LeRobot dataset.
        camera_key: Which camera of a LeRobot dataset, such as observation.images.front or front; default: the first.
        topic_rgb: Topic of the colours in a bag; default: found by its type and name.
        topic_depth: Topic of the depth in a bag, or none to leave it out; default: found likewise.
        topic_info: Topic of the colours' CameraInfo; default: beside the colours.
        topic_depth_info: Topic of the depth's CameraInfo; default: beside the depth.
        world_frame: tf frame that is the world; default: the root of the camera's tf tree.
        sync_s: How far apart colour and depth of a bag may be, seconds.
    """

    episode: int = 0
    camera_key: str | None = None
    topic_rgb: str | None = None
    topic_depth: str | None = None
    topic_info: str | None = None
    topic_depth_info: str | None = None
    world_frame: str | None = None
    sync_s: float = 0.02


class Notes:
    """What is less than it could be in a recording, in words: said of the whole, or counted over its frames."""

    def __init__(self) -> None:
        self._said: list[str] = []
        self._counted: dict[str, list[int]] = {}

    def say(self, words: str) -> None:
        """Note something of the whole recording, once."""
        if words not in self._said:
            self._said.append(words)

    def count(self, words: str, frame: int) -> None:
        """Note something of one frame."""
        found = self._counted.setdefault(words, [0, frame])
        found[0] += 1

    def restart(self) -> None:
        """Forget what was counted: the frames begin again."""
        self._counted.clear()

    @property
    def words(self) -> tuple[str, ...]:
        """All notes; those of frames with how many and which was the first."""
        counted = (f"{words}: {number} frames, first {first}" for words, (number, first) in self._counted.items())
        return (*self._said, *counted)


@dataclass(frozen=True)
class FrameSource:
    """Frames of one camera, read as they are asked for; every loop over them begins anew.

    Attributes:
        name: what to call the recording.
        camera: intrinsics of every frame, without distortion.
        frames: begins to read.
        length: number of frames, or about that many where ``exact`` is False; None where only reading tells.
        exact: whether ``length`` is the number of frames that come.
        notes: what is less than it could be; complete when the last frame has come.
        units: where the depth comes from and metres per unit of it, for the message about wrong units.
    """

    name: str
    camera: Camera
    frames: Callable[[], Iterator[Frame]]
    length: int | None = None
    exact: bool = True
    notes: Notes = field(default_factory=Notes)
    units: tuple[str, float] = ("the recording", 1.0)

    @property
    def flags(self) -> tuple[str, ...]:
        """Degradations in words."""
        return self.notes.words

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order.

        Raises:
            RecordingError: the recording is torn or inconsistent, has no frames, or its depth is in the wrong units.
        """
        self.notes.restart()
        unchecked, before = True, -np.inf
        for t, frame in enumerate(self.frames()):
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
            before = frame.stamp_s
            if unchecked and frame.depth_m is not None and (frame.depth_m > 0).mean() > _ENOUGH_DEPTH:
                check_units(frame.depth_m[None], *self.units)
                unchecked = False
            yield frame
        if before == -np.inf:
            raise RecordingError(f"recording {self.name}: expected at least one frame, got none; record it again")

    def clip(self) -> Clip:
        """All frames in memory; depth is zero in frames that have none.

        Raises:
            RecordingError: as in reading frame by frame, or every pixel of the depth is missing.
        """
        frames = list(self)
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
        )


def source_of_clip(clip: Clip) -> FrameSource:
    """A clip in memory as a source."""
    return FrameSource(
        clip.name,
        clip.camera,
        lambda: (clip.frame(t) for t in range(len(clip))),
        length=len(clip),
        units=(clip.name, 1.0),
    )


def clean_depth(depth_m: Shaped[np.ndarray, "*S"]) -> Float32[np.ndarray, "*S"]:
    """Depth as float32 in which 0 stands for whatever was not finite or not positive."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float32)


def check_units(depth_m: Float32[np.ndarray, "T H W"], where: Path | str, scale_m: float) -> None:
    """Raise RecordingError if the median depth is not one that a camera sees."""
    step = max(1, len(depth_m) // 16)
    sample = depth_m[::step, ::2, ::2] if depth_m[0].size > 64 else depth_m
    valid = sample[sample > 0]
    if valid.size == 0:
        valid = depth_m[depth_m > 0]
    if valid.size == 0:
        raise RecordingError(f"depth of {where}: every pixel is missing; leave the depth out to use colours only")
    median_m = float(np.median(valid))
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median_m <= high:
        return
    likely = min(_USUAL_SCALES_M, key=lambda scale: abs(np.log(median_m / scale_m * scale / _USUAL_DEPTH_M)))
    raise RecordingError(
        f"depth of {where}: the median is {median_m:.3g} m with depth_scale_m = {scale_m:g}, expected {low:g} to "
        f"{high:g} m; the units are wrong, depth_scale_m = {likely:g} would give {median_m / scale_m * likely:.2f} m"
    )
