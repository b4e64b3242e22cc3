"""CoTracker3 by its authors' code.

Reference: Karaev et al., CoTracker3: Simpler and Better Point Tracking by Pseudo-Labelling Real Videos, 2024. Its
predictors do the resizing (384 x 512) and have the thresholds of visibility; pixel centres there lie at integers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int, UInt8

from quest.baselines.official import Official, import_code
from quest.baselines.point_queries import Followed, PointTracker
from quest.types import Clip


class CoTracker(Official, PointTracker):
    """All points together, and the grid of 6 x 6 that supports them; confidence is 1 where a point is visible.

    Online it sees windows of 16 frames, 8 further each time, so that an answer looks at most 15 frames ahead; else the
    whole clip at once.
    """

    def __init__(self, name: str, rivals: Path, *, online: bool) -> None:
        code = import_code(rivals / "co-tracker", "cotracker.predictor")
        self.predictor = (code.CoTrackerOnlinePredictor if online else code.CoTrackerPredictor)(checkpoint=None)
        super().__init__(name, rivals, self.predictor.model)
        self.online = online

    @torch.no_grad()
    def follow(self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]) -> Followed:
        """In windows, or the whole clip at once."""
        asked = torch.from_numpy(np.column_stack((first, uv_first - 0.5)).astype(np.float32))[None].to(self.device)
        if self.online:
            tracks, visible = self._windows(clip.rgb, asked)
        else:
            tracks, visible = self.predictor(self._video(clip.rgb), queries=asked)
        seen = visible[0, : len(clip)].cpu().numpy().astype(bool)
        return tracks[0, : len(clip)].float().cpu().numpy() + np.float32(0.5), seen, seen.astype(np.float32)

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
