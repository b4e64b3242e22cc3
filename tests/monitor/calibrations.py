"""Monitors that need no fitting."""

from __future__ import annotations

import numpy as np

from quest.monitor import SIGNALS, Budget, Calibration
from quest.monitor import memory as memories
from quest.monitor.calibrator import Calibrator
from quest.monitor.statistic import Cusum
from quest.track.settings import REVISION


def make_calibrator(*, hidden: int = 3, members: int = 2, seed: int = 0) -> Calibrator:
    """Random weights, none of which is trivial."""
    rng = np.random.default_rng(seed)
    return Calibrator(
        center=rng.normal(size=len(SIGNALS)),
        scale=0.5 + rng.random(len(SIGNALS)),
        direct=0.1 * rng.normal(size=(members, memories.FEATURES)),
        inner=0.1 * rng.normal(size=(members, memories.FEATURES, hidden)),
        inner_bias=rng.normal(size=(members, hidden)),
        outer=rng.normal(size=(members, hidden)),
        bias=rng.normal(size=members),
    )


def share(alpha: float, *, block: int, restart: int) -> float:
    """What a block may spend where alpha is for a whole stream."""
    return Budget(alpha).part(block=block, restart=restart, block_frames=60)


def watching(name: str, *, gain: float = -2.0, maxima: np.ndarray | None = None, block_frames: int = 20) -> Calibration:
    """Log odds are ``gain`` times one signal's present squashed value, summed up."""
    direct = np.zeros((1, memories.FEATURES))
    direct[0, SIGNALS.index(name)] = gain
    calibrator = Calibrator(
        center=np.zeros(len(SIGNALS)),
        scale=np.full(len(SIGNALS), 0.5),
        direct=direct,
        inner=np.zeros((1, memories.FEATURES, 0)),
        inner_bias=np.zeros((1, 0)),
        outer=np.zeros((1, 0)),
        bias=np.zeros(1),
    )
    maxima = np.linspace(0.0, 10.0, 1000) if maxima is None else maxima
    return Calibration(calibrator, Cusum(0.0), maxima, block_frames, "made up", REVISION)
