"""Which joint explains a track of points, fitted robustly and chosen by an information criterion.

References: Sturm et al., A Probabilistic Framework for Learning Kinematic Models of Articulated Objects, JAIR 2011,
section 4; Schwarz, Estimating the Dimension of a Model, Annals of Statistics 1978; Kåsa, A Circle Fitting Procedure and
its Error Analysis, IEEE Transactions on Instrumentation and Measurement 1976, for where the circle's fit starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from quest.errors import InputError
from quest.grounding.joint import Joint, JointKind, perpendicular
from quest.grounding.prior import JointPrior

_ROBUST_SCALE = 1.5
_MOST_MISFIT = 9.0
_RELATIVE_SIGMA = 0.01
_LARGEST_RADIUS = 20.0
_SMALLEST_RADIUS_SIGMAS = 3.0
_LEAST_TRAVEL_SIGMAS = 5.0
_WEAK_RADIUS_SHARE = 5.0
_LEAST_TURN_RAD = 0.4


_Model = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Residuals in standard deviations, and their Jacobian."""


@dataclass(frozen=True)
class _Candidate:
    joint: Joint
    score: float


def fit_joint(
    points: Float[np.ndarray, "N 3"],
    sigma: float | Float[np.ndarray, " N"] | None,
    *,
    prior: JointPrior | None = None,
) -> Joint:
    """The joint that explains a track best.

    Every kind is fitted with a robust loss; the smallest chi^2 + k log n wins, k the number of its parameters, where no
    point adds more than nine, so that no kind wins by bending through an outlier. A joint with one degree of freedom
    also pays one per point for the coordinate that it takes from it. The motions of real joints are never exact: no
    point counts as better than a hundredth of the track's extent, and without a prior a turn of less than 0.4 rad is a
    bowed line. Noise alone has a direction in which it is widest, so what travels less than five sigmas is static.

    Args:
        points: the track, in the order of time; at least one.
        sigma: standard deviation of a point per coordinate, one for all or one each; estimated if None.
        prior: what is believed already.

    Raises:
        InputError: no point, another shape, or numbers that are not finite or not positive.
    """
    points, sigma = _checked(points, sigma)
    extent = float(np.linalg.norm(points - points[0], axis=1).max())
    sigma = np.maximum(sigma, _RELATIVE_SIGMA * extent + 1e-9)
    if len(points) < 3:
        return _static(points, sigma).joint
    moving = (_prismatic(points, sigma, prior), _revolute(points, sigma, prior))
    kinds = [c for c in moving if c is not None and _travel(c.joint, points) > _LEAST_TRAVEL_SIGMAS * np.median(sigma)]
    return min([_static(points, sigma), *kinds], key=lambda c: c.score).joint


def joint_from_prior(prior: JointPrior, rest: Float[np.ndarray, "3"], *, kind: JointKind, rest_sigma: float) -> Joint:
    """The joint that a prior alone believes in, through a point of the given standard deviation."""
    if kind is JointKind.PRISMATIC:
        covariance = np.diag(np.square([prior.prismatic_axis_sigma_rad] * 2 + [rest_sigma] * 2))
        return Joint(kind, prior.prismatic_axis, rest, rest, 0.0, 0.0, covariance, rest_sigma, 0)
    axis = prior.revolute_axis
    origin = prior.origin + ((rest - prior.origin) @ axis) * axis
    # The curve goes through the point: moving the axis moves the curve only as far as it has turned.
    covariance = np.diag(
        np.square([prior.revolute_axis_sigma_rad] * 2 + [prior.origin_sigma] * 2 + [rest_sigma] * 2)
    ) + _through_rest(axis, rest - origin, prior)
    return Joint(kind, axis, origin, rest, 0.0, 0.0, covariance, rest_sigma, 0)


def _through_rest(axis: np.ndarray, arm: np.ndarray, prior: JointPrior) -> np.ndarray:
    """Covariances that take back, at the point itself, what shift and tilt of the axis do to radius and height."""
    radius = max(float(np.linalg.norm(arm)), 1e-9)
    basis = perpendicular(axis)
    radial = arm @ basis / radius
    extra = np.zeros((6, 6))
    shift, tilt = prior.origin_sigma**2, prior.revolute_axis_sigma_rad**2
    extra[2:4, 4] = extra[4, 2:4] = -shift * radial
    extra[4, 4] = shift
    extra[:2, 5] = extra[5, :2] = tilt * radius * radial
    extra[5, 5] = tilt * radius**2
    return extra


def _checked(points: np.ndarray, sigma: float | np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise InputError(
            f"joint: expected at least one finite point (N x 3), got {points.shape}; leave out what is not seen"
        )
    each = np.broadcast_to(_noise(points) if sigma is None else np.asarray(sigma, np.float64), len(points))
    if not (np.isfinite(each).all() and (each > 0).all()):
        raise InputError("joint: expected standard deviations that are finite and positive")
    return points, each


def _noise(points: np.ndarray) -> float:
    """Standard deviation per coordinate from second differences, which smooth motion hardly has."""
    if len(points) < 4:
        return 1e-3
    second = points[2:] - 2 * points[1:-1] + points[:-2]
    return float(max(1.4826 * np.median(np.abs(second)) / 6**0.5, 1e-6))


def _solve(model: _Model, start: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Solution, doubled robust cost and covariance; gross errors hardly count (Cauchy), but only after a first fit."""
    values: dict[str, Any] = {"fun": lambda x: model(x)[0], "jac": lambda x: model(x)[1], "f_scale": _ROBUST_SCALE}
    first = least_squares(x0=start, loss="soft_l1", max_nfev=15, **values)
    found = least_squares(x0=first.x, loss="cauchy", max_nfev=15, **values)
    value, vector = np.linalg.eigh(found.jac.T @ found.jac)
    covariance = (vector / np.maximum(value, 1e-8)) @ vector.T
    return found.x, 2 * float(found.cost), covariance


def _static(points: np.ndarray, sigma: np.ndarray) -> _Candidate:
    start = np.median(points, axis=0)
    jacobian = np.repeat(-1 / sigma, 3)[:, None] * np.tile(np.eye(3), (len(points), 1))
    place, _, covariance = _solve(lambda x: (((points - x) / sigma[:, None]).ravel(), jacobian), start)
    axis = np.array([0.0, 0.0, 1.0])
    joint = Joint(JointKind.STATIC, axis, place, place, 0.0, 0.0, covariance, float(np.median(sigma)), len(points))
    return _Candidate(joint, _misfit(joint, points, sigma) + 3 * np.log(len(points)))


def _prismatic(points: np.ndarray, sigma: np.ndarray, prior: JointPrior | None) -> _Candidate:
    middle = np.median(points, axis=0)
    starts = [_main_direction(points - middle)] + ([] if prior is None else [prior.prismatic_axis])
    best = None
    for axis in starts:
        # A line is linear in its slopes against a direction near it, so that two rounds are enough.
        for _ in range(2):
            basis = perpendicular(axis)
            x, cost, covariance = _solve(_line(points - middle, sigma, axis, basis, prior), np.zeros(4))
            fitted = _unit(axis + basis @ x[:2])
            if best is None or cost < best[0]:
                best = (cost, fitted, middle + basis @ x[2:], covariance, basis)
            axis = fitted
    assert best is not None
    _, axis, through, covariance, basis = best
    rest = through + ((points[0] - through) @ axis) * axis
    # The covariance is about the middle of the track; at rest the line is shifted by the tilt.
    back = float((through - rest) @ axis)
    change = np.eye(4)
    change[2:, :2] = -back * np.eye(2)
    covariance = _rebased(change @ covariance @ change.T, basis, axis)
    joint = Joint(JointKind.PRISMATIC, axis, rest, rest, 0.0, 0.0, covariance, float(np.median(sigma)), len(points))
    score = _misfit(joint, points, sigma) + len(points) + 4 * np.log(len(points))
    if prior is not None:
        score += _surprise(axis, prior.prismatic_axis, prior.prismatic_axis_sigma_rad)
        score -= 2 * np.log(1 - prior.revolute_probability)
    return _Candidate(_oriented(joint, points), score)


def _revolute(points: np.ndarray, sigma: np.ndarray, prior: JointPrior | None) -> _Candidate | None:
    starts = _circles(points)
    if prior is not None:
        starts.append((prior.revolute_axis, prior.origin))
    best = None
    for start_axis, start_origin in starts:
        basis = perpendicular(start_axis)
        height, radius = _cylinder(points, start_axis, start_origin)
        start = np.array([0.0, 0.0, 0.0, 0.0, np.median(radius), np.median(height)])
        model = _circle(points, sigma, start_axis, start_origin, basis, prior)
        x, cost, covariance = _solve(model, start)
        if best is None or cost < best[0]:
            best = (cost, _unit(start_axis + basis @ x[:2]), start_origin + basis @ x[2:4], x, covariance, basis)
    assert best is not None
    _, axis, place, x, covariance, basis = best
    return _circle_candidate(points, sigma, prior, (axis, place, x[4], x[5]), _rebased(covariance, basis, axis))


def _line(
    offset: np.ndarray, sigma: np.ndarray, axis: np.ndarray, basis: np.ndarray, prior: JointPrior | None
) -> _Model:
    """Parameters: slopes of the line against an axis (2), and its shift across it (2)."""
    along, across = offset @ axis, offset @ basis
    n = len(offset)
    jacobian = np.zeros((n, 2, 4))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = -along / sigma
    jacobian[:, 0, 2] = jacobian[:, 1, 3] = -1 / sigma
    jacobian = jacobian.reshape(2 * n, 4)

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residual = ((across - x[2:] - along[:, None] * x[:2]) / sigma[:, None]).ravel()
        if prior is None:
            return residual, jacobian
        tilt, by_tilt = _tilt(axis, basis, x[:2], prior.prismatic_axis, prior.prismatic_axis_sigma_rad)
        return np.append(residual, tilt), np.vstack((jacobian, np.column_stack((by_tilt, np.zeros((3, 2))))))

    return model


def _circle(
    points: np.ndarray,
    sigma: np.ndarray,
    axis: np.ndarray,
    origin: np.ndarray,
    basis: np.ndarray,
    prior: JointPrior | None,
) -> _Model:
    """Parameters: slopes of the axis (2), shift across it (2), radius, height of the circle."""
    n = len(points)
    extent = max(float(np.linalg.norm(points - points[0], axis=1).max()), 1e-9)

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        now, by_slope = _tilted(axis, basis, x[:2])
        offset = points - origin - basis @ x[2:4]
        height = offset @ now
        outward = offset - height[:, None] * now
        radius = np.linalg.norm(outward, axis=1)
        outward = outward / np.maximum(radius, 1e-12)[:, None]
        jacobian = np.zeros((2, n, 6))
        jacobian[0, :, :2] = -height[:, None] * (outward @ by_slope)
        jacobian[0, :, 2:4] = -outward @ basis
        jacobian[1, :, :2] = offset @ by_slope
        jacobian[1, :, 2:4] = -(now @ basis)
        jacobian[0, :, 4] = jacobian[1, :, 5] = -1
        rows = [((radius - x[4]) / sigma), ((height - x[5]) / sigma)]
        slopes = [(jacobian / sigma[:, None]).reshape(2 * n, 6)]
        if prior is None:
            # Without a prior a circle is never much larger than what was seen of it.
            rows.append(np.array([x[4] / (_WEAK_RADIUS_SHARE * extent)]))
            slopes.append(np.eye(6)[4:5] / (_WEAK_RADIUS_SHARE * extent))
        else:
            tilt, by_tilt = _tilt(axis, basis, x[:2], prior.revolute_axis, prior.revolute_axis_sigma_rad)
            rows += [tilt, (basis.T @ (origin - prior.origin) + x[2:4]) / prior.origin_sigma]
            slopes += [np.column_stack((by_tilt, np.zeros((3, 4)))), np.eye(6)[2:4] / prior.origin_sigma]
        return np.concatenate(rows), np.vstack(slopes)

    return model


def _tilted(axis: np.ndarray, basis: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit axis that slopes make of an axis, with its derivatives by them."""
    raw = axis + basis @ slopes
    length = float(np.linalg.norm(raw))
    now = raw / length
    return now, (basis - np.outer(now, now @ basis)) / length


def _tilt(
    axis: np.ndarray, basis: np.ndarray, slopes: np.ndarray, expected: np.ndarray, sigma_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sine of the angle to an expected axis, as a vector, with its derivatives by the slopes."""
    now, by_slope = _tilted(axis, basis, slopes)
    return np.cross(now, expected) / sigma_rad, np.cross(by_slope.T, expected).T / sigma_rad


def _circle_candidate(
    points: np.ndarray,
    sigma: np.ndarray,
    prior: JointPrior | None,
    circle: tuple[np.ndarray, np.ndarray, float, float],
    covariance: np.ndarray,
) -> _Candidate | None:
    axis, place, radius, height = circle
    extent = float(np.linalg.norm(points - points[0], axis=1).max())
    # Noise around a place is no small circle, and a bowed line is no large one.
    noise = _SMALLEST_RADIUS_SIGMAS * float(np.median(sigma))
    if radius < noise or (prior is None and radius > _LARGEST_RADIUS * extent):
        return None
    origin = place + height * axis
    offset = points[0] - origin
    outward = offset - (offset @ axis) * axis
    rest = origin + radius * _unit(outward)
    # Tilt about the height of the circle instead of the point where the fit began.
    change = np.eye(6)
    change[2:4, :2] = height * np.eye(2)
    covariance = change @ covariance @ change.T
    joint = Joint(JointKind.REVOLUTE, axis, origin, rest, 0.0, 0.0, covariance, float(np.median(sigma)), len(points))
    joint = _oriented(joint, points)
    if prior is None and joint.upper - joint.lower < _LEAST_TURN_RAD:
        return None
    score = _misfit(joint, points, sigma) + len(points) + 6 * np.log(len(points))
    if prior is not None:
        gap = (origin - prior.origin) @ perpendicular(axis) / prior.origin_sigma
        score += _surprise(axis, prior.revolute_axis, prior.revolute_axis_sigma_rad) + min(
            float(gap @ gap), _MOST_MISFIT
        )
        score -= 2 * np.log(prior.revolute_probability)
    return _Candidate(joint, score)


def _oriented(joint: Joint, points: np.ndarray) -> Joint:
    """The same joint with its range, and its axis such that the track leads to positive coordinates."""
    q = joint.locate(points)
    sign = 1.0 if abs(q.max()) >= abs(q.min()) else -1.0
    covariance = joint.covariance
    if sign < 0:
        covariance = _rebased(covariance, perpendicular(joint.axis), -joint.axis)
        if joint.kind is JointKind.REVOLUTE:
            flip = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
            covariance = flip @ covariance @ flip
        flip = np.diag([-1.0, -1.0] + [1.0] * (len(covariance) - 2))
        covariance = flip @ covariance @ flip
        q = -q
    return Joint(
        joint.kind, sign * joint.axis, joint.origin, joint.rest, float(q.min()), float(q.max()), covariance,
        joint.sigma, joint.n,
    )  # fmt: skip


def _travel(joint: Joint, points: np.ndarray) -> float:
    """Length of the curve between the fifth and the 95th percentile of the points."""
    low, high = np.percentile(joint.locate(points), (5, 95))
    turning = joint.kind is JointKind.REVOLUTE
    return float(high - low) * (float(np.linalg.norm(joint.rest - joint.origin)) if turning else 1.0)


def _misfit(joint: Joint, points: np.ndarray, sigma: np.ndarray) -> float:
    gap = np.linalg.norm(points - joint.at(joint.locate(points)), axis=1) / sigma
    return float(np.minimum(np.square(gap), _MOST_MISFIT).sum())


def _surprise(axis: np.ndarray, expected: np.ndarray, sigma_rad: float) -> float:
    sine = np.cross(axis, expected) / sigma_rad
    return min(float(sine @ sine), _MOST_MISFIT)


def _rebased(covariance: np.ndarray, basis: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """A covariance whose first two pairs are written in a basis, in the basis of another axis near it."""
    turn = perpendicular(axis).T @ basis
    change = np.eye(len(covariance))
    change[:2, :2] = change[2:4, 2:4] = turn
    return change @ covariance @ change.T


def _circles(points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Axis and centre of the circle in the track's main plane, and of that through the medians of the track's thirds.

    The first is the better one for clean tracks, the second does not see outliers.
    """
    middle = points.mean(axis=0)
    main = np.linalg.svd(points - middle)[2]
    flat = (points - middle) @ main[:2].T
    system = np.column_stack((flat, np.ones(len(flat))))
    solution = np.linalg.lstsq(system, np.square(flat).sum(axis=1), rcond=None)[0]
    found = [(main[2], middle + np.clip(solution[:2] / 2, -1e3, 1e3) @ main[:2])]
    first, second, third = (np.median(part, axis=0) for part in np.array_split(points, 3))
    one, other = second - first, third - first
    normal = np.cross(one, other)
    if normal @ normal > 1e-12 * (one @ one) * (other @ other):
        centre = np.cross(normal, one) * (other @ other) + np.cross(other, normal) * (one @ one)
        found.append((_unit(normal), first + centre / (2 * (normal @ normal))))
    return found


def _cylinder(points: np.ndarray, axis: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height along an axis and distance from it."""
    offset = points - origin
    height = offset @ axis
    return height, np.linalg.norm(offset - height[:, None] * axis, axis=1)


def _main_direction(offset: np.ndarray) -> np.ndarray:
    return np.linalg.svd(offset, full_matrices=False)[2][0]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
