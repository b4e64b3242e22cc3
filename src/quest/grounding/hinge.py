"""The joint of a link whose front is seen turning.

A plane that turns about an axis keeps its distance from it. So where the axis lies follows from how the front of a link
stood at rest and how it stands now, and how far it has turned from its normal alone, also where a point on it is hidden
by the link itself or seen at a grazing angle.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from quest.geometry.vectors import cross, perpendicular, rotated
from quest.grounding.fit import joint_from_prior
from quest.grounding.joint import Joint, JointKind
from quest.grounding.prior import JointPrior

_STILL_RAD = 0.08
_STEP_RAD = 0.03
_FORGET = 0.3
_CAPACITY = 32
_LEAST_PLANES = 4
_LEAST_TURN_RAD = 0.25
_LEAST_WAY_SIGMAS = 1.5
_MOST_SHIFT = 0.08
_MOST_MISFIT = 2.0
_MISSED_SHARE = 0.25
_NORMAL_SIGMA_RAD = 0.04
_AXIS_SIGMA_RAD = 0.015
"""Of the axis' direction after a quarter of a turn; many normals say more of it than one says of a turn."""
_PLANE_SIGMA = 0.02
_FRONT_SIGMA = 0.03
"""How far before or behind its axis the front of a link lies, reference units."""
_POINT_SIGMAS = 1.5
_OFF_PLANE = 0.03
_THICKNESS = 0.08
_OFF_AXIS = 0.1
_ROUNDS = 4
_DIFFERENCE = 1e-5
_MOST_CONDITION = 1e12


@dataclass(frozen=True)
class Plane:
    """What is seen of a link around a place."""

    normal: Float[np.ndarray, "3"]
    """Unit normal."""
    middle: Float[np.ndarray, "3"]
    """A point of the plane."""
    behind: bool
    """Whether it is seen from the side that the normal points away from, so that it is the link's back."""


@dataclass(frozen=True)
class _Sights:
    """Frames in which a link is seen: the followed point, and normal and middle of the plane around it."""

    point: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    middle: Float[np.ndarray, "N 3"]


@dataclass(frozen=True)
class _Turning:
    """What was found."""

    joint: Joint
    """With q = 0 at rest."""
    belief: JointPrior
    """The same for one who has more to go by."""
    gap: float
    """Distance of the axis before the front."""
    bias: float
    """What is to be added to turns that the normals show, because that at rest is not exact either."""
    shift: float
    """Standard deviation of the axis' place."""


@dataclass(eq=False)
class HingeEstimator:
    """The axis about which the front of a link turns, and how far it has turned.

    Args:
        sigma: standard deviation of a point of the link per coordinate, reference units.
    """

    sigma: float
    _rest: Float[np.ndarray, "9"] | None = field(default=None, init=False)
    _at_rest: float = field(default=0.0, init=False)
    _rows: Float[np.ndarray, "N 9"] = field(default_factory=lambda: np.zeros((0, 9)), init=False)
    _found: _Turning | None = field(default=None, init=False)

    @property
    def joint(self) -> Joint | None:
        """The joint, with q = 0 at rest; None while nothing is known to have turned."""
        return None if self._found is None else self._found.joint

    @property
    def belief(self) -> JointPrior | None:
        """What it says of the joint to one who has more to go by."""
        return None if self._found is None else self._found.belief

    def add(self, point: Float[np.ndarray, "3"], plane: Plane) -> None:
        """Learn from a frame in which the link is seen.

        Args:
            point: the followed point.
            plane: the link's front around it.
        """
        row = np.concatenate((point, plane.normal, plane.middle))
        if self._rest is None:
            self._rest, self._at_rest = row, 1.0
            return
        if _angle(self._rest[None, 3:6], plane.normal)[0] < _STILL_RAD:
            if np.linalg.norm(point - self._rest[:3]) < 2 * self.sigma and not len(self._rows):
                self._at_rest += 1
                self._rest = _mixed(self._rest, row, 1 / min(self._at_rest, 16.0))
            return
        gap = _angle(self._rows[:, 3:6], plane.normal)
        if len(gap) and gap.min() < _STEP_RAD:
            self._rows[gap.argmin()] = _mixed(self._rows[gap.argmin()], row, _FORGET)
        else:
            self._rows = np.vstack((self._rows, row))[-_CAPACITY:]
        self._found = self._fit()

    def agrees(self, plane: Plane) -> bool:
        """Whether a plane can be the link's front, or its back; anything can while the axis is not known."""
        found = self._found
        if found is None or self._rest is None:
            return True
        off = plane.normal @ (found.joint.origin - plane.middle) - found.gap
        tilt = (plane.normal - self._rest[3:6]) @ found.joint.axis
        return bool(abs(off) < _OFF_PLANE + found.shift + plane.behind * _THICKNESS and abs(tilt) < _OFF_AXIS)

    def turned(self, normal: Float[np.ndarray, "3"]) -> float:
        """How far the link has turned from rest by a normal of its front; 0 while the axis is not known."""
        if self._found is None or self._rest is None:
            return 0.0
        return float(_turns(self._rest[3:6], normal[None], self._found.joint.axis)[0]) + self._found.bias

    def facing(self, q: float) -> Float[np.ndarray, "3"] | None:
        """The front's normal at a turn; None while the axis is not known."""
        if self._found is None or self._rest is None:
            return None
        return rotated(self._rest[3:6], self._found.joint.axis, q - self._found.bias)

    def _fit(self) -> _Turning | None:
        """The axis by Gauss-Newton steps; None where it is not known yet, or what is followed does not turn with it."""
        assert self._rest is not None
        rest = _Sights(*np.split(self._rest[None], 3, axis=1))
        seen = _Sights(*np.split(self._rows, 3, axis=1))
        front = rest.normal[0]
        across = cross(front, seen.normal)
        axis = np.linalg.eigh(across.T @ across)[1][:, -1]
        q = _turns(front, seen.normal, axis)
        if q[np.abs(q).argmax()] < 0:
            axis, q = -axis, -q
        tilted = np.median(np.abs((seen.normal - front) @ axis))
        if len(q) < _LEAST_PLANES or q.max() < _LEAST_TURN_RAD or tilted > _OFF_AXIS / 2:
            return None
        basis, x = perpendicular(axis), np.zeros(4)
        for _ in range(_ROUNDS):
            rows = self._misfits(x, axis, rest, seen, q)
            near = x + _DIFFERENCE * np.eye(4)
            slopes = np.stack([self._misfits(each, axis, rest, seen, q) - rows for each in near]) / _DIFFERENCE
            information = slopes @ slopes.T
            if not np.isfinite(information).all() or np.linalg.cond(information) > _MOST_CONDITION:
                return None
            x = x - np.linalg.solve(information, slopes @ rows)
        rows = self._misfits(x, axis, rest, seen, q)
        planes, points = np.abs(rows[: len(q) + 1]), np.hypot(*rows[len(q) + 1 : -2].reshape(2, -1))
        shift = float(np.sqrt(np.linalg.inv(information)[:2, :2].trace() / 2))
        sigma = _POINT_SIGMAS * self.sigma
        way = np.linalg.norm(x[:2]) * 2 * np.sin(np.abs(q) / 2) / sigma
        missed = points * self._point_sigma(len(q)) / sigma
        if shift > _MOST_SHIFT or way.max() < _LEAST_WAY_SIGMAS:
            return None
        if np.median(planes) > _MOST_MISFIT or np.median(missed - _MISSED_SHARE * way) > 1:
            return None
        at, tilt = rest.point[0], _AXIS_SIGMA_RAD / np.sin(min(q.max(), np.pi / 2))
        belief = JointPrior(0.99, axis, tilt, axis, tilt, at + basis @ x[:2], max(shift, _PLANE_SIGMA))
        joint = joint_from_prior(belief, at, kind=JointKind.REVOLUTE, rest_sigma=self.sigma / 2)
        q = q + x[3]
        joint = replace(joint, lower=float(min(q.min(), 0.0)), upper=float(q.max()), n=len(q))
        return _Turning(joint, belief, float(x[2]), float(x[3]), shift)

    def _misfits(self, x: np.ndarray, axis: np.ndarray, rest: _Sights, seen: _Sights, q: np.ndarray) -> np.ndarray:
        """Of planes, points and what is believed, in standard deviations.

        A plane keeps its distance d from the axis at o: n (o - middle) = d. A point is turned about it:
        (1 - R) (o - rest) = p - rest. All turns share an error, that of the normal at rest.

        Args:
            x: the axis' place across itself from the point at rest (2), d, and the shared error.
            axis: its direction.
            rest: the link at rest.
            seen: the link turned.
            q: turns by the normals.
        """
        basis, at = perpendicular(axis), rest.point[0]
        faces = np.vstack((rotated(rest.normal[0], axis, -x[3]), seen.normal))
        arm = basis @ x[:2] - (np.vstack((rest.middle, seen.middle)) - at)
        sigma = np.hypot(_PLANE_SIGMA, 0.5 * _NORMAL_SIGMA_RAD * np.linalg.norm(arm, axis=1))
        planes = ((faces * arm).sum(axis=1) - x[2]) / sigma
        c, s = 1 - np.cos(q + x[3]), np.sin(q + x[3])
        points = np.stack((c * x[0] + s * x[1], c * x[1] - s * x[0])) - ((seen.point - at) @ basis).T
        believed = (x[2] / _FRONT_SIGMA, x[3] / _NORMAL_SIGMA_RAD)
        return np.concatenate((planes, points.ravel() / self._point_sigma(len(q)), believed))

    def _point_sigma(self, n: int) -> float:
        """Of each of n points: errors of neighbouring frames are alike, so that many count as four."""
        return _POINT_SIGMAS * self.sigma * max(n / 4, 1.0) ** 0.5


def _mixed(old: np.ndarray, new: np.ndarray, share: float) -> np.ndarray:
    """Point, normal and middle, a share of the way from one to another."""
    row = old + share * (new - old)
    row[3:6] /= np.linalg.norm(row[3:6])
    return row


def _angle(normals: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip(normals @ normal, -1, 1))


def _turns(front: np.ndarray, normals: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Signed turns about an axis that bring one normal to others."""
    flat = front - (front @ axis) * axis
    return np.arctan2(cross(front, normals) @ axis, normals @ flat)
