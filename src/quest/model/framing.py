"""One letterboxed RGB-D image as the network takes it, and the reference frame that a sequence of them has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from quest.geometry import exact_product, invert
from quest.model.config import DecoderConfig
from quest.model.network import WindowNetwork
from quest.model.observation import FrameBatch, cell_depth, reference_of
from quest.types import Camera


@dataclass(frozen=True)
class Reference:
    """The reference frame of a stream or clip (see :mod:`quest.model.observation`)."""

    cam_from_world: Float[Tensor, "4 4"]
    """Pose of the camera at which it began, on the CPU in double precision, which not every device has."""
    center: Float[Tensor, "1 3"]
    """Its origin in that camera, metres."""
    scale: Float[Tensor, " 1"]
    """Metres per unit."""
    has_depth: bool
    """Whether it was made from depth; without, units are metres by guess."""


class Framer:
    """Prepares frames of one camera.

    Args:
        network: whose input is prepared.
        camera: intrinsics of the letterboxed input.
        device: where the network runs.
    """

    def __init__(self, network: WindowNetwork[DecoderConfig], camera: Camera, *, device: torch.device) -> None:
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
        cells = cell_depth(depth, self._network.config.cell_px)
        centre, scale = reference_of(cells, self._intrinsics, self._network.config.encoder.image_size)
        return Reference(cam_from_world, centre, scale, bool((cells > 0).any()))

    def shows_depth(self, depth: Float[Tensor, "1 S S"]) -> bool:
        """Whether depth suffices to make a reference frame of it: more than specks."""
        return bool((cell_depth(depth, self._network.config.cell_px) > 0).any())

    def frame(
        self,
        rgb: UInt8[np.ndarray, "S S 3"],
        depth: Float[Tensor, "1 S S"],
        cam_from_world: Float[Tensor, "4 4"],
        reference: Reference,
        *,
        features: Tensor | None = None,
    ) -> FrameBatch:
        """A frame (B = T = 1).

        Args:
            rgb: the letterboxed image.
            depth: from :meth:`depth`.
            cam_from_world: the frame's pose.
            reference: the reference frame of its sequence.
            features: the encoder's tokens of this image, if they are known.
        """
        image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device)[None]
        pose = exact_product(reference.cam_from_world, invert(cam_from_world))
        return FrameBatch(
            features=self._network.encode(image)[:, None].float() if features is None else features,
            rgb=image[None],
            depth_m=depth[None],
            cell_depth_m=cell_depth(depth, self._network.config.cell_px)[None],
            intrinsics=self._intrinsics,
            ref_from_cam=pose.float().to(self._device)[None, None],
            center=reference.center,
            scale=reference.scale,
        )
