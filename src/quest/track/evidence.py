"""What one frame says of places where a query could be."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from quest.model.config import NetworkConfig
from quest.model.decoder import sample_grid
from quest.model.observation import FrameBatch


@runtime_checkable
class Evidence(Protocol):
    """What a frame says of places in the reference frame."""

    def ratio(self, point: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """Log of how much likelier than a cell by chance each place is to show the query; NaN outside the image."""
        ...

    def room(self, point: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """How far what is seen lies behind each place, reference units; NaN where nothing is known."""
        ...


class FrameEvidence:
    """The newest frame as seen from points of the reference frame.

    Args:
        frames: the newest frame (B = T = 1).
        log_p: log probability of every cell of the heatmap.
        config: the network's.
        picture_px: left, top, right and bottom edge of the image on the network's input; what is beyond is padding.
    """

    def __init__(
        self,
        frames: FrameBatch,
        log_p: Float[Tensor, " C"],
        config: NetworkConfig,
        picture_px: tuple[float, float, float, float],
    ) -> None:
        self._frames = frames
        self._log_p = log_p
        self._config = config
        self._corners_px = torch.tensor(picture_px, device=log_p.device).view(2, 2)

    def ratio(self, point: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """Log of how much likelier than a cell by chance each place is to show the query; NaN outside the image."""
        uv_px = self._frames.from_reference(self._tensor(point))[0]
        uv = uv_px / self._config.encoder.image_size
        inside = ((uv_px >= self._corners_px[0]) & (uv_px <= self._corners_px[1])).all(-1)
        value = sample_grid(self._log_p[None, :, None], uv.nan_to_num(0.5), self._config.cells).squeeze(-1)
        value = torch.where(inside, value, torch.nan)[0].cpu().double().numpy()
        return value + math.log(self._config.cells**2)

    def room(self, point: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """How far what is seen lies behind each place along +z, reference units; NaN where nothing is known."""
        at = self._tensor(point)
        seen_m = self._frames.near_depth_at(self._frames.from_reference(at))[0, 0]
        gap = (seen_m - self._frames.to_camera(at)[0, 0, :, 2]) / self._frames.scale[0]
        return torch.where(seen_m > 0, gap, torch.nan).cpu().double().numpy()

    def _tensor(self, point: np.ndarray) -> Tensor:
        return torch.from_numpy(point).to(self._frames.depth_m)[None, None]
