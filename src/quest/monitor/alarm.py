"""What the monitor says when a query has probably begun to follow something else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class Alarm:
    """The identity of a query is probably lost.

    Attributes:
        name: the query's name.
        query: the query's key.
        frame: frame in which the alarm was raised.
        stamp_s: time of that frame, seconds.
        statistic: the query's statistic in that frame.
        threshold: what it exceeded.
        alpha: the share of loss-free streams that may alarm; how the threshold was chosen.
        reason: the signals that speak most for a loss, in words.
        extrapolated: whether the threshold lies beyond what the calibration streams can support by themselves and was
            read off a fitted tail.
    """

    name: str
    query: int
    frame: int
    stamp_s: float
    statistic: float
    threshold: float
    alpha: float
    reason: str
    extrapolated: bool = False


@dataclass(frozen=True)
class Verdict:
    """What the monitor makes of one frame; rows in the order of the keys that were asked.

    Attributes:
        lost_p: calibrated probability that the identity is lost.
        statistic: the sequential statistic, which an alarm compares with its threshold.
        open: the alarm of each query that has been raised and not cleared, or None.
        raised: alarms raised in this frame.
    """

    lost_p: Float32[np.ndarray, " K"]
    statistic: Float32[np.ndarray, " K"]
    open: tuple[Alarm | None, ...]
    raised: tuple[Alarm, ...]
