"""Evidence of rigid motion: the pose that takes points of a body to where they are seen, and new bodies.

A pose is fitted to all points of a body since it first moved, never chained. Residuals are in pixels and in depth, each
over its own spread; the Geman-McClure weight ``(1 + r^2 / c^2)^-2``, with a falling ``c``, leaves out what disagrees. A
new body is the rigid motion of three neighbouring points that most of the unexplained points share.

Reference: Horn, Closed-form solution of absolute orientation, JOSA A 1987; Fischler and Bolles, Random sample
consensus, 1981; Yang et al., Graduated non-convexity for robust spatial perception, RA-L 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from quest.filter.noise import Noise
from quest.filter.surfaces import offsets
from quest.filter.view import View, move

GATE = 14.0
"""Squared residual in standard deviations beyond which a point is not on a body (chi-square, 3 degrees, 0.3 %)."""
LEAST = 8
"""Fewer points that agree are no body."""
_SURFACE_GATE = 9.0
_TRIALS = 200
SCALES = (16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0)
"""How far off a residual may be before it counts less, in gates, from step to step of a fit."""
_FAR = 1e3
"""Metres of depth error where no depth was measured."""


@dataclass(frozen=True)
class Seen:
    """Where N points are seen, and how sure."""

    uv_px: Float[np.ndarray, "N 2"]
    depth_m: Float[np.ndarray, " N"]
    """NaN where there is none, or an edge."""
    covariance: Float[np.ndarray, "N 2 2"]
    """Pixels squared: an edge is told across it, not along it."""
    depth_error_m: Float[np.ndarray, " N"]

    def only(self, which: np.ndarray) -> Seen:
        """Some of the points."""
        return Seen(self.uv_px[which], self.depth_m[which], self.covariance[which], self.depth_error_m[which])

    @property
    def spread(self) -> Float[np.ndarray, "N 3 3"]:
        """Covariance of pixel and depth."""
        spread = np.zeros((len(self.uv_px), 3, 3))
        spread[:, :2, :2] = self.covariance
        spread[:, 2, 2] = np.where(np.isfinite(self.depth_m), self.depth_error_m, _FAR) ** 2
        return spread

    def off(self, uv_px: Float[np.ndarray, "*B N 2"], depth_m: Float[np.ndarray, "*B N"]) -> np.ndarray:
        """From predicted pixels and depths to those seen."""
        deep = self.depth_m - depth_m
        return np.concatenate([self.uv_px - uv_px, np.where(np.isfinite(deep), deep, 0.0)[..., None]], axis=-1)


def misfit(point_world: Float[np.ndarray, "*B N 3"], seen: Seen, view: View) -> Float[np.ndarray, "*B N"]:
    """Squared residuals of points that should be at some places, in standard deviations."""
    uv_px, depth_m = view.project(point_world.reshape(-1, 3))
    shape = point_world.shape[:-1]
    off = seen.off(uv_px.reshape(*shape, 2), depth_m.reshape(shape))
    value = np.einsum("...ni,nij,...nj->...n", off, np.linalg.inv(seen.spread), off)
    return np.where(np.isfinite(value), value, np.inf)


def misfit_unsure(
    point_world: Float[np.ndarray, "N 3"],
    middle: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "6 6"],
    error_world: Float[np.ndarray, "N 3"],
    seen: Seen,
    view: View,
) -> Float[np.ndarray, " N"]:
    """The same where pose and places are known up to some error.

    The covariance is of the pose: of a turn about the middle and a shift. ``error_world`` is the standard deviation of
    each point's place, along the ray on which it was seen.
    """
    off, _ = _linearise(point_world, middle, seen, view)
    spread = seen.spread + predicted_spread(point_world, middle, covariance, error_world, view)
    try:
        inverse = np.linalg.inv(spread)
    except np.linalg.LinAlgError:  # of points right before or behind the camera nothing is told
        inverse = np.linalg.inv(np.where((np.linalg.det(spread) > 0)[:, None, None], spread, np.nan))
    value = np.einsum("ni,nij,nj->n", off, inverse, off)
    return np.where(np.isfinite(value), value, np.inf)


def predicted_spread(
    point_world: Float[np.ndarray, "N 3"],
    middle: Float[np.ndarray, "3"],
    covariance: Float[np.ndarray, "6 6"],
    error_world: Float[np.ndarray, "N 3"],
    view: View,
) -> Float[np.ndarray, "N 3 3"]:
    """Covariance of pixel and depth of points, with errors of pose and place as of :func:`misfit_unsure`."""
    jacobian = _derivatives(point_world, middle, view)[1]
    own = (jacobian[..., 3:] @ error_world[..., None])[..., 0]
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2) + own[:, :, None] * own[:, None]


@dataclass(frozen=True)
class Surface:
    """M points of a body and their normals, metres on the body."""

    place: Float[np.ndarray, "M 3"]
    normal: Float[np.ndarray, "M 3"]


def fit(
    place: Float[np.ndarray, "N 3"],
    seen: Seen,
    surface: Surface,
    view: View,
    expected: Float[np.ndarray, "4 4"],
    middle: Float[np.ndarray, "3"],
    known: Float[np.ndarray, "6 6"],
    joint: tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"]],
    noise: Noise,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """The pose of a body, by Gauss-Newton with robust weights.

    Args:
        place: points on the body, metres.
        seen: where they are seen.
        surface: points that only depth tells of.
        view: of the frame.
        expected: ``world_from_body`` to begin with.
        middle: about which it turns, metres in the world.
        known: information of ``expected``.
        joint: a turn and a shift from there that a joint asks for, and their information.
        noise: parameters.

    Returns:
        The pose, and the information of a turn about the middle and a shift by this frame alone.
    """
    pose, change = expected.copy(), np.zeros(6)
    inverse = np.linalg.inv(seen.spread)
    told = np.zeros((6, 6))
    for scale in SCALES:
        off, jacobian = _linearise(move(pose, place), middle + change[3:], seen, view)
        weight = (1 + np.einsum("ni,nij,nj->n", off, inverse, off) / (scale * GATE)) ** -2
        weighted = weight[:, None, None] * np.swapaxes(jacobian, -1, -2) @ inverse
        told = (weighted @ jacobian).sum(axis=0)
        pull = np.einsum("nij,nj->i", weighted, off)
        if len(surface.place):
            normal = surface.normal @ pose[:3, :3].T
            residual, flat = offsets(move(pose, surface.place), normal, middle + change[3:], view, noise)
            light = noise.surface * (1 + residual**2 / (scale * _SURFACE_GATE)) ** -2
            told = told + (flat * light[:, None]).T @ flat
            pull = pull + (flat * light[:, None]).T @ residual
        told, pull = told + joint[1], pull + joint[1] @ (joint[0] - change)
        delta = np.linalg.solve(told + known, pull - known @ change)
        turn = Rotation.from_rotvec(delta[:3]) * Rotation.from_rotvec(change[:3])
        change = np.concatenate([turn.as_rotvec(), change[3:] + delta[3:]])
        pose = _moved(expected, middle, change)
    return pose, told


def _moved(
    pose: Float[np.ndarray, "4 4"], middle: Float[np.ndarray, "3"], change: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "4 4"]:
    """A pose after a turn about a middle and a shift."""
    turn, moved = Rotation.from_rotvec(change[:3]).as_matrix(), pose.copy()
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] = middle + change[3:] + turn @ (pose[:3, 3] - middle)
    return moved


def _linearise(
    point: Float[np.ndarray, "N 3"], middle: Float[np.ndarray, "3"], seen: Seen, view: View
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 6"]]:
    """From predicted to seen (x, y, depth), and its derivatives by a turn about the middle and a shift."""
    predicted, jacobian = _derivatives(point, middle, view)
    return seen.off(predicted[:, :2], predicted[:, 2]), jacobian


def _derivatives(
    point: Float[np.ndarray, "N 3"], middle: Float[np.ndarray, "3"], view: View
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 6"]]:
    """Where points are seen (x, y, depth), and the derivatives of that by a turn about the middle and a shift."""
    rotate = view.cam_from_world[:3, :3]
    cam = point @ rotate.T + view.cam_from_world[:3, 3]
    depth = np.maximum(cam[:, 2], 1e-6)
    uv_px = (cam @ view.matrix.T)[:, :2] / depth[:, None]
    by_cam = np.zeros((len(point), 3, 3))
    by_cam[:, :2] = (view.matrix[None, :2] - uv_px[:, :, None] * view.matrix[None, 2:]) / depth[:, None, None]
    by_cam[:, 2, 2] = 1.0
    arm = point - middle
    by_motion = np.zeros((len(point), 3, 6))
    by_motion[:, 0, 1], by_motion[:, 0, 2] = arm[:, 2], -arm[:, 1]
    by_motion[:, 1, 0], by_motion[:, 1, 2] = -arm[:, 2], arm[:, 0]
    by_motion[:, 2, 0], by_motion[:, 2, 1] = arm[:, 1], -arm[:, 0]
    by_motion[:, :, 3:] = np.eye(3)
    return np.concatenate([uv_px, cam[:, 2:]], axis=1), by_cam @ rotate @ by_motion


def align(start: Float[np.ndarray, "*B N 3"], end: Float[np.ndarray, "*B N 3"]) -> Float[np.ndarray, "*B 4 4"]:
    """The rigid motions that take points to others with the least squared distance (Horn)."""
    middle, there = start.mean(axis=-2, keepdims=True), end.mean(axis=-2, keepdims=True)
    left, _, right = np.linalg.svd(np.swapaxes(start - middle, -1, -2) @ (end - there))
    flip = np.ones(left.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(left @ right))
    turn = np.swapaxes(right, -1, -2) @ (flip[..., None] * np.swapaxes(left, -1, -2))
    pose = np.zeros((*turn.shape[:-2], 4, 4))
    pose[..., :3, :3], pose[..., 3, 3] = turn, 1.0
    pose[..., :3, 3] = there[..., 0, :] - np.einsum("...ij,...j->...i", turn, middle[..., 0, :])
    return pose


def common_motion(
    start_world: Float[np.ndarray, "N 3"], seen: Seen, view: View, noise: Noise
) -> tuple[Float[np.ndarray, "4 4"], Bool[np.ndarray, " N"]] | None:
    """The rigid motion from where unexplained points were to where they are seen, and the points that share it.

    None where fewer than :data:`LEAST` points do.
    """
    count = len(start_world)
    if count < LEAST:
        return None
    end = view.lift(seen.uv_px, seen.depth_m)
    rng = np.random.default_rng(count)
    near = np.argsort(((start_world[:, None] - start_world) ** 2).sum(axis=-1), axis=1)
    first = rng.integers(count, size=_TRIALS)
    pick = rng.integers(1, max(LEAST, count // 3), size=(_TRIALS, 2))
    triple = np.concatenate([first[:, None], np.take_along_axis(near[first], pick, axis=1)], axis=1)
    pose = align(start_world[triple], end[triple])
    agree = misfit(move(pose[:, None], start_world), seen, view) < GATE
    best = int(agree.sum(axis=1).argmax())
    inlier = agree[best]
    if inlier.sum() < LEAST:
        return None
    middle = end[inlier].mean(axis=0)
    free, nothing = 1e-6 * np.eye(6), Surface(np.zeros((0, 3)), np.zeros((0, 3)))
    still = np.zeros(6), np.zeros((6, 6))
    motion = fit(start_world[inlier], seen.only(inlier), nothing, view, pose[best], middle, free, still, noise)[0]
    inlier = misfit(move(motion, start_world), seen, view) < GATE
    return (motion, inlier) if inlier.sum() >= LEAST else None
