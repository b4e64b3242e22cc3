"""The frames of a recorded clip as a network takes them, for baselines that look at them with QueST's network."""

from __future__ import annotations

from collections import deque

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from quest.geometry.letterbox import Letterbox
from quest.model.framing import Framer
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.types import Clip


class ClipFrames:
    """Prepares and observes the frames of one clip in order, as the tracker does with a stream.

    The reference frame is that of the first frame with depth, more than specks; of the first frame if there is none.

    Args:
        network: whose input is prepared.
        clip: the frames.
        device: where the network runs.

    Attributes:
        letterbox: between the source image and the network's input.
        scale_m: metres per unit of the reference frame.
    """

    def __init__(self, network: QuestNetwork, clip: Clip, *, device: torch.device) -> None:
        self.letterbox = Letterbox(clip.camera, network.config.encoder.image_size)
        self._network = network
        self._clip = clip
        self._device = device
        self._window: deque[Observation] = deque(maxlen=network.config.window)
        self._framer = Framer(network, self.letterbox.camera, device=device)
        with_depth = range(0 if clip.depth_m is None else len(clip))
        first = next((t for t in with_depth if self._framer.shows_depth(self._depth(t))), 0)
        self._cam_from_world = torch.from_numpy(np.ascontiguousarray(clip.cam_from_world)).double()
        self._reference = self._framer.reference(self._depth(first), self._cam_from_world[first])
        self.scale_m = float(self._reference.scale[0])

    def see(self, t: int) -> tuple[FrameBatch, Observation]:
        """Frame ``t`` (B = T = 1) and what the network observes in it.

        Frames that are seen in order make up the window of :meth:`window`; some may be left out.
        """
        frames = self._framer.frame(
            self.letterbox.rgb(self._clip.rgb[t]), self._depth(t), self._cam_from_world[t], self._reference
        )
        observed = self._network.observe(frames)
        while len(self._window) < self._network.config.window - 1:
            self._window.append(observed)
        self._window.append(observed)
        return frames, observed

    def window(self) -> Observation:
        """The newest frames that were seen, oldest first; before there are enough the first one is repeated."""
        return Observation.stack(list(self._window))

    def to_source(self, uv: Float[Tensor, "K 2"]) -> Float32[np.ndarray, "K 2"]:
        """Source pixels of coordinates in [0, 1]^2 of the input."""
        uv_px = uv.float().cpu().numpy() * np.float32(self.letterbox.size)
        return self.letterbox.to_source(uv_px).astype(np.float32)

    def to_input(self, uv_px: Float32[np.ndarray, "K 2"]) -> Float[Tensor, "K 2"]:
        """Coordinates in [0, 1]^2 of the input of source pixels."""
        uv = self.letterbox.to_canvas(uv_px) / self.letterbox.size
        return torch.from_numpy(uv.astype(np.float32)).to(self._device)

    def to_world(self, displacement: Float[Tensor, "K 3"]) -> Float[np.ndarray, "K 3"]:
        """Displacements of the reference frame in the world, metres."""
        metric = displacement.cpu().double() * self.scale_m
        # The transposed rotation, from the right.
        return (metric @ self._reference.cam_from_world[:3, :3]).numpy()

    def to_reference(self, point_world: Float[np.ndarray, "K 3"]) -> Float[Tensor, "K 3"]:
        """World points in the reference frame."""
        pose = self._reference.cam_from_world
        point = torch.from_numpy(point_world).double() @ pose[:3, :3].mT + pose[:3, 3]
        return ((point - self._reference.center[0].cpu().double()) / self.scale_m).float().to(self._device)

    def _depth(self, t: int) -> Float[Tensor, "1 S S"]:
        depth_m = self._clip.depth_m
        return self._framer.depth(None if depth_m is None else self.letterbox.depth(depth_m[t]))
