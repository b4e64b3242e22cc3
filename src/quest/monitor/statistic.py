"""Sequential statistics: evidence collected over frames, per query.

All have one interface, so that the monitor and the rules that it is compared with differ in nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from quest.errors import ConfigError

Evidence = Float64[np.ndarray, " N"]
Memory = Float64[np.ndarray, "N R"]


@runtime_checkable
class Statistic(Protocol):
    """Collects evidence; the larger, the more it speaks for a loss."""

    size: ClassVar[int]
    """Numbers that are remembered per query."""

    def update(self, state: Memory, evidence: Evidence) -> tuple[Memory, Evidence]:
        """The new state and the value of the statistic, from the state of the frame before; zeros at the start."""
        ...


@dataclass(frozen=True)
class Cusum:
    """The cumulative sum that is never negative: ``s = max(0, keep s + evidence - drift)``.

    Reference: Page, Continuous inspection schemes, Biometrika 41, 1954. ``keep`` below 1 forgets, which bounds what a
    long and faint suspicion can add up to.
    """

    drift: float
    """Evidence that a frame without a loss may have."""
    keep: float = 1.0
    """Share of the sum that the next frame keeps, in [0, 1]."""
    size: ClassVar[int] = 1

    def __post_init__(self) -> None:
        if not np.isfinite(self.drift) or not 0.0 <= self.keep <= 1.0:
            raise ConfigError(f"statistic: expected a finite drift and 0 <= keep <= 1, got {self.drift}, {self.keep}")

    def most(self, evidence: float, frames: int) -> float:
        """What the sum never exceeds in so many frames from its start, where none has more evidence."""
        rise = max(0.0, evidence - self.drift)
        return rise * (frames if self.keep == 1.0 else (1.0 - self.keep**frames) / (1.0 - self.keep))

    def update(self, state: Memory, evidence: Evidence) -> tuple[Memory, Evidence]:
        """Take in one frame."""
        value = np.maximum(0.0, self.keep * state[:, 0] + evidence - self.drift)
        return value[:, None], value


@dataclass(frozen=True)
class PageHinkley:
    """Rise of the evidence above its own running mean: ``m_t - min m``, ``m_t = sum of (x_i - mean_i - delta)``.

    Reference: Hinkley, Inference about the change-point from cumulative sum tests, Biometrika 58, 1971; in the form
    that is usual for streams (Gama et al., A survey on concept drift adaptation, 2014, section 3.3.1).
    """

    delta: float
    """Rise above the mean that is tolerated in a frame."""
    size: ClassVar[int] = 4

    def update(self, state: Memory, evidence: Evidence) -> tuple[Memory, Evidence]:
        """Take in one frame."""
        count, mean, total, least = state.T
        count = count + 1.0
        mean = mean + (evidence - mean) / count
        total = total + evidence - mean - self.delta
        least = np.minimum(least, total)
        return np.stack([count, mean, total, least], axis=1), total - least


@dataclass(frozen=True)
class Latest:
    """No memory: the evidence of the frame itself, which makes an alarm a threshold on it."""

    size: ClassVar[int] = 0

    def update(self, state: Memory, evidence: Evidence) -> tuple[Memory, Evidence]:
        """Take in one frame."""
        return state, evidence
