"""Fits a joint to a track as it grows, in bounded memory and time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from quest.errors import InputError
from quest.grounding.fit import fit_joint
from quest.grounding.joint import Joint
from quest.grounding.prior import JointPrior

_MERGE_SIGMAS = 0.7
_MOST_COUNTED = 4.0


class JointEstimator:
    """The joint of a track that is seen point by point.

    Points nearer to each other than a fraction of the noise become one, their mean; so a long stand-still does not
    crowd out the motion, and a mean counts at most as four points, because errors of neighbouring frames are alike.

    Args:
        sigma: standard deviation of a point per coordinate.
        capacity: most points that are kept; of more, the two nearest become one.

    Attributes:
        prior: what is believed besides the track; takes effect at the next fit.
    """

    def __init__(self, sigma: float, *, capacity: int = 64) -> None:
        if not (np.isfinite(sigma) and sigma > 0) or capacity < 4:
            raise InputError(f"joint: expected a positive sigma and a capacity of 4 or more, got {sigma}, {capacity}")
        self.prior: JointPrior | None = None
        self._sigma = sigma
        self._capacity = capacity
        self._points = np.zeros((0, 3))
        self._counts = np.zeros(0)
        self._stale = False
        self._joint: Joint | None = None

    @property
    def joint(self) -> Joint | None:
        """The joint that explains the points so far; None without any. Fitted when something new is known."""
        if self._stale:
            sigma = self._sigma / np.sqrt(np.minimum(self._counts, _MOST_COUNTED))
            self._joint = fit_joint(self._points, sigma, prior=self.prior)
            self._stale = False
        return self._joint

    def add(self, point: Float[np.ndarray, "3"]) -> None:
        """Take the next point.

        Raises:
            InputError: the point is not finite.
        """
        if np.shape(point) != (3,) or not np.isfinite(point).all():
            raise InputError(f"joint: expected a finite point, got {point}; leave out what is not seen")
        if len(self._points):
            gap = np.linalg.norm(self._points - point, axis=1)
            near = int(gap.argmin())
            if gap[near] < _MERGE_SIGMAS * self._sigma:
                self._merge(near, point)
                return
        self._points = np.vstack((self._points, point))
        self._counts = np.append(self._counts, 1.0)
        self._stale = True
        if len(self._points) > self._capacity:
            self._join_nearest()

    def _merge(self, index: int, point: np.ndarray) -> None:
        # A running mean that forgets, so that the memory of a long stand-still stays as mobile as a short one's.
        count = self._counts[index] + 1
        self._points[index] += (point - self._points[index]) / min(count, 16.0)
        self._counts[index] = count
        self._stale |= count <= _MOST_COUNTED

    def _join_nearest(self) -> None:
        gap = np.linalg.norm(self._points[:, None] - self._points[None], axis=-1)
        np.fill_diagonal(gap, np.inf)
        first, second = sorted(np.unravel_index(int(gap.argmin()), gap.shape))
        weight = self._counts[[first, second]]
        self._points[first] = weight @ self._points[[first, second]] / weight.sum()
        self._counts[first] = weight.sum()
        self._points = np.delete(self._points, second, axis=0)
        self._counts = np.delete(self._counts, second)
