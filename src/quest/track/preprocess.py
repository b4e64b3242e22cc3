"""What comes in: frames are checked, put in order, and made ready for the filter."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from quest.depth import PLAUSIBLE_DEPTH_M
from quest.errors import InputError
from quest.filter.picture import GreyPicture
from quest.filter.surfaces import depth_growth
from quest.geometry.poses import is_rigid, nearest_rigid
from quest.model.xfeat import LEAST_PX
from quest.track.health import Health, digest_of
from quest.types import Camera
from quest.untrusted import reading

NO_DEPTH_FLAG = "no depth: pixels only, world points are NaN"
DEPTH_BEGINS_FLAG = "depth begins: world points from here on"

_CLOCK_RESTART_S = 5.0
_LEAST_DEPTHS = 16
_LATEST_S = 1e12
"""Thirty thousand years."""
_LEAST_BEYOND = 0.001


@dataclass
class PreprocessorState:
    """What the next frame of a stream depends on."""

    flags: tuple[str, ...] = ()
    """Degradations of the newest frame, in words."""
    stamp_s: float | None = None
    """Of the newest frame; None before the first."""
    step_s: float = 0.0
    """Between the newest frame and the one before."""
    now_s: float = 0.0
    """Time of the newest frame, by a clock that never goes back."""
    digest: int | None = None
    """Of the colours of the newest frame."""
    pose: Float[np.ndarray, "4 4"] | None = None
    """``cam_from_world`` of the newest frame that had one."""
    posed: bool = False
    """Whether the poses that were given tell how the camera moves: they have changed."""
    has_depth: bool = False
    """Whether a frame so far brought depth."""
    depth_grows: float = 0.0
    """How depth errs by chance, as of :func:`quest.filter.surfaces.depth_growth`; of the newest frame that told."""
    health: Health = field(default_factory=Health)
    """What pictures and depth are compared with."""


@dataclass(frozen=True)
class Prepared:
    """A frame as the filter takes it."""

    depth_m: Float[np.ndarray, "H W"] | None
    """Metres, of the size that the filter sees, 0 where missing; None without any."""
    cam_from_world: Float[np.ndarray, "4 4"] | None
    """Pose of the camera; None where none is given, and before those that are given change."""
    first_pose: Float[np.ndarray, "4 4"] | None
    """That of the first frame of the stream that has one; None in all others."""
    blind: bool
    """Whether the picture shows nothing, so that nothing can be told from the frame."""


class Preprocessor:
    """Checks the frames of one stream and prepares them; all that the next frame depends on is its ``state``.

    Pictures whose longer side is below ``follow_px`` are enlarged to it.

    Raises:
        InputError: pictures with a side below 16 pixels.
    """

    def __init__(self, camera: Camera, follow_px: int) -> None:
        if min(camera.width, camera.height) < LEAST_PX:
            raise InputError(
                f"camera: expected pictures with sides of at least {LEAST_PX} pixels, got {camera.width} x "
                f"{camera.height}; enlarge them"
            )
        self.camera = camera
        by = max(1.0, follow_px / max(camera.width, camera.height))
        self.size = (round(by * camera.width), round(by * camera.height))
        """Width and height of what the filter sees, pixels."""
        self.scale = (self.size[0] / camera.width, self.size[1] / camera.height)
        """Its pixels for one of the camera."""
        self.state = PreprocessorState()

    def check(
        self,
        frame: int,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
        stamp_s: float,
        cam_from_world: Float[np.ndarray, "4 4"] | None,
    ) -> float:
        """Refuse what no camera sends; returns the stamp as a number of Python's.

        Raises:
            InputError: the frame does not have the camera's size or type, its stamp is no time, its pose is not rigid,
                or the first depth is not in metres.
        """
        expected = (self.camera.height, self.camera.width, 3)
        for what, given in (("colours", rgb), ("depth", depth_m)):
            if given is not None and not isinstance(given, np.ndarray):
                raise InputError(f"frame {frame}: expected {what} as an array of NumPy, got {type(given).__name__}")
        if rgb is None:
            raise InputError(f"frame {frame}: expected colours {expected} of uint8, got None")
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise InputError(f"frame {frame}: expected colours {expected} of uint8, got {rgb.shape} of {rgb.dtype}")
        if depth_m is not None and depth_m.shape != expected[:2]:
            raise InputError(f"frame {frame}: expected depth of the colours' size {expected[:2]}, got {depth_m.shape}")
        if depth_m is not None and not np.issubdtype(depth_m.dtype, np.floating):
            raise InputError(
                f"frame {frame}: expected depth in metres as float, got {depth_m.dtype}; multiply raw units by their "
                "size in metres"
            )
        median_m = None if depth_m is None or self.state.has_depth else _implausible(depth_m)
        if median_m is not None:
            raise InputError(f"frame {frame}: expected depth in metres, got {median_m:.3g} in the median")
        with reading(f"frame {frame}: stamp or pose", InputError, "expected numbers"):
            seconds = float(stamp_s)
            pose = np.eye(4) if cam_from_world is None else np.asarray(cam_from_world, dtype=np.float64)
        if not abs(seconds) < _LATEST_S:
            raise InputError(
                f"frame {frame}: expected a time stamp in seconds, below {_LATEST_S:g}, got {seconds:g}; divide "
                "nanoseconds by 1e9"
            )
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError(
                f"frame {frame}: expected cam_from_world as a rigid 4 x 4 transform (rotation, translation in metres, "
                f"last row 0 0 0 1), got {pose.tolist()}; None where it is unknown"
            )
        return seconds

    def accept(self, rgb: UInt8[np.ndarray, "H W 3"], stamp_s: float) -> bool:
        """Whether a frame is the next one; what comes too late or twice changes nothing but the flags.

        A stamp that lies more than five seconds back means that the clock began anew: as much time passed as between
        the two frames before.
        """
        state, before = self.state, self.state.stamp_s
        state.flags = ()
        if before is not None and stamp_s < before:
            if before - stamp_s <= _CLOCK_RESTART_S:
                state.flags = (f"late: {before - stamp_s:.3f} s older than the frame before; ignored",)
                return False
            state.flags = (f"clock went back by {before - stamp_s:.1f} s",)
        digest = digest_of(rgb)
        if digest == state.digest and stamp_s == before:
            state.flags = ("duplicate: same stamp and colours as the frame before; ignored",)
            return False
        if before is not None and stamp_s >= before:
            state.step_s = stamp_s - before
        state.now_s += state.step_s
        state.stamp_s, state.digest = stamp_s, digest
        return True

    def picture(self, rgb: UInt8[np.ndarray, "H W 3"]) -> GreyPicture:
        """What the filter follows in a frame."""
        grey = grey_of(rgb)
        if self.scale != (1.0, 1.0):
            grey = cv2.resize(grey, self.size, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        return GreyPicture(grey, scale=self.scale)

    def prepare(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
        cam_from_world: Float[np.ndarray, "4 4"] | None,
    ) -> Prepared:
        """What else it takes of the frame that was accepted last."""
        state = self.state
        flags, blind = state.health.of_picture(rgb, state.digest)
        state.flags += flags
        median_m = None if depth_m is None else _implausible(depth_m)
        if median_m is not None:
            state.flags += (f"depth ignored: {median_m:.3g} m in the median",)
            depth_m = None
        if depth_m is not None:
            beyond = float((depth_m > PLAUSIBLE_DEPTH_M[1]).mean())
            if beyond > _LEAST_BEYOND:
                state.flags += (f"depth beyond {PLAUSIBLE_DEPTH_M[1]:g} m ignored: {beyond:.0%} of the pixels",)
            depth_m = np.where((depth_m > 0) & (depth_m <= PLAUSIBLE_DEPTH_M[1]), depth_m, np.float32(0))
            wrong = state.health.of_depth(depth_m, grey_of(rgb), flags)
            if wrong is not None:
                state.flags += (f"depth ignored: {wrong}",)
                depth_m = None
        if depth_m is None or not depth_m.any():
            state.flags += (NO_DEPTH_FLAG,)
            depth_m = None
        elif not state.has_depth:
            if state.pose is not None or state.now_s > 0:
                state.flags += (DEPTH_BEGINS_FLAG,)
            state.has_depth = True
        grows = None if depth_m is None else depth_growth(depth_m)
        state.depth_grows = state.depth_grows if grows is None else grows
        if depth_m is not None and self.scale != (1.0, 1.0):  # never mixed between pixels
            depth_m = cv2.resize(depth_m, self.size, interpolation=cv2.INTER_NEAREST_EXACT).astype(np.float32)
        return Prepared(depth_m, *self._poses(cam_from_world), blind)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of what the filter sees, pixels."""
        return np.diag([*self.scale, 1.0]) @ self.camera.matrix.astype(np.float64)

    def _poses(self, cam_from_world: np.ndarray | None) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The frame's pose, and the same if it is the stream's first.

        Poses that never change, such as an identity where nothing is known, tell nothing.
        """
        state = self.state
        if cam_from_world is None:
            if state.posed:
                state.flags += ("no pose: estimated from the picture",)
            return None, None
        pose, before = nearest_rigid(cam_from_world), state.pose
        state.pose = pose
        state.posed |= before is not None and not np.array_equal(pose, before)
        return pose if state.posed else None, pose if before is None else None


def grey_of(rgb: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
    """Luminance."""
    return cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)


def _implausible(depth_m: Float32[np.ndarray, "H W"]) -> float | None:
    """The median of depth that no camera sees in metres; None where it is plausible, or hardly any is there."""
    sample = depth_m[::8, ::8]
    valid = sample[np.isfinite(sample) & (sample > 0)]
    if len(valid) < _LEAST_DEPTHS:
        return None
    median_m, (low, high) = float(np.median(valid)), PLAUSIBLE_DEPTH_M
    return None if low <= median_m <= high else median_m
