"""One letterboxed RGB-D image as the network takes it, and the reference frame that a clip of them has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from quest.geometry import exact_product, invert
from quest.model.frames import FrameBatch, reference_of
from quest.paper.network import PaperNetwork
from quest.types import Camera


@dataclass(frozen=True)
class Reference:
    """The reference frame of a clip (see :mod:`quest.model.frames`)."""

    cam_from_world: Float[Tensor, "4 4"]
    """Pose of the camera at which it began, on the CPU in double precision, which not every device has."""
    center: Float[Tensor, "1 3"]
    """Its origin in that camera, metres."""
    scale: Float[Tensor, " 1"]
    """Metres per unit."""


class Framer:
    """Prepares frames of one camera.

    Args:
        network: whose input is prepared.
        camera: intrinsics of the letterboxed input.
        device: where the network runs.
    """

    def __init__(self, network: PaperNetwork, camera: Camera, *, device: torch.device) -> None:
        self._network = network
        self._device = device
        self._intrinsics = torch.tensor(
            [[camera.fx, camera.fy, camera.cx, camera.cy]], dtype=torch.float32, device=device
        )

    def depth(self, depth_m: Float32[np.ndarray, "S S"] | None) -> Float[Tensor, "1 S S"]:
        """Letterboxed depth as a tensor; all 0, which is missing, for None."""
        size = self._network.config.encoder.image_size
        raw = np.zeros((size, size), np.float32) if depth_m is None else np.ascontiguousarray(depth_m)
        return torch.from_numpy(raw).to(self._device)[None]

    def reference(self, depth: Float[Tensor, "1 S S"], cam_from_world: Float[Tensor, "4 4"]) -> Reference:
        """The reference frame that begins with a frame."""
        centre, scale = reference_of(depth, self._intrinsics, cell_px=self._network.config.cell_px)
        return Reference(cam_from_world, centre, scale)

    def frame(
        self,
        rgb: UInt8[np.ndarray, "S S 3"],
        depth: Float[Tensor, "1 S S"],
        cam_from_world: Float[Tensor, "4 4"],
        reference: Reference,
    ) -> FrameBatch:
        """A frame (B = T = 1).

        Args:
            rgb: the letterboxed image.
            depth: from :meth:`depth`.
            cam_from_world: the frame's pose.
            reference: the reference frame of its clip.
        """
        image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device)[None]
        pose = exact_product(reference.cam_from_world, invert(cam_from_world))
        return FrameBatch(
            features=self._network.encode(image)[:, None].float(),
            depth_m=depth[None],
            intrinsics=self._intrinsics,
            ref_from_cam=pose.float().to(self._device)[None, None],
            center=reference.center,
            scale=reference.scale,
        )
