"""Evidence of depth: points of surfaces, plain ones too, that each body brings along.

Each point keeps its place and normal on every body since its birth. Where a body would bring it, the depth there is as
predicted, or nearer (something is in front), or farther (it is not there): so a point learns which body it is on, and
its distance to the measured surface along its normal is a residual of that body's pose.

Reference: Chen and Medioni, Object modelling by registration of multiple range images, 1992; Blais and Levine,
Registering multiview range data, PAMI 1995.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtr

from quest.filter.noise import Noise
from quest.filter.view import View, in_image, move, move_back

_CELL_PX = 12
_REACH_PX = 3
_LEAST_KNOWN = 500
"""Depths without which their noise is not told."""
_MOST = 4000
"""Points beyond that are forgotten, the oldest first."""


@dataclass(frozen=True)
class Surfaces:
    """M points, on B bodies."""

    place: Float[np.ndarray, "M B 3"]
    """On each body, metres."""
    normal: Float[np.ndarray, "M B 3"]
    log_weight: Float[np.ndarray, "M B"]
    """Log-likelihood ratio of the depth where each body brings it, against any depth."""

    @classmethod
    def none(cls) -> Surfaces:
        """Before the first frame."""
        return cls(np.zeros((0, 1, 3)), np.zeros((0, 1, 3)), np.zeros((0, 1)))

    def point_world(self, pose: Float[np.ndarray, "B 4 4"]) -> Float[np.ndarray, "M 3"]:
        """Where each is, if its most probable body carries it."""
        return move(pose[self.body], self.rest)

    @property
    def rest(self) -> Float[np.ndarray, "M 3"]:
        """Where each was before its most probable body moved, metres."""
        return self.place[np.arange(len(self.body)), self.body]

    @property
    def body(self) -> Int[np.ndarray, " M"]:
        """The most probable carrier of each point."""
        return np.asarray(self.log_weight.argmax(axis=1))

    def with_one(self) -> Surfaces:
        """The same with one body more, that began to move."""
        return Surfaces(
            np.concatenate([self.place, self.place[:, :1]], axis=1),
            np.concatenate([self.normal, self.normal[:, :1]], axis=1),
            np.concatenate([self.log_weight, np.zeros((len(self.place), 1))], axis=1),
        )

    def only(self, which: np.ndarray) -> Surfaces:
        """Some of the points."""
        return Surfaces(*(value[which] for value in vars(self).values()))


def depth_ratio(
    off_m: Float[np.ndarray, "*N"], spread_m: Float[np.ndarray, "*N"], noise: Noise
) -> Float[np.ndarray, "*N"]:
    """Log-likelihood ratio of a depth against any depth; 0 behind an occluder.

    ``off_m`` is measured less predicted depth, NaN where nothing was measured, and ``spread_m`` its standard deviation.
    """
    off = off_m / spread_m
    agrees = (1 - noise.stray) * np.exp(-(off**2) / 2) / (np.sqrt(2 * np.pi) * spread_m) + noise.stray / noise.depths_m
    told = np.isfinite(off) & (off > -3)
    return np.where(told, np.log(np.where(told, agrees, 1.0) * noise.depths_m), 0.0)


def seen_ratio(
    off_m: Float[np.ndarray, "*N"], spread_m: Float[np.ndarray, "*N"], noise: Noise
) -> Float[np.ndarray, "*N"]:
    """The same of what is seen: a depth in front of it is a stray one."""
    return np.where(off_m < -3 * spread_m, np.log(noise.stray), depth_ratio(off_m, spread_m, noise))


def occluded_ratio(
    off_m: Float[np.ndarray, "*N"], spread_m: Float[np.ndarray, "*N"], noise: Noise
) -> Float[np.ndarray, "*N"]:
    """The same of what is there and not seen: a depth behind it is a stray one."""
    return np.where(off_m > 3 * spread_m, np.log(noise.stray), 0.0)


def in_front(
    off_m: Float[np.ndarray, "*N"], spread_m: Float[np.ndarray, "*N"], noise: Noise
) -> Float[np.ndarray, "*N"]:
    """How probable it is that a depth is of something in front of what is predicted, and not of that; 0 without depth.

    Arguments are those of :func:`depth_ratio`. What is in front is anywhere there.
    """
    off = np.nan_to_num(off_m / spread_m, nan=np.inf)
    front = ndtr(-off) / noise.depths_m
    there = np.exp(-(off**2) / 2) / (np.sqrt(2 * np.pi) * spread_m)
    return np.divide(front, front + there, out=np.zeros_like(front), where=front > 0)


def depth_error(depth_m: Float[np.ndarray, "*N"], noise: Noise) -> Float[np.ndarray, "*N"]:
    """Standard deviation of a depth, metres."""
    depth_m = np.nan_to_num(depth_m, nan=1.0)
    return np.maximum(np.maximum(noise.depth_m, noise.depth * depth_m), noise.depth_grows * depth_m**2)


def depth_growth(depth_m: Float[np.ndarray, "H W"]) -> float | None:
    """How much depth errs by chance for its square, 1/m, told by one frame; None where too little of it is known.

    Of three pixels in a row on a plane the inverse depth in the middle is the mean of the outer ones. By how much it is
    not tells the noise, for most pixels are on surfaces that are nearly flat. In cameras that measure disparity it
    grows with the square of the depth.
    """
    apart, sample = 4, depth_m[::2].astype(np.float64)
    left, middle, right = sample[:, : -2 * apart : 3], sample[:, apart:-apart:3], sample[:, 2 * apart :: 3]
    known = (left > 0) & (middle > 0) & (right > 0)
    if known.sum() < _LEAST_KNOWN:
        return None
    off = 1 / middle[known] - (1 / left[known] + 1 / right[known]) / 2
    return float(np.median(abs(off)) / (0.6745 * np.sqrt(1.5)))  # the median of |x| of a normal x is 0.6745


def measure(
    surfaces: Surfaces,
    pose: Float[np.ndarray, "B 4 4"],
    share: Float[np.ndarray, "M B"],
    view: View,
    dt_s: float,
    noise: Noise,
) -> Surfaces:
    """Weigh the bodies by the depth where they bring each point; drop what is on none of them.

    ``share`` says how probable each body is there before depth is seen.
    """
    if view.depth_m is None or not len(surfaces.place):
        return surfaces
    point = move(pose, surfaces.place)
    uv_px, depth_m = (each.reshape(*point.shape[:2], *each.shape[1:]) for each in view.project(point.reshape(-1, 3)))
    turned = np.einsum("bij,mbj->mbi", pose[:, :3, :3], surfaces.normal)
    measured = np.where(((point - view.centre) * turned).sum(axis=-1) < 0, _pixel(view.depth_m, uv_px), np.nan)
    ratio = depth_ratio(measured - depth_m, depth_error(depth_m, noise), noise)
    ratio += np.log(share + noise.stray)
    weight = surfaces.log_weight + (ratio - surfaces.log_weight) * min(dt_s / noise.points_s, 1.0)
    body = weight.argmax(axis=1)
    best = weight.max(axis=1)
    return replace(surfaces, log_weight=weight).only((best > 0.5) | ((body > 0) & (best > -1)))


def sow_surfaces(surfaces: Surfaces, pose: Float[np.ndarray, "B 4 4"], view: View) -> Surfaces:
    """Add points on a grid where none is seen and the surface has a normal."""
    if view.depth_m is None:
        return surfaces
    height, width = view.depth_m.shape
    line = [np.arange(_CELL_PX / 2, side, _CELL_PX) for side in (width, height)]
    grid = np.stack(np.meshgrid(*line), axis=-1)
    taken = np.zeros((len(line[1]), len(line[0])), dtype=bool)
    if len(surfaces.place):
        uv_px, _ = view.project(surfaces.point_world(pose))
        inside = in_image(uv_px, (width, height)) & (surfaces.log_weight.max(axis=1) > 0.5)
        column, row = np.floor(uv_px[inside] / _CELL_PX).astype(np.int64).T
        taken[row.clip(0, len(line[1]) - 1), column.clip(0, len(line[0]) - 1)] = True
    uv_px = grid[~taken].reshape(-1, 2)
    point, normal, good = _planes(view, uv_px)
    point, normal = (np.repeat(each[good][:, None], len(pose), axis=1) for each in (point, normal))
    turned = pose.copy()
    turned[:, :3, 3] = 0
    new = (move_back(pose, point), move_back(turned, normal), np.ones((int(good.sum()), len(pose))))
    return Surfaces(*(np.concatenate(each)[-_MOST:] for each in zip(vars(surfaces).values(), new, strict=True)))


def _planes(
    view: View, uv_px: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
    """Points, normals, and whether the depth is a plane around there."""
    reach = np.array([[0, 0], [_REACH_PX, 0], [-_REACH_PX, 0], [0, _REACH_PX], [0, -_REACH_PX]], dtype=np.float64)
    assert view.depth_m is not None
    depth_m = _pixel(view.depth_m, uv_px[:, None] + reach)
    point = view.lift((uv_px[:, None] + reach).reshape(-1, 2), depth_m.reshape(-1)).reshape(-1, 5, 3)
    normal = np.cross(point[:, 1] - point[:, 2], point[:, 3] - point[:, 4])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    with np.errstate(invalid="ignore"):
        curved = np.abs(depth_m[:, 1:] - depth_m[:, :1]).max(axis=1) < 0.03 * depth_m[:, 0]
        ray = point[:, 0] - view.centre
        slant = (normal * ray).sum(axis=-1, keepdims=True)
        normal = -np.sign(slant) * normal
        facing = np.abs(slant[:, 0]) > 0.2 * np.linalg.norm(ray, axis=-1)
    return point[:, 0], normal, curved & facing & np.isfinite(normal).all(axis=-1)


def _pixel(depth_m: Float[np.ndarray, "H W"], uv_px: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N"]:
    """Depth of single pixels; NaN where there is none."""
    height, width = depth_m.shape
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((uv_px >= 0) & (uv_px < (width, height))).all(axis=-1))
    column, row = np.floor(np.where(inside[..., None], uv_px, 0)).astype(np.int64).reshape(-1, 2).T
    value = depth_m[row, column].astype(np.float64).reshape(inside.shape)
    return np.where(inside & (value > 0), value, np.nan)


def offsets(
    point: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    middle: Float[np.ndarray, "3"],
    view: View,
    noise: Noise,
) -> tuple[Float[np.ndarray, " M"], Float[np.ndarray, "M 6"]]:
    """Distances of points to the measured surface, and their derivatives by a turn about the middle and a shift.

    They are along the normal, in standard deviations; 0 where nothing was measured.
    """
    assert view.depth_m is not None
    uv_px, depth_m = view.project(point)
    measured = _pixel(view.depth_m, uv_px)
    off = (normal * (view.lift(uv_px, measured) - point)).sum(axis=-1)
    ray = point - view.centre
    slant = -(normal * ray).sum(axis=-1) / np.linalg.norm(ray, axis=-1)
    spread = depth_error(depth_m, noise) * np.maximum(slant, 0.2)
    told = np.isfinite(off) & (slant > 0)
    jacobian = np.concatenate([np.cross(point - middle, normal), normal], axis=-1) / spread[:, None]
    return np.where(told, off / spread, 0.0), np.where(told[:, None], jacobian, 0.0)
