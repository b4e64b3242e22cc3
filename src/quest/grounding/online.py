"""Fits a joint to a track as it grows, in bounded memory and time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from quest.errors import InputError
from quest.grounding.fit import fit_joint
from quest.grounding.joint import Joint, JointKind
from quest.grounding.prior import JointPrior

_MERGE_SIGMAS = 0.7
_MOST_COUNTED = 4.0
_NEW_PLACES = 4
_FEW_PLACES = 12
_AS_EXPECTED_SIGMAS = 3.0
_OUTLIER_SIGMAS = 5.0
_MOST_OUTLIERS = 0.25
_FURTHER = 0.1


@dataclass(eq=False)
class JointEstimator:
    """The joint of a track that is seen point by point.

    Points nearer to each other than a fraction of the noise become one, their mean; so a long stand-still does not
    crowd out the motion, and a mean counts at most as four points, because errors of neighbouring frames are alike.
    A point where the joint says that it is, among those that were seen, waits for three others before the joint is
    fitted again.

    Args:
        sigma: standard deviation of a point per coordinate.
        capacity: most points that are kept; of more, the two nearest become one, or the oldest of many outliers goes.
    """

    sigma: float
    capacity: int = field(default=64, kw_only=True)
    prior: JointPrior | None = field(default=None, init=False)
    """What is believed besides the track; takes effect at the next fit."""
    _points: Float[np.ndarray, "N 3"] = field(default_factory=lambda: np.zeros((0, 3)), init=False)
    _counts: Float[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0), init=False)
    _waiting: int = field(default=0, init=False)
    _stale: bool = field(default=False, init=False)
    _joint: Joint | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma > 0) or self.capacity < 4:
            raise InputError(
                f"joint: expected a positive sigma and a capacity of 4 or more, got {self.sigma}, {self.capacity}"
            )

    @property
    def joint(self) -> Joint | None:
        """The joint that explains the points so far; None without any. Fitted when something new is known."""
        if self._stale:
            sigma = self.sigma / np.sqrt(np.minimum(self._counts, _MOST_COUNTED))
            self._joint = fit_joint(self._points, sigma, prior=self.prior, near=self._joint)
            self._stale, self._waiting = False, 0
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
            if gap[near] < _MERGE_SIGMAS * self.sigma:
                self._merge(near, point)
                return
        self._points = np.vstack((self._points, point))
        self._counts = np.append(self._counts, 1.0)
        self._tell(not self._as_expected(point))
        if len(self._points) > self.capacity:
            self._make_room()

    def believe(self, prior: JointPrior) -> None:
        """Take another belief for the one there was, which was wrong: the joint is fitted again at once."""
        self.prior, self._stale = prior, len(self._points) > 0

    def _tell(self, urgent: bool) -> None:
        """Something new is known; it waits for more of its kind unless it is urgent."""
        self._waiting += 1
        self._stale |= urgent or self._waiting >= _NEW_PLACES

    def _as_expected(self, point: np.ndarray) -> bool:
        """Whether the joint explains a point well, and has been seen to go nearly as far."""
        joint = self._joint
        if joint is None or len(self._points) < _FEW_PLACES:
            return False
        q = joint.locate(point[None])
        further = _FURTHER * (joint.upper - joint.lower)
        seen = joint.lower - further <= q[0] <= joint.upper + further
        return bool(seen and np.linalg.norm(point - joint.at(q)[0]) < _AS_EXPECTED_SIGMAS * self.sigma)

    def _merge(self, index: int, point: np.ndarray) -> None:
        # A running mean that forgets, so that the memory of a long stand-still stays as mobile as a short one's.
        count = self._counts[index] + 1
        self._points[index] += (point - self._points[index]) / min(count, 16.0)
        self._counts[index] = count
        if count <= _MOST_COUNTED:
            self._tell(not self._as_expected(point))

    def _make_room(self) -> None:
        if self._joint is not None and self._joint.kind is not JointKind.STATIC:
            gap = np.linalg.norm(self._points - self._joint.at(self._joint.locate(self._points)), axis=1)
            off = np.flatnonzero(gap[:-1] > _OUTLIER_SIGMAS * self.sigma)
            if len(off) > _MOST_OUTLIERS * len(gap):
                self._drop(int(off[0]))
                return
        gap = np.linalg.norm(self._points[:, None] - self._points[None], axis=-1)
        np.fill_diagonal(gap, np.inf)
        first, second = sorted(int(i) for i in np.unravel_index(int(gap.argmin()), gap.shape))
        weight = self._counts[[first, second]]
        self._points[first] = weight @ self._points[[first, second]] / weight.sum()
        self._counts[first] = weight.sum()
        self._drop(second)

    def _drop(self, index: int) -> None:
        self._points = np.delete(self._points, index, axis=0)
        self._counts = np.delete(self._counts, index)
