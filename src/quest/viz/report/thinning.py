"""Fewer frames than there are, for plots: no peak, no loss and no alarm is left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

MOST_BINS = 1000
"""Per line: about as many as a screen is wide, in pixels."""
_MOST_TOGETHER = 64 * MOST_BINS
_FEWEST_BINS = 50


@dataclass(frozen=True)
class Thinning:
    """Frames in bins of equal length; without need for it every frame is a bin of its own."""

    frames: int
    """How many there are."""
    width: int
    """Frames in a bin; the last may have fewer."""

    @classmethod
    def of(cls, frames: int, lines: int) -> Thinning:
        """Bins that keep a page with so many lines bounded."""
        bins = max(_FEWEST_BINS, min(MOST_BINS, _MOST_TOGETHER // max(lines, 1)))
        return cls(frames, -(-frames // bins))

    def starts(self) -> Int[np.ndarray, " B"]:
        """First frame of each bin."""
        return np.arange(0, self.frames, self.width)

    def every(self) -> Int[np.ndarray, " N"]:
        """One frame per bin, and the last one."""
        return np.unique([*self.starts(), self.frames - 1])

    def extremes(self, values: Float[np.ndarray, " T"]) -> Int[np.ndarray, " N"]:
        """Frames with the smallest and the largest value of each bin; NaN where a bin has nothing else."""
        lost = np.isnan(values)
        low = self._binned(np.where(lost, np.inf, values), np.inf).argmin(axis=1)
        high = self._binned(np.where(lost, -np.inf, values), -np.inf).argmax(axis=1)
        return np.unique(np.concatenate([self.starts() + low, self.starts() + high]))

    def largest(self, values: Shaped[np.ndarray, " T"]) -> Shaped[np.ndarray, " B"]:
        """Largest of the values of each bin, which are not negative."""
        return self._binned(values, 0).max(axis=1)

    def _binned(self, values: np.ndarray, fill: float) -> np.ndarray:
        padded = np.full(len(self.starts()) * self.width, fill, dtype=values.dtype)
        padded[: self.frames] = values
        return padded.reshape(-1, self.width)
