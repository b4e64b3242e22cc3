"""Thresholds that loss-free streams exceed with a probability of at most alpha.

Reference: Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005 (conformal prediction); Hosking and
Wallis, Parameter and quantile estimation for the generalized Pareto distribution, Technometrics 29, 1987 (the tail).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from quest.errors import ConfigError

TAIL_SHARE = 0.2
"""Share of the largest maxima that the tail is fitted to."""

LEAST_TAIL = 10
"""With fewer maxima than this in the tail, nothing is extrapolated: the threshold is infinite."""

_FIRST_BLOCK = 0.8
_HEAVIEST = 0.5
_MOST_HALVINGS = 900
"""More would end at zero, which is no probability."""


@dataclass(frozen=True)
class Threshold:
    """What the statistic has to exceed."""

    value: float
    """Infinite where too few streams were calibrated on to say anything."""
    alpha: float
    """Share of loss-free streams that may exceed it."""
    extrapolated: bool
    """Whether it lies beyond the resolution of the calibration streams, 1 / (n + 1)."""


def threshold(maxima: Float64[np.ndarray, " n"], alpha: float) -> Threshold:
    """The threshold at alpha: the maximum of rank ceil((n + 1)(1 - alpha)) among those of n loss-free streams.

    A new stream that is exchangeable with them exceeds it with a probability of at most alpha. Below alpha =
    1 / (n + 1) that rank does not exist; the threshold is then read off a generalised Pareto tail, which is a model
    and no guarantee, and flagged.

    Args:
        maxima: the largest value of the statistic in each stream, over queries and frames; ascending.
        alpha: in (0, 1).

    Raises:
        ConfigError: alpha is no probability, or there are no streams.
    """
    if not 0.0 < alpha < 1.0 or not len(maxima):
        raise ConfigError(f"threshold: expected 0 < alpha < 1 and at least one stream, got {alpha}, {len(maxima)}")
    n = len(maxima)
    rank = math.ceil(round((n + 1) * (1.0 - alpha), 9))  # rounded: 100 (1 - 0.01) must not become 99.00000001
    if rank <= n:
        return Threshold(float(maxima[rank - 1]), alpha, extrapolated=False)
    return Threshold(_tail_quantile(maxima, alpha), alpha, extrapolated=True)


@dataclass(frozen=True)
class Budget:
    """How often alarms may be false: with a probability of at most alpha, in a whole stream or in every so many frames.

    Raises:
        ConfigError: alpha is no probability, or there are no frames.
    """

    alpha: float
    """In (0, 1)."""
    frames: int | None = None
    """That alpha is for, again and again without an end; None for the whole stream, however long it becomes."""

    def __post_init__(self) -> None:
        if not 0.0 < self.alpha < 1.0:
            raise ConfigError(f"monitor: expected 0 < alpha < 1, got {self.alpha}")
        if self.frames is not None and not (isinstance(self.frames, int | np.integer) and self.frames >= 1):
            raise ConfigError(f"monitor: expected alpha_frames as a whole number >= 1, got {self.frames!r}")

    def __str__(self) -> str:
        return f"alpha {self.alpha:g}" + ("" if self.frames is None else f" in {self.frames} frames")

    def since(self, age: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
        """Frames since alpha was last given out, of those since the start or the restart: blocks count from there."""
        return age if self.frames is None else age % self.frames

    def part(self, *, block: int, restart: int, block_frames: int) -> float:
        """The part of alpha that one block of a query's watch may spend.

        For a whole stream the first block gets four fifths, and over all blocks the parts add up to
        ``alpha / 2**restart``. For so many frames, all blocks in these get the same.

        Args:
            block: 1, 2, ..., counted from the start of the stream, or from the restart where alpha is for all of it.
            restart: 0 before any alarm was cleared; the j-th restart of the stream has j.
            block_frames: length of a block, that of the calibration streams.
        """
        if self.frames is not None:
            return float(self.alpha) / -(-int(self.frames) // block_frames)
        share = _FIRST_BLOCK if block == 1 else (1 - _FIRST_BLOCK) / ((block - 1) * block)
        return math.ldexp(self.alpha * share, -min(restart, _MOST_HALVINGS))


def least_alpha(streams: int) -> float:
    """Smallest alpha of a stream that so many loss-free streams resolve in its first block, without a tail."""
    return 1 / (_FIRST_BLOCK * (streams + 1))


def _tail_quantile(maxima: np.ndarray, alpha: float) -> float:
    """Value that is exceeded with probability alpha, by probability-weighted moments of the excesses."""
    n = len(maxima)
    count = math.ceil(TAIL_SHARE * n)
    if count < LEAST_TAIL:
        return math.inf
    base = maxima[n - count - 1]
    excess = maxima[n - count :] - base
    mean = float(excess.mean())
    if mean <= 0.0:
        return float(maxima[-1])
    # The survival of the i-th of m ordered excesses is put at (m - i + 0.35) / m.
    survival = (count - np.arange(1, count + 1) + 0.35) / count
    weighted = float((survival * excess).mean())
    shape = 2.0 - mean / (mean - 2.0 * weighted)
    # A tail that ends (shape below 0) would be optimistic, one without variance (above a half) is noise of the fit.
    shape = min(max(shape, 0.0), _HEAVIEST)
    scale = mean * (1.0 - shape)
    odds = alpha * n / count
    rise = -math.log(odds) if shape < 1e-9 else (odds**-shape - 1.0) / shape
    return max(float(base) + scale * rise, float(maxima[-1]))
