"""A joint with one degree of freedom and the curve on which it moves a point.

Reference: Sturm et al., A Probabilistic Framework for Learning Kinematic Models of Articulated Objects, JAIR 2011,
section 4, for the three models.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from quest.errors import InputError
from quest.geometry.vectors import cross, perpendicular


class JointKind(StrEnum):
    """How a joint moves."""

    STATIC = "static"
    PRISMATIC = "prismatic"
    REVOLUTE = "revolute"


@dataclass(frozen=True)
class Joint:
    """A joint fitted to the track of one point, in the track's frame and unit of length."""

    kind: JointKind
    """How it moves."""
    axis: Float[np.ndarray, "3"]
    """Unit direction of sliding, or of the axis of turning (right-handed); positive away from the first points."""
    origin: Float[np.ndarray, "3"]
    """Point of the axis of turning nearest to ``rest``; equal to ``rest`` for other kinds."""
    rest: Float[np.ndarray, "3"]
    """The curve at q = 0."""
    lower: float
    """Smallest q seen, units of length or radians; turns are told within half a turn either way from ``rest``."""
    upper: float
    """Largest q seen."""
    covariance: Float[np.ndarray, "P P"]
    """Of small changes, in the basis of :func:`perpendicular`. Prismatic: tilt of the axis (2, radians) and shift
    across it (2). Revolute: tilt about ``origin`` (2), shift of the axis across itself (2), radius, height along the
    axis. Static: shift (3)."""
    sigma: float
    """Standard deviation of a point per coordinate that was used."""
    n: int
    """Points fitted."""

    @property
    def radius(self) -> float:
        """Distance of the point from the axis of turning; 0 for other kinds."""
        return float(np.linalg.norm(self.rest - self.origin))

    @property
    def axis_sigma_rad(self) -> float:
        """Standard deviation of the axis' direction about each of two perpendicular directions; NaN if static."""
        if self.kind is JointKind.STATIC:
            return float("nan")
        return float(np.sqrt(np.trace(self.covariance[:2, :2]) / 2))

    @property
    def line_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of small errors of ``axis`` (3, radians) and ``origin`` (3, units of length) together.

        It is :attr:`covariance` in the track's own axes, as far as it is about the axis: of rank 4, because errors
        along the axis are none. Of a static joint the part of the axis is NaN.
        """
        if self.kind is JointKind.STATIC:
            found = np.full((6, 6), np.nan)
            found[3:, 3:] = self.covariance
            return found
        across = np.zeros((6, 4))
        across[:3, :2] = across[3:, 2:] = perpendicular(self.axis)
        return across @ self.covariance[:4, :4] @ across.T

    def describe(self, unit: str = "m") -> str:
        """One line for people; ``unit`` is the name of the track's unit of length."""
        if self.kind is JointKind.STATIC:
            return f"static, at {_numbers(self.rest)} {unit}"
        known = f"axis +-{np.degrees(self.axis_sigma_rad):.1f} degrees"
        if self.kind is JointKind.PRISMATIC:
            seen = f"seen {self.lower:.2f} to {self.upper:.2f} {unit}"
            return f"prismatic, axis {_numbers(self.axis)}, {seen}, {known}"
        seen = f"seen {np.degrees(self.lower):.0f} to {np.degrees(self.upper):.0f} degrees"
        return f"revolute, axis {_numbers(self.axis)}, radius {self.radius:.2f} {unit}, {seen}, {known}"

    def at(self, q: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """Points of the curve."""
        if self.kind is JointKind.STATIC:
            return np.repeat(self.rest[None], len(q), axis=0)
        if self.kind is JointKind.PRISMATIC:
            return self.rest + q[:, None] * self.axis
        arm = self.rest - self.origin
        return self.origin + np.cos(q)[:, None] * arm + np.sin(q)[:, None] * cross(self.axis, arm)

    def locate(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Coordinate q of the nearest point of the curve; within [-pi, pi] for turning, 0 for a static point."""
        if self.kind is JointKind.STATIC:
            return np.zeros(len(points))
        if self.kind is JointKind.PRISMATIC:
            return (points - self.rest) @ self.axis
        arm = self.rest - self.origin
        offset = points - self.origin
        return np.arctan2(offset @ cross(self.axis, arm), offset @ arm)

    def spread(self, q: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
        """Standard deviation of the curve per direction across itself, by the covariance to first order."""
        moves, tangent = self._moves(q), self._tangent(q)
        across = moves - tangent[:, :, None] * (tangent[:, None] @ moves)
        variance = np.einsum("nip,pq,niq->n", across, self.covariance, across)
        freedom = 3 if self.kind is JointKind.STATIC else 2
        return np.sqrt(np.maximum(variance, 0) / freedom)

    def transformed(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"], scale: float = 1.0
    ) -> Joint:
        """The same joint in a frame whose points are ``scale * rotation @ point + translation``.

        Raises:
            InputError: no proper rotation, a scale that is not positive, or numbers that are not finite.
        """
        proper = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) and np.linalg.det(rotation) > 0
        if not (proper and np.isfinite(translation).all() and np.isfinite(scale) and scale > 0):
            raise InputError(
                "joint: expected a rotation, a finite translation and a positive scale, "
                f"got {rotation}, {translation}, {scale}"
            )
        axis = rotation @ self.axis
        axis = axis / np.linalg.norm(axis)
        if self.kind is JointKind.STATIC:
            change = scale * rotation
        else:
            # The turned basis is not that of the turned axis.
            turn = perpendicular(axis).T @ rotation @ perpendicular(self.axis)
            change = scale * np.eye(len(self.covariance))
            change[:2, :2], change[2:4, 2:4] = turn, scale * turn
        length = scale if self.kind is JointKind.PRISMATIC else 1.0
        return replace(
            self,
            axis=axis,
            origin=scale * rotation @ self.origin + translation,
            rest=scale * rotation @ self.rest + translation,
            lower=length * self.lower,
            upper=length * self.upper,
            covariance=change @ self.covariance @ change.T,
            sigma=scale * self.sigma,
        )

    def _tangent(self, q: np.ndarray) -> np.ndarray:
        if self.kind is JointKind.STATIC:
            return np.zeros((len(q), 3))
        if self.kind is JointKind.PRISMATIC:
            return np.repeat(self.axis[None], len(q), axis=0)
        turned = cross(self.axis, self.at(q) - self.origin)
        return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)

    def _moves(self, q: np.ndarray) -> np.ndarray:
        """Change of the curve's points with the parameters of the covariance, N x 3 x P."""
        if self.kind is JointKind.STATIC:
            return np.repeat(np.eye(3)[None], len(q), axis=0)
        basis = perpendicular(self.axis)
        shift = np.repeat(basis[None], len(q), axis=0)
        if self.kind is JointKind.PRISMATIC:
            return np.concatenate((q[:, None, None] * basis, shift), axis=2)
        arm = self.at(q) - self.origin
        # The axis moves towards each basis vector: a rotation about axis x basis vector.
        tilt = np.stack([cross(cross(self.axis, basis[:, i]), arm) for i in range(2)], axis=2)
        radial = arm / np.maximum(np.linalg.norm(arm, axis=1, keepdims=True), 1e-12)
        height = np.repeat(self.axis[None, :, None], len(q), axis=0)
        return np.concatenate((tilt, shift, radial[:, :, None], height), axis=2)


def _numbers(vector: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in vector) + ")"
