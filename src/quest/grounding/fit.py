"""Which joint explains a track of points, fitted robustly and chosen by an information criterion.

References: Sturm et al., A Probabilistic Framework for Learning Kinematic Models of Articulated Objects, JAIR 2011,
section 4; Schwarz, Estimating the Dimension of a Model, Annals of Statistics 1978.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from quest.errors import InputError
from quest.geometry.vectors import cross, perpendicular
from quest.grounding.curves import Curve, Track, fit_circle, fit_line, rebased
from quest.grounding.joint import Joint, JointKind
from quest.grounding.prior import JointPrior
from quest.grounding.starts import Starts, circle_through, join, line_through, start_circles, start_lines

_MOST_MISFIT = 9.0
_OUTLIER_SIGMAS = 4.0
_RELATIVE_SIGMA = 0.01
_LARGEST_RADIUS = 20.0
_SMALLEST_RADIUS_SIGMAS = 3.0
_LEAST_TRAVEL_SIGMAS = 5.0
_LEAST_TURN_RAD = 0.4
_STILL_EXPLAINED = 0.8
_SINGLE = 0.8
"""Points whose standard deviation is smaller than this share of the largest are means of several."""


@dataclass(frozen=True)
class _Candidate:
    joint: Joint
    score: float
    travel: float = np.inf


def fit_joint(
    points: Float[np.ndarray, "N 3"],
    sigma: float | Float[np.ndarray, " N"] | None,
    *,
    prior: JointPrior | None = None,
    near: Joint | None = None,
) -> Joint:
    """The joint that explains a track best.

    Lines and circles begin at triples of points, and points beyond four sigmas are left out; up to a fifth of them may
    be grossly wrong. The smallest chi^2 + k log n wins, k the number of a kind's parameters, where no point adds more
    than nine, so that no kind wins by bending through an outlier. A joint with one degree of freedom also pays one per
    point for the coordinate that it takes from it. The motions of real joints are never exact: no point counts as
    better than a hundredth of the track's extent, and without a prior a turn of less than 0.4 rad is a bowed line.
    Noise alone has a direction in which it is widest, so what travels less than five sigmas is static.

    Args:
        points: the track, in the order of time; at least one.
        sigma: standard deviation of a point per coordinate, one for all or one each; estimated if None.
        prior: what is believed already.
        near: the joint of almost the same track: where it still explains four of five points the fit begins there,
            which takes half the time.

    Raises:
        InputError: no point, another shape, or numbers that are not finite or not positive.
    """
    points, sigma = _checked(points, sigma)
    rough = 2 * float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.75))
    floored = np.maximum(sigma, _RELATIVE_SIGMA * rough + 1e-9)
    if len(points) < 3:
        return _static(points, floored).joint
    line, circle = _starts(points, floored, near)
    extent = _extent(points, floored, join(line, circle[:1]).best(points, floored, 1))
    track = Track(
        points, np.maximum(sigma, _RELATIVE_SIGMA * extent + 1e-9), extent, prior, sigma > _SINGLE * sigma.max()
    )
    moving = (_prismatic(track, line), _revolute(track, circle))
    enough = _LEAST_TRAVEL_SIGMAS * np.median(track.sigma)
    kinds = [c for c in moving if c is not None and c.travel > enough]
    return min([_static(points, track.sigma), *kinds], key=lambda c: c.score).joint


def _starts(points: np.ndarray, sigma: np.ndarray, near: Joint | None) -> tuple[Starts, Starts]:
    """The lines and circles to begin with, the best ones first."""
    if near is not None and near.kind is not JointKind.STATIC:
        on = np.linalg.norm(points - near.at(near.locate(points)), axis=1) < _OUTLIER_SIGMAS * sigma
        if on.mean() >= _STILL_EXPLAINED:
            if near.kind is JointKind.PRISMATIC:
                return Starts(near.axis[None], near.rest[None], np.zeros(1)), circle_through(points[on])
            circle = Starts(near.axis[None], near.origin[None], np.array([near.radius]))
            return line_through(points[on]), circle
    line = start_lines(points, sigma)
    return line, start_circles(points, sigma, line)


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
    sigma = np.asarray(_noise(points) if sigma is None else sigma, np.float64)
    if sigma.shape not in ((), (len(points),)) or not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise InputError(
            f"joint: expected one standard deviation, or one for each of {len(points)} points, finite and positive"
        )
    return points, np.broadcast_to(sigma, len(points))


def _noise(points: np.ndarray) -> float:
    """Standard deviation per coordinate from second differences, which smooth motion hardly has."""
    if len(points) < 4:
        return 1e-3
    second = points[2:] - 2 * points[1:-1] + points[:-2]
    return float(max(1.4826 * np.median(np.abs(second)) / 6**0.5, 1e-6))


def _extent(points: np.ndarray, sigma: np.ndarray, start: Starts) -> float:
    """Size of what lies near a line or circle, so that an outlier makes no track larger."""
    near = points[start.off(points)[0] < _OUTLIER_SIGMAS * sigma]
    near = near if len(near) else points
    return max(float(np.linalg.norm(near - near[0], axis=1).max()), 1e-9)


def _static(points: np.ndarray, sigma: np.ndarray) -> _Candidate:
    place = np.median(points, axis=0)
    for _ in range(3):
        near = np.linalg.norm(points - place, axis=1) < _OUTLIER_SIGMAS * sigma
        weight = np.where(near, 1 / np.square(sigma), 0.0)
        if not near.any():
            break
        place = weight @ points / weight.sum()
    covariance = np.eye(3) / max(float(weight.sum()), float(1 / np.square(sigma).max()))
    axis = np.array([0.0, 0.0, 1.0])
    joint = Joint(JointKind.STATIC, axis, place, place, 0.0, 0.0, covariance, float(np.median(sigma)), len(points))
    return _Candidate(joint, _misfit(joint, points, sigma) + 3 * np.log(len(points)))


def _prismatic(track: Track, line: Starts) -> _Candidate:
    points, prior = track.points, track.prior
    starts = line if prior is None else join(line, _believed_line(prior, points))
    curve = fit_line(track, starts)
    axis = curve.axis
    rest = curve.place + ((points[curve.used.argmax()] - curve.place) @ axis) * axis
    # The covariance is about the line's place; at rest the line is shifted by the tilt.
    change = np.eye(4)
    change[2:, :2] = (rest - curve.place) @ axis * np.eye(2)
    joint = Joint(
        JointKind.PRISMATIC, axis, rest, rest, 0.0, 0.0, change @ curve.covariance @ change.T,
        float(np.median(track.sigma)), len(points),
    )  # fmt: skip
    score = _misfit(joint, points, track.sigma, curve.stray) + len(points) + 4 * np.log(len(points))
    if prior is not None:
        score += _surprise(axis, prior.prismatic_axis, prior.prismatic_axis_sigma_rad)
        score -= 2 * np.log(1 - prior.revolute_probability)
    return _moving(joint, track, curve, score)


def _revolute(track: Track, circles: Starts) -> _Candidate | None:
    points, prior = track.points, track.prior
    starts = circles if prior is None else join(circles, _believed_circle(prior, points))
    if not len(starts):
        return None
    curve = fit_circle(track, starts)
    axis, radius = curve.axis, curve.radius
    if radius < _SMALLEST_RADIUS_SIGMAS * float(np.median(track.sigma)):
        return None
    if prior is None and radius > _LARGEST_RADIUS * track.extent:
        return None
    offset = points[curve.used.argmax()] - curve.place
    outward = offset - (offset @ axis) * axis
    rest = curve.place + outward * (radius / max(float(np.linalg.norm(outward)), 1e-12))
    joint = Joint(
        JointKind.REVOLUTE, axis, curve.place, rest, 0.0, 0.0, curve.covariance, float(np.median(track.sigma)),
        len(points),
    )  # fmt: skip
    score = _misfit(joint, points, track.sigma, curve.stray) + len(points) + 6 * np.log(len(points))
    if prior is not None:
        gap = (curve.place - prior.origin) @ perpendicular(axis) / prior.origin_sigma
        score += _surprise(axis, prior.revolute_axis, prior.revolute_axis_sigma_rad)
        score += min(float(gap @ gap), _MOST_MISFIT) - 2 * np.log(prior.revolute_probability)
    found = _moving(joint, track, curve, score)
    if prior is None and found.joint.upper - found.joint.lower < _LEAST_TURN_RAD:
        return None
    return found


def _believed_line(prior: JointPrior, points: np.ndarray) -> Starts:
    return Starts(prior.prismatic_axis[None], np.median(points, axis=0)[None], np.zeros(1))


def _believed_circle(prior: JointPrior, points: np.ndarray) -> Starts:
    offset = points - prior.origin
    height = offset @ prior.revolute_axis
    radius = np.linalg.norm(offset - height[:, None] * prior.revolute_axis, axis=1)
    centre = prior.origin + float(np.median(height)) * prior.revolute_axis
    return Starts(prior.revolute_axis[None], centre[None], np.median(radius)[None])


def _moving(joint: Joint, track: Track, curve: Curve, score: float) -> _Candidate:
    """The same joint with its range, and its axis such that the track leads to positive coordinates."""
    q = joint.locate(track.points[curve.used]) if curve.used.any() else np.zeros(1)
    if abs(q.max()) < abs(q.min()):
        covariance = rebased(joint.covariance, perpendicular(joint.axis), -joint.axis)
        sign = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0][: len(covariance)])
        joint = replace(joint, axis=-joint.axis, covariance=covariance * sign * sign[:, None])
        q = -q
    low, high = np.percentile(q, (5, 95))
    turning = joint.kind is JointKind.REVOLUTE
    travel = float(high - low) * (float(np.linalg.norm(joint.rest - joint.origin)) if turning else 1.0)
    return _Candidate(replace(joint, lower=float(q.min()), upper=float(q.max())), score, travel)


def _misfit(joint: Joint, points: np.ndarray, sigma: np.ndarray, stray: np.ndarray | None = None) -> float:
    square = np.square(np.linalg.norm(points - joint.at(joint.locate(points)), axis=1) / sigma)
    square = square if stray is None else np.where(stray, _MOST_MISFIT, square)
    return float(np.minimum(square, _MOST_MISFIT).sum())


def _surprise(axis: np.ndarray, expected: np.ndarray, sigma_rad: float) -> float:
    sine = cross(axis, expected) / sigma_rad
    return min(float(sine @ sine), _MOST_MISFIT)
