"""Whether two points move as one link, and the joint that several points of a link share.

Reference: Sturm et al., A Probabilistic Framework for Learning Kinematic Models of Articulated Objects, JAIR 2011,
section 3, for choosing links by evidence; Golub and Pereyra, The Differentiation of Pseudo-Inverses and Nonlinear Least
Squares Problems Whose Variables Separate, SIAM Journal on Numerical Analysis 1973, for the joint fit: what is linear
(each member's own radius, height and phase, and the link's position in each frame) is solved for inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from quest.geometry.vectors import cross, perpendicular, rotated
from quest.grounding.joint import Joint, JointKind

_OUTLIER_SIGMAS = 4.0
_RELATIVE_SIGMA = 0.01
_STILL_SIGMAS, _MOVED_SIGMAS = 3.0, 6.0
_WORST_FRAME = -4.0
_LEAST_FRAMES = 4


@dataclass(frozen=True)
class Tracks:
    """Simultaneous points of several queries and each one's own joint."""

    points: Float[np.ndarray, "M K 3"]
    """NaN where not seen."""
    joints: Sequence[Joint]
    """One each, none static."""
    sigma: float
    """Standard deviation of a point per coordinate."""

    def on_joint(self) -> tuple[Float[np.ndarray, "M K"], Float[np.ndarray, "M K"], Bool[np.ndarray, "M K"]]:
        """Position on the own joint, squared distance from it in sigmas, and whether the point is seen and near it."""
        shape = self.points.shape[:2]
        q, square = np.zeros(shape), np.full(shape, np.inf)
        for k, joint in enumerate(self.joints):
            seen = np.isfinite(self.points[:, k]).all(axis=1)
            q[seen, k] = joint.locate(self.points[seen, k])
            off = np.square(self.points[seen, k] - joint.at(q[seen, k])).sum(axis=1)
            square[seen, k] = off / (self.noise(k) ** 2 + np.square(joint.spread(q[seen, k])))
        return q, square, square < _OUTLIER_SIGMAS**2

    def noise(self, k: int) -> float:
        """Standard deviation of a point of a query, which is no better than a hundredth of its way."""
        joint = self.joints[k]
        return float(np.hypot(self.sigma, _RELATIVE_SIGMA * way_length(joint)))


def way_length(joint: Joint) -> float:
    """Length of what was seen of a joint's curve."""
    return (joint.upper - joint.lower) * (joint.radius if joint.kind is JointKind.REVOLUTE else 1.0)


def carried(joint: Joint, points: Float[np.ndarray, "M K 3"], q: Float[np.ndarray, " M"]) -> Float[np.ndarray, "M K 3"]:
    """Where points are brought by the motion of a joint, each row by its own q."""
    q = q[:, None, None]
    if joint.kind is not JointKind.REVOLUTE:
        return points + q * joint.axis
    arm = points - joint.origin
    height = (arm @ joint.axis)[..., None] * joint.axis
    return joint.origin + height + np.cos(q) * (arm - height) + np.sin(q) * cross(joint.axis, arm)


def evidence(tracks: Tracks) -> Float[np.ndarray, "K K"]:
    """Log likelihood ratio that query j (column) moves with the link of query i (row), against by its own joint.

    If it does, the motion of i brings it from one place of rest to where it is. If not, it can be anywhere on what was
    seen of its own curve. A frame counts as far as one of the two moved since the frame before it, so that two points
    which stand still are not told to be one link; one frame speaks against it by no more than four.
    """
    k = len(tracks.joints)
    q, own, valid = tracks.on_joint()
    noise = np.array([tracks.noise(j) for j in range(k)])
    steps = _steps(tracks.points, valid)
    total = np.full((k, k), -np.inf)
    way = np.array([way_length(j) for j in tracks.joints]) + np.sqrt(2 * np.pi) * noise
    for i, joint in enumerate(tracks.joints):
        both = valid & valid[:, [i]]
        back = np.where(both[:, :, None], carried(joint, tracks.points, -q[:, i]), np.nan)
        enough = both.sum(axis=0) >= _LEAST_FRAMES
        if not enough.any():
            continue
        rest = np.full((k, 3), np.nan)
        rest[enough] = np.nanmedian(back[:, enough], axis=0)
        along, across = _variances(joint, rest, q[:, i] - np.median(q[both[:, i], i]), noise, i)
        error = back - rest
        forward = np.einsum("mkd,kd->mk", error, _tangents(joint, rest))
        sideways = np.square(error).sum(axis=-1) - np.square(forward)
        together = np.square(forward) / along + sideways / across + np.log(along) + 2 * np.log(across)
        alone = own + 4 * np.log(noise) + 2 * np.log(way) - np.log(2 * np.pi)
        ratio = np.where(both, np.maximum(0.5 * (alone - together), _WORST_FRAME), 0.0)
        moved = np.maximum(steps, steps[:, [i]]) / tracks.sigma
        weight = np.clip((moved - _STILL_SIGMAS) / (_MOVED_SIGMAS - _STILL_SIGMAS), 0, 1)
        total[i] = np.where(enough, (weight * ratio).sum(axis=0), -np.inf)
    return total


def _steps(points: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """How far each query went since it was last seen."""
    last = np.maximum.accumulate(np.where(valid, np.arange(len(points))[:, None], -1), axis=0)
    held = np.take_along_axis(np.where(valid[:, :, None], points, 0.0), np.maximum(last, 0)[:, :, None], axis=0)
    step = np.linalg.norm(np.diff(held, axis=0, prepend=held[:1]), axis=-1)
    before = np.vstack((np.full((1, points.shape[1]), -1), last[:-1]))
    return np.where(before >= 0, step, 0.0)


def _tangents(joint: Joint, rest: np.ndarray) -> np.ndarray:
    if joint.kind is JointKind.PRISMATIC:
        return np.repeat(joint.axis[None], len(rest), axis=0)
    tangent = cross(joint.axis, rest - joint.origin)
    return tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)


def _variances(
    joint: Joint, rest: np.ndarray, moved: np.ndarray, noise: np.ndarray, i: int
) -> tuple[np.ndarray, np.ndarray]:
    """Variance of where a link brings other points, along and across their ways (M x K)."""
    if joint.kind is JointKind.PRISMATIC:
        axis = np.square(joint.axis_sigma_rad * moved)[:, None]
        return (np.square(noise) + noise[i] ** 2) + axis, np.square(noise) + axis
    arm = rest - joint.origin
    radius = np.linalg.norm(arm - (arm @ joint.axis)[:, None] * joint.axis, axis=1)
    # Errors of axis and radius cancel at the point that they were fitted to; they grow with the distance from it.
    lever = np.linalg.norm(rest - joint.rest, axis=1) * 2 * np.abs(np.sin(moved / 2))[:, None]
    doubt = joint.axis_sigma_rad**2 + joint.covariance[4, 4] / joint.radius**2
    across = np.square(noise) + np.square(lever) * doubt
    return across + np.square(noise[i] * radius / joint.radius), across


def fit_link(tracks: Tracks) -> tuple[Joint, ...] | None:
    """One joint for all queries, with one coordinate q: each query's joint differs in its rest only.

    Returns:
        None where fewer than four frames show a query.
    """
    valid = tracks.on_joint()[2]
    if (valid.sum(axis=0) < _LEAST_FRAMES).any():
        return None
    best = max(range(len(tracks.joints)), key=lambda k: way_length(tracks.joints[k]) / tracks.noise(k))
    start = tracks.joints[best]
    noise = np.array([tracks.noise(k) for k in range(len(tracks.joints))])
    fit = _fit_sliding if start.kind is JointKind.PRISMATIC else _fit_turning
    joints, gap = fit(tracks, start, valid, noise)
    # A point may be wrong and near its own curve all the same; then it is not where its partners say.
    kept = valid & (gap < _OUTLIER_SIGMAS)
    if (kept.sum(axis=0) >= _LEAST_FRAMES).all() and (kept != valid).any():
        joints, _ = fit(tracks, start, kept, noise)
    return joints


def _fit_sliding(
    tracks: Tracks, start: Joint, valid: np.ndarray, noise: np.ndarray
) -> tuple[tuple[Joint, ...], np.ndarray]:
    """The members' joints, and how far along the way each point is from where the link says, in sigmas (M x K)."""
    weight = valid / np.square(noise)
    points = np.where(valid[:, :, None], tracks.points, 0.0)
    middle = points.sum(axis=0) / valid.sum(axis=0)[:, None]
    offset = (points - middle) * np.sqrt(weight)[:, :, None]
    axis = np.linalg.svd(offset.reshape(-1, 3), full_matrices=False)[2][0]
    axis = axis * np.sign(axis @ start.axis)
    along = np.where(valid, (tracks.points - middle) @ axis, 0.0)
    # The members' middles differ where they were seen in different frames.
    q, phase = _common(along, weight)
    first = q[valid.any(axis=1).argmax()]
    low, high = _reach(q - first, valid)
    tilt = 1 / (weight * np.square(along)).sum()
    joints = []
    for k, joint in enumerate(tracks.joints):
        back = float(phase[k] + first)
        shift = noise[k] ** 2 / valid[:, k].sum()
        covariance = np.diag([tilt, tilt, shift + back**2 * tilt, shift + back**2 * tilt])
        covariance[:2, 2:] = covariance[2:, :2] = back * tilt * np.eye(2)
        rest = middle[k] + back * axis
        joints.append(
            replace(joint, kind=JointKind.PRISMATIC, axis=axis, origin=rest, rest=rest, lower=low, upper=high,
                    covariance=covariance, n=int(valid[:, k].sum()))
        )  # fmt: skip
    return tuple(joints), np.abs(along - phase - q[:, None]) / noise


@dataclass(frozen=True)
class _Turned:
    """Tracks around an axis: residuals in standard deviations and what was solved for inside."""

    rows: np.ndarray
    radius: np.ndarray
    height: np.ndarray
    phase: np.ndarray
    q: np.ndarray


def _fit_turning(
    tracks: Tracks, start: Joint, valid: np.ndarray, noise: np.ndarray
) -> tuple[tuple[Joint, ...], np.ndarray]:
    """The same of a link that turns."""
    basis = perpendicular(start.axis)
    points = np.where(valid[:, :, None], tracks.points, start.rest)
    count = valid.sum(axis=0)
    reference = np.array([p[v][0] for p, v in zip(points.swapaxes(0, 1), valid.T, strict=True)])

    def turned(x: np.ndarray) -> _Turned:
        axis = start.axis + basis @ x[:2]
        axis /= np.sqrt(axis @ axis)
        origin = start.origin + basis @ x[2:]
        arm, zero = points - origin, reference - origin
        height = arm @ axis
        flat = arm - height[..., None] * axis
        zero = zero - (zero @ axis)[:, None] * axis
        angle = np.arctan2((flat * cross(axis, zero)).sum(-1), (flat * zero).sum(-1))
        out = np.sqrt(np.square(flat).sum(-1))
        radius, level = (out * valid).sum(axis=0) / count, (height * valid).sum(axis=0) / count
        q, phase = _common(angle, valid * np.square(radius / noise))
        rows = np.stack((out - radius, height - level, radius * (angle - phase - q[:, None])))
        return _Turned((rows * valid / noise).ravel(), radius, level, phase, q)

    found = least_squares(lambda x: turned(x).rows, np.zeros(4), method="lm", ftol=1e-5, xtol=1e-5, max_nfev=60)
    x, best = found.x, turned(found.x)
    axis = start.axis + basis @ x[:2]
    axis /= np.linalg.norm(axis)
    first = best.q[valid.any(axis=1).argmax()]
    low, high = _reach(best.q - first, valid)
    # Errors of frames in which little moves are alike: the covariance is no better than the residuals are.
    scale = max(1.0, float(found.cost) * 2 / max(2 * int(count.sum()) - 4, 1))
    base = scale * np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)
    step = 1e-6 * np.array([1.0, 1.0, start.radius, start.radius])
    near = [turned(x + step[p] * np.eye(4)[p]) for p in range(4)]
    joints = []
    for k, joint in enumerate(tracks.joints):
        slopes = np.array([[(n.radius[k] - best.radius[k]), (n.height[k] - best.height[k])] for n in near]).T / step
        change = np.vstack((np.eye(4), slopes))
        covariance = change @ base @ change.T + np.diag([0.0] * 4 + [noise[k] ** 2 / count[k]] * 2)
        # Tilt about the member's own height, in the basis of the axis that was found.
        own = np.eye(6)
        own[2:4, :2] = best.height[k] * np.eye(2)
        turn = np.eye(6)
        turn[:2, :2] = turn[2:4, 2:4] = perpendicular(axis).T @ basis
        covariance = turn @ own @ covariance @ own.T @ turn.T
        origin = start.origin + basis @ x[2:] + best.height[k] * axis
        arm = reference[k] - origin
        arm = arm - (arm @ axis) * axis
        rest = origin + best.radius[k] * rotated(arm / np.linalg.norm(arm), axis, float(best.phase[k] + first))
        joints.append(
            replace(joint, kind=JointKind.REVOLUTE, axis=axis, origin=origin, rest=rest, lower=low, upper=high,
                    covariance=covariance, n=int(count[k]))
        )  # fmt: skip
    return tuple(joints), np.abs(best.rows.reshape(3, *valid.shape)[2])


def _common(along: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The link's position per frame and each member's phase, from members' positions (M x K) of given weights."""
    share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    # Normal equations of the phases without q; a phase that all have in common is q's, which the pseudo-inverse leaves.
    system = np.diag(weight.sum(axis=0)) - weight.T @ share
    mean = (share * along).sum(axis=1, keepdims=True)
    phase = np.linalg.pinv(system, rcond=1e-9, hermitian=True) @ (weight * (along - mean)).sum(axis=0)
    return (share * (along - phase)).sum(axis=1), phase


def _reach(q: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    seen = q[valid.any(axis=1)]
    return float(seen.min()), float(seen.max())
