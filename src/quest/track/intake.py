"""What comes in: frames are checked, put in order, and made ready for the network."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from quest.depth import PLAUSIBLE_DEPTH_M
from quest.errors import InputError
from quest.geometry.letterbox import Letterbox
from quest.geometry.poses import is_rigid, nearest_rigid
from quest.model.framing import Framer, Reference
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.types import Camera

NO_DEPTH_FLAG = "no depth: pixels only, world points are NaN"
DEPTH_BEGINS_FLAG = "depth begins: what is seen is bound again where it was seen"

_FRAMES_PER_S = 30.0
_MOST_FRAMES = 10.0
_CLOCK_RESTART_S = 5.0
_LEAST_DEPTHS = 16


class Arrival(Enum):
    """What a frame is to the stream."""

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"


@dataclass
class IntakeState:
    """What the next frame of a stream depends on."""

    reference: Reference | None = None
    """The reference frame; None before the first frame."""
    elapsed: float = 1.0
    """Time since the frame before in frames of 30 per second, within 1 to 10."""
    now: float = 0.0
    """Time of the newest frame in frames of 30 per second: the sum of what passed between frames, at least 1 each,
    however long it was."""
    flags: tuple[str, ...] = ()
    """Degradations of the newest frame, in words."""
    stamp_s: float | None = None
    """Of the newest frame; None before the first."""
    pose: Float[np.ndarray, "4 4"] | None = None
    """``cam_from_world`` of the newest frame that had one."""
    digest: str = ""
    """Of the colours of the newest frame."""


class Intake:
    """Checks the frames of one stream and prepares them.

    Args:
        network: whose input is prepared.
        camera: intrinsics of the frames.
        device: where the network runs.

    Attributes:
        letterbox: between the source image and the network's input.
        state: what the next frame depends on.
    """

    def __init__(self, network: QuestNetwork, camera: Camera, *, device: torch.device) -> None:
        self.letterbox = Letterbox(camera, network.config.encoder.image_size)
        self.state = IntakeState()
        self._framer = Framer(network, self.letterbox.camera, device=device)
        self._features: Tensor | None = None

    def check(
        self,
        frame: int,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
        stamp_s: float,
        cam_from_world: Float[np.ndarray, "4 4"] | None,
    ) -> None:
        """Refuse what no camera sends.

        Raises:
            InputError: the frame does not have the camera's size or type, its stamp is not finite, its pose is not
                rigid, or the first depth is not in metres.
        """
        camera = self.letterbox.source
        expected = (camera.height, camera.width, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise InputError(f"frame {frame}: expected colours {expected} of uint8, got {rgb.shape} of {rgb.dtype}")
        if depth_m is not None and depth_m.shape != expected[:2]:
            raise InputError(f"frame {frame}: expected depth of the colours' size {expected[:2]}, got {depth_m.shape}")
        if depth_m is not None and not np.issubdtype(depth_m.dtype, np.floating):
            raise InputError(
                f"frame {frame}: expected depth in metres as float, got {depth_m.dtype}; multiply raw units by their "
                "size in metres"
            )
        median_m = None if depth_m is None or self._has_depth else _implausible(depth_m)
        if median_m is not None:
            raise InputError(f"frame {frame}: expected depth in metres, got {median_m:.3g} in the median")
        if not np.isfinite(stamp_s):
            raise InputError(f"frame {frame}: expected a finite time stamp in seconds, got {stamp_s}")
        pose = np.eye(4) if cam_from_world is None else np.asarray(cam_from_world)
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError(
                f"frame {frame}: expected cam_from_world as a rigid 4 x 4 transform (rotation, translation in metres, "
                f"last row 0 0 0 1), got {pose.tolist()}; None where it is unknown"
            )

    def admit(self, rgb: UInt8[np.ndarray, "H W 3"], stamp_s: float) -> Arrival:
        """Whether a frame is the next one; what comes too late or twice changes nothing.

        A stamp that lies more than five seconds back means that the clock began anew.
        """
        before = self.state.stamp_s
        self.state.flags = ()
        if before is not None and stamp_s < before:
            if before - stamp_s <= _CLOCK_RESTART_S:
                self.state.flags = (f"late: {before - stamp_s:.3f} s older than the frame before; ignored",)
                return Arrival.LATE
            self.state.flags = (f"clock went back by {before - stamp_s:.1f} s",)
        digest = hashlib.blake2b(np.ascontiguousarray(rgb).data, digest_size=16).hexdigest()
        same = digest == self.state.digest
        if same and stamp_s == before:
            self.state.flags = ("duplicate: same stamp and colours as the frame before; ignored",)
            return Arrival.DUPLICATE
        if not same:
            self._features = None
        since = 0.0 if before is None else stamp_s - before
        # Rounded, because stamps are: a 30th of a second is one frame, however it was written down.
        passed = max(1.0, round(since * _FRAMES_PER_S, 3))
        self.state.elapsed, self.state.now = min(passed, _MOST_FRAMES), self.state.now + passed
        self.state.stamp_s, self.state.digest = stamp_s, digest
        return Arrival.NEW

    def prepare(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
        cam_from_world: Float[np.ndarray, "4 4"] | None,
    ) -> tuple[FrameBatch, bool]:
        """The frame that was admitted last as the network takes it, and whether the reference frame is new with it.

        The reference frame is made at the first frame, and again at the first that brings depth.
        """
        median_m = None if depth_m is None else _implausible(depth_m)
        if median_m is not None:
            self.state.flags += (f"depth ignored: {median_m:.3g} m in the median",)
            depth_m = None
        depth = self._framer.depth(None if depth_m is None else self.letterbox.depth(depth_m))
        pose = torch.from_numpy(self._pose_of(cam_from_world))
        if not (depth > 0).any():
            self.state.flags += (NO_DEPTH_FLAG,)
        renewed = self.state.reference is None or (
            not self.state.reference.has_depth and self._framer.shows_depth(depth)
        )
        if renewed:
            if self.state.reference is not None:
                self.state.flags += (DEPTH_BEGINS_FLAG,)
            self.state.reference = self._framer.reference(depth, pose)
        assert self.state.reference is not None
        # The same picture again is not looked at again.
        frames = self._framer.frame(self.letterbox.rgb(rgb), depth, pose, self.state.reference, features=self._features)
        self._features = frames.features
        return frames, renewed

    @property
    def _has_depth(self) -> bool:
        return self.state.reference is not None and self.state.reference.has_depth

    def _pose_of(self, cam_from_world: np.ndarray | None) -> np.ndarray:
        """The frame's pose; where a posed stream misses one, the last one.

        A stream whose poses begin late was taken to stand still until then.
        """
        if cam_from_world is not None:
            if self.state.pose is None and self.state.reference is not None:
                self.state.reference = replace(
                    self.state.reference, cam_from_world=torch.from_numpy(nearest_rigid(cam_from_world))
                )
                self.state.flags += ("poses begin: world points were in the camera's axes before",)
            self.state.pose = nearest_rigid(cam_from_world)
        elif self.state.pose is not None:
            self.state.flags += ("no pose: that of the frame before is used",)
        return np.eye(4) if self.state.pose is None else self.state.pose


def _implausible(depth_m: Float32[np.ndarray, "H W"]) -> float | None:
    """The median of depth that no camera sees in metres; None where it is plausible, or hardly any is there."""
    sample = depth_m[::8, ::8]
    valid = sample[np.isfinite(sample) & (sample > 0)]
    if len(valid) < _LEAST_DEPTHS:
        return None
    median_m, (low, high) = float(np.median(valid)), PLAUSIBLE_DEPTH_M
    return None if low <= median_m <= high else median_m
