"""What the monitor says when a query has probably begun to follow something else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class Alarm:
    """The identity of a query is probably lost."""

    name: str
    """The query's name."""
    query: int
    """The query's key."""
    frame: int
    """Frame in which the alarm was raised."""
    stamp_s: float
    """Time of that frame, seconds."""
    statistic: float
    """The query's statistic in that frame."""
    threshold: float
    """What it exceeded."""
    alpha: float
    """The share of loss-free streams that may alarm; how the threshold was chosen."""
    reason: str
    """What speaks for a loss, in words."""
    extrapolated: bool = False
    """Whether the threshold lies beyond what the calibration streams can support by themselves and was read off a
    fitted tail."""


@dataclass(frozen=True)
class Verdict:
    """What the monitor makes of one frame; rows in the order of the keys that were asked."""

    lost_p: Float32[np.ndarray, " K"]
    """Calibrated probability that the identity is lost; NaN of queries that rest."""
    statistic: Float32[np.ndarray, " K"]
    """The sequential statistic, which an alarm compares with its threshold."""
    open: tuple[Alarm | None, ...]
    """The alarm of each query that has been raised and not cleared, or None."""
    raised: tuple[Alarm, ...]
    """Alarms raised in this frame."""
    cleared: tuple[Alarm, ...]
    """Alarms that ended in this frame."""
