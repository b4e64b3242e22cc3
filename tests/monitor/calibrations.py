"""Monitors that need no fitting."""

from __future__ import annotations

import numpy as np

from quest.monitor import Budget, Calibration
from quest.monitor.statistic import Cusum
from quest.track.settings import REVISION


def share(alpha: float, *, block: int, restart: int) -> float:
    """What a block may spend where alpha is for a whole stream."""
    return Budget(alpha).part(block=block, restart=restart, block_frames=60)


def watching(
    *,
    slope: float = 1.0,
    shift: float = 0.0,
    statistic: Cusum = Cusum(0.0),  # noqa: B008
    maxima: np.ndarray | None = None,
    block_frames: int = 20,
) -> Calibration:
    """The tracker's log odds as they are, summed up."""
    maxima = np.linspace(0.0, 10.0, 1000) if maxima is None else maxima
    return Calibration(slope, shift, statistic, maxima, block_frames, "made up", REVISION)
