"""What the network finds in a single frame: entities that can be taken hold of."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from quest.geometry.letterbox import Letterbox
from quest.model.discovery import Candidates, find_candidates
from quest.model.framing import Framer
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.model.precision import fast_bfloat16
from quest.types import Camera


class Finder:
    """Finds entities in frames of one camera.

    Args:
        network: the network, in evaluation mode.
        camera: intrinsics of the frames.
        device: where the network runs.

    Attributes:
        letterbox: between the source image and the network's input.
    """

    def __init__(self, network: QuestNetwork, camera: Camera, *, device: torch.device) -> None:
        self.letterbox = Letterbox(camera, network.config.encoder.image_size)
        self._network = network
        self._device = device
        self._framer = Framer(network, self.letterbox.camera, device=device)

    def prepare(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
    ) -> FrameBatch:
        """A frame (B = T = 1) as the network takes it, in a reference frame of its own.

        Args:
            rgb: colours.
            depth_m: metres, 0 where missing; None without depth.
        """
        depth = self._framer.depth(None if depth_m is None else self.letterbox.depth(depth_m))
        pose = torch.eye(4, dtype=torch.float64)
        return self._framer.frame(self.letterbox.rgb(rgb), depth, pose, self._framer.reference(depth, pose))

    def find(
        self, rgb: UInt8[np.ndarray, "H W 3"], depth_m: Float32[np.ndarray, "H W"] | None, *, radius_cells: float
    ) -> Candidates:
        """What may be an entity, in coordinates of the network's input.

        Args:
            rgb: colours.
            depth_m: metres, 0 where missing; None without depth.
            radius_cells: peaks of one label closer than this are one.
        """
        autocast = fast_bfloat16(self._device)
        with torch.inference_mode(), torch.autocast(self._device.type, torch.bfloat16, enabled=autocast):
            frames = self.prepare(rgb, depth_m)
            return find_candidates(self._network, frames, self._network.observe(frames), radius_cells=radius_cells)
