"""CoTracker3 by its authors' code.

Reference: Karaev et al., CoTracker3: Simpler and Better Point Tracking by Pseudo-Labelling Real Videos, 2024. Its
predictors do the resizing (384 x 512) and have the thresholds of visibility; pixel centres there lie at integers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from quest.baselines.official import OfficialClip, import_code

_HALF_PX = np.array((0.0, 0.5, 0.5), np.float32)


class CoTracker(OfficialClip):
    """All points together, and the grid of 6 x 6 that supports them.

    Args:
        name: what tables call it.
        rivals: the folder of code and weights.
        online: whether windows of 16 frames are seen, 8 further each time, so that an answer looks at most 15 frames
            ahead; else the whole clip is seen at once.
        device: as of :func:`quest.load`.
    """

    def __init__(self, name: str, rivals: Path, *, online: bool, device: str = "auto") -> None:
        code = import_code(rivals / "co-tracker", "cotracker.predictor")
        self.predictor = (code.CoTrackerOnlinePredictor if online else code.CoTrackerPredictor)(checkpoint=None)
        super().__init__(name, rivals, self.predictor.model, device=device)
        self.online = online

    @torch.no_grad()
    def follow(
        self, rgb: UInt8[np.ndarray, "T H W 3"], queries: Float32[np.ndarray, "K 3"]
    ) -> tuple[Float32[np.ndarray, "T K 2"], Bool[np.ndarray, "T K"], Float32[np.ndarray, "T K"]]:
        """Confidence is 1 where the point is visible."""
        asked = torch.from_numpy(queries - _HALF_PX)[None].to(self.device)
        tracks, visible = (self._windows if self.online else self._whole)(rgb, asked)
        seen = visible[0, : len(rgb)].cpu().numpy().astype(bool)
        return tracks[0, : len(rgb)].float().cpu().numpy() + _HALF_PX[1:], seen, seen.astype(np.float32)

    def _whole(self, rgb: UInt8[np.ndarray, "T H W 3"], asked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.predictor(self._video(rgb), queries=asked)

    def _windows(self, rgb: UInt8[np.ndarray, "T H W 3"], asked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        step = self.predictor.step
        # There is no answer to fewer frames than one step and the next frame: the last one stands still.
        rgb = np.pad(rgb, ((0, max(0, step + 1 - len(rgb))), (0, 0), (0, 0), (0, 0)), mode="edge")
        self.predictor(self._video(rgb[:1]), is_first_step=True, queries=asked, add_support_grid=True)
        windows = [rgb[start : start + 2 * step] for start in range(0, len(rgb) - step, step)]
        # Each answer is to all frames so far.
        return [self.predictor(self._video(window), add_support_grid=True) for window in windows][-1]

    def _video(self, rgb: UInt8[np.ndarray, "T H W 3"]) -> Float32[torch.Tensor, "1 T 3 H W"]:
        """Colours from 0 to 255."""
        return torch.from_numpy(np.ascontiguousarray(rgb)).to(self.device).permute(0, 3, 1, 2)[None].float()
