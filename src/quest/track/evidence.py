"""What one frame says of places where a hidden query could be."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from quest.model.config import NetworkConfig
from quest.model.decoder import sample_grid
from quest.model.observation import FrameBatch

_TOLERANCE = 0.06


class Evidence:
    """The newest frame as seen from points of the reference frame.

    Args:
        frames: the newest frame (B = T = 1).
        log_p: log probability of every cell of the heatmap.
        config: the network's.
    """

    def __init__(self, frames: FrameBatch, log_p: Float[Tensor, " C"], config: NetworkConfig) -> None:
        self._frames = frames
        self._log_p = log_p
        self._config = config

    def score(self, point: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """Log probability of the heatmap where points project to; NaN outside the image."""
        uv_px = self._frames.from_reference(self._tensor(point))[0]
        uv = uv_px / self._config.encoder.image_size
        inside = ((uv >= 0) & (uv <= 1)).all(-1)
        value = sample_grid(self._log_p[None, :, None], uv.nan_to_num(0.5), self._config.cells).squeeze(-1)
        return torch.where(inside, value, torch.nan)[0].cpu().double().numpy()

    def covers(self, point: Float[np.ndarray, "3"]) -> bool:
        """Whether something is seen well before a point."""
        return bool(self.room(point[None])[0] < -_TOLERANCE)

    def free(self, point: Float[np.ndarray, "M 3"]) -> Bool[np.ndarray, " M"]:
        """Whether one looks through points: what is seen lies well behind them."""
        return self.room(point) > _TOLERANCE

    def room(self, point: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """How far what is seen lies behind points along +z, reference units; NaN where nothing is known."""
        at = self._tensor(point)
        seen_m = self._frames.near_depth_at(self._frames.from_reference(at))[0, 0]
        gap = (seen_m - self._frames.to_camera(at)[0, 0, :, 2]) / self._frames.scale[0]
        return torch.where(seen_m > 0, gap, torch.nan).cpu().double().numpy()

    def _tensor(self, point: np.ndarray) -> Tensor:
        return torch.from_numpy(point).to(self._frames.depth_m)[None, None]
