"""The joint of each query, read off its body: the screw that the body went along, and how well it is known.

Reference: Sturm, Stachniss and Burgard, A Probabilistic Framework for Learning Kinematic Models of Articulated Objects,
JAIR 2011, section 4, for the three kinds; Schwarz, Estimating the Dimension of a Model, 1978, for the choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from quest.filter.bodies import Bodies, at_arm
from quest.filter.landmarks import Landmarks
from quest.filter.noise import Noise
from quest.filter.queries import Queries
from quest.filter.surfaces import depth_error
from quest.geometry.vectors import perpendicular


class JointKind(StrEnum):
    """How a joint moves."""

    STATIC = "static"
    PRISMATIC = "prismatic"
    REVOLUTE = "revolute"


@dataclass(frozen=True)
class Joint:
    """The joint that moves a point, in the world."""

    kind: JointKind
    """How it moves."""
    axis: Float[np.ndarray, "3"]
    """Unit direction of sliding, or of the axis of turning (right-handed); positive to where it went farthest."""
    origin: Float[np.ndarray, "3"]
    """Point of the axis of turning nearest to ``rest``; equal to ``rest`` for other kinds, metres."""
    rest: Float[np.ndarray, "3"]
    """Where the point is at q = 0, metres."""
    lower: float
    """Smallest q seen, metres or radians; turns are told within half a turn either way from ``rest``."""
    upper: float
    """Largest q seen."""
    covariance: Float[np.ndarray, "P P"]
    """Of small changes, in the basis of :func:`quest.geometry.vectors.perpendicular`. Of a joint that moves: tilt of
    the axis (2, radians) and shift of ``origin`` across it (2, metres). Static: shift (3, metres)."""

    @property
    def radius(self) -> float:
        """Distance of the point from the axis of turning, metres; 0 for other kinds."""
        return float(np.linalg.norm(self.rest - self.origin))

    @property
    def axis_sigma_rad(self) -> float:
        """Standard deviation of the axis' direction about each of two perpendicular directions; NaN if static."""
        if self.kind is JointKind.STATIC:
            return float("nan")
        return float(np.sqrt(np.trace(self.covariance[:2, :2]) / 2))

    @property
    def line_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of small errors of ``axis`` (3, radians) and ``origin`` (3, metres) together.

        It is :attr:`covariance` in the world's axes: of rank 4, because errors along the axis are none. Of a static
        joint the part of the axis is NaN.
        """
        if self.kind is JointKind.STATIC:
            found = np.full((6, 6), np.nan)
            found[3:, 3:] = self.covariance
            return found
        across = np.zeros((6, 4))
        across[:3, :2] = across[3:, 2:] = perpendicular(self.axis)
        return across @ self.covariance @ across.T

    def at(self, q: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """Points of the curve on which the joint moves the point."""
        if self.kind is JointKind.STATIC:
            return np.repeat(self.rest[None], len(q), axis=0)
        if self.kind is JointKind.PRISMATIC:
            return self.rest + q[:, None] * self.axis
        arm = self.rest - self.origin
        return self.origin + np.cos(q)[:, None] * arm + np.sin(q)[:, None] * np.cross(self.axis, arm)

    def locate(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Coordinate q of the nearest point of the curve; within [-pi, pi] for turning, 0 for a static point."""
        if self.kind is JointKind.STATIC:
            return np.zeros(len(points))
        if self.kind is JointKind.PRISMATIC:
            return (points - self.rest) @ self.axis
        arm = self.rest - self.origin
        offset = points - self.origin
        return np.arctan2(offset @ np.cross(self.axis, arm), offset @ arm)

    def moved(self, pose: Float[np.ndarray, "4 4"]) -> Joint:
        """The same joint in another world frame, by the rigid motion from this one to that."""
        rotation, shift = pose[:3, :3], pose[:3, 3]
        axis = rotation @ self.axis
        change = rotation
        if self.kind is not JointKind.STATIC:
            # The turned basis is not that of the turned axis.
            change = np.kron(np.eye(2), perpendicular(axis).T @ rotation @ perpendicular(self.axis))
        return replace(
            self,
            axis=axis,
            origin=rotation @ self.origin + shift,
            rest=rotation @ self.rest + shift,
            covariance=change @ self.covariance @ change.T,
        )


def joints_of(queries: Queries, landmarks: Landmarks, noise: Noise) -> tuple[Joint | None, ...]:
    """The joint of each query; None of what no body carries, of what was found again, and without depth."""
    bodies = landmarks.bodies
    screws = {int(b): _screw(bodies, int(b), noise) for b in np.unique(queries.body[queries.rides])}
    known = queries.rides & ~queries.anew
    error_m = depth_error(queries.own_depth, noise)
    return tuple(
        _joint(screws[int(b)], rest, float(error)) if told else None
        for b, rest, error, told in zip(queries.body, queries.rest, error_m, known, strict=True)
    )


@dataclass(frozen=True)
class _Screw:
    """How a body moves."""

    kind: JointKind
    twist: Float[np.ndarray, "6"]
    """Rotation vector and shift of the origin, at a coordinate of 1."""
    covariance: Float[np.ndarray, "6 6"]
    reach: Float[np.ndarray, "2"]
    """Least and largest coordinate."""


def _screw(bodies: Bodies, index: int, noise: Noise) -> _Screw:
    """The kind of a body's joint by evidence, and its screw."""
    if not bodies.screw[index].any():
        return _Screw(JointKind.STATIC, np.zeros(6), np.zeros((6, 6)), np.zeros(2))
    size = at_arm(noise)
    moment = bodies.moment[index] * np.outer(size, size)
    value, vector = np.linalg.eigh(moment)
    slides, ways = np.linalg.eigh(moment[3:, 3:])
    floor = noise.joint_m**2 * bodies.seen_s[index]
    frames = max(bodies.seen_s[index] / noise.correlated_s, 1.0)
    # A turning body has three numbers more than a sliding one: two of its axis' place, and the pitch.
    better = np.log((np.trace(moment) - slides[-1] + floor) / (np.trace(moment) - value[-1] + floor))
    turns = frames * better > 3 * np.log(frames) and bool(bodies.screw[index, :3].any())
    spread = (vector[:, :-1] * (value[:-1] + floor)) @ vector[:, :-1].T / value[-1]
    direction = bodies.screw[index].copy()
    if not turns:
        way = ways[:, -1] * (1 if ways[:, -1] @ direction[3:] >= 0 else -1)
        direction[:3], direction[3:] = 0, way
    # Measured in radians or metres.
    unit = float(np.linalg.norm(direction[:3])) / noise.arm_m if turns else 1.0
    scale = np.outer(1 / size, 1 / size) / unit**2
    kind = JointKind.REVOLUTE if turns else JointKind.PRISMATIC
    return _Screw(kind, direction / size / unit, spread * scale, bodies.reach[index] * unit)


def _joint(screw: _Screw, rest: Float[np.ndarray, "3"], error_m: float) -> Joint:
    """The joint by which a body's screw moves a point on it."""
    if screw.kind is JointKind.STATIC:
        return Joint(screw.kind, np.array([0.0, 0.0, 1.0]), rest, rest, 0.0, 0.0, error_m**2 * np.eye(3))
    axis, origin = _line(screw.twist, rest)
    basis, across = perpendicular(axis), np.zeros((4, 6))
    if screw.kind is JointKind.PRISMATIC:
        across[:2, 3:] = basis.T / np.linalg.norm(screw.twist[3:])
    else:
        for i, step in enumerate(1e-6 * np.eye(6)):
            other, there = _line(screw.twist + step, rest)
            across[:, i] = np.concatenate([basis.T @ (other - axis), basis.T @ (there - origin)]) / 1e-6
    covariance = across @ screw.covariance @ across.T
    covariance[2:, 2:] += error_m**2 * np.eye(2)
    return Joint(screw.kind, axis, origin, rest, float(screw.reach[0]), float(screw.reach[1]), covariance)


def _line(
    twist: Float[np.ndarray, "6"], rest: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Direction of a screw's axis, and its point nearest to a place; the place itself where it does not turn."""
    turn, shift = twist[:3], twist[3:]
    length = float(np.linalg.norm(turn))
    if length == 0:
        return shift / np.linalg.norm(shift), rest
    axis, foot = turn / length, np.cross(turn, shift) / length**2
    return axis, foot + axis * (axis @ (rest - foot))
