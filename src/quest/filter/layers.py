"""Pictures without depth: points all over them, and the layers that carry these.

Without depth a few points tell no rigid motion, but surfaces of furniture are flat, and the picture of a plane moves
by a homography. Layer 0 is the still world; what it does not explain, such as a door, a hand, or what is nearer to a
camera that moves, founds another. A map is fitted to all points of its layer from their birth to now, never chained,
so what rests stays where it is. Positions are also counted from the picture's middle in its longer sides (*units*).

Reference: Wang and Adelson, Representing moving images with layers, IEEE TIP 1994; Hartley and Zisserman, Multiple View
Geometry in Computer Vision, 2003, section 13; for the fit see :mod:`quest.filter.rigid_motion`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from quest.filter.camera_motion import INLIER_PX
from quest.filter.landmarks import MOST_BODIES, NEIGHBOURS, SURE, members_near, new_corners, surrounded
from quest.filter.local_motion import follow
from quest.filter.noise import Noise
from quest.filter.picture import GreyPicture
from quest.filter.rigid_motion import LEAST, SCALES

GATE = 12.0
"""Squared distance in standard deviations beyond which two places differ (chi-square, 2 degrees, 0.25 %)."""
_LEAST_AREA = 0.01
"""To what share of its area a layer may shrink."""
_FARTHEST = 2.0
"""Units from the middle of the picture beyond which nothing is in view."""
_CHANGES: Float[np.ndarray, "8 3 3"] = np.zeros((8, 3, 3))
"""How a map may change: a shift along x and y, the four of a linear map, and two of perspective."""
_CHANGES[np.arange(8), [0, 1, 0, 0, 1, 1, 2, 2], [2, 2, 0, 1, 0, 1, 0, 1]] = 1.0


@dataclass(frozen=True)
class Layers:
    """N points of the newest frame, and L layers; layer 0 is the still world."""

    uv_px: Float[np.ndarray, "N 2"]
    covariance: Float[np.ndarray, "N 2 2"]
    """Pixels squared, gathered since birth."""
    place: Float[np.ndarray, "N L 2"]
    """On each layer, units."""
    log_weight: Float[np.ndarray, "N L"]
    """Log-odds of being carried by each layer, against being on none of them."""
    map: Float[np.ndarray, "L 3 3"]
    """From places on each layer to the picture, units: the identity where the layer was seen first."""
    map_covariance: Float[np.ndarray, "L 8 8"]
    """Of a small change of it along :data:`_CHANGES`."""
    size: tuple[int, int]
    """Width and height of the picture, pixels."""
    new: int | None = None
    """The layer that began in this frame."""

    @classmethod
    def none(cls, size: tuple[int, int]) -> Layers:
        """Before the first frame."""
        return cls(
            np.zeros((0, 2)),
            np.zeros((0, 2, 2)),
            np.zeros((0, 1, 2)),
            np.zeros((0, 1)),
            np.eye(3)[None],
            np.zeros((1, 8, 8)),
            size,
        )

    def __len__(self) -> int:
        return len(self.map)

    @property
    def layer(self) -> Int[np.ndarray, " N"]:
        """The most probable carrier of each point."""
        return np.asarray(self.log_weight.argmax(axis=1))

    def only(self, which: np.ndarray) -> Layers:
        """Some of the points, on all layers."""
        own = ("uv_px", "covariance", "place", "log_weight")
        return replace(self, **{name: getattr(self, name)[which] for name in own})

    def onto(self, uv_px: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K L 2"]:
        """Places on each layer that are at some pixels now."""
        units = self._units(uv_px)
        return np.stack([_through(np.linalg.inv(each), units) for each in self.map], axis=1)

    def brought(self, place: Float[np.ndarray, "K L 2"]) -> Float[np.ndarray, "K L 2"]:
        """Pixels where the layers bring places on each of them; NaN behind the camera."""
        return self._pixels(np.stack([_through(each, place[:, i]) for i, each in enumerate(self.map)], axis=1))

    def share(self, uv_px: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K L"]:
        """Share of each layer in the points near some pixels."""
        if len(self.uv_px) <= NEIGHBOURS:
            return np.full((len(uv_px), len(self)), 1 / len(self))
        total = members_near(uv_px, self.uv_px, self.log_weight) + 1e-9
        return np.asarray(total / total.sum(axis=1, keepdims=True))

    def world_since(self, before: Layers) -> Float[np.ndarray, "3 3"]:
        """The homography of the still world's pixels since an earlier frame."""
        longer, (width, height) = max(self.size), self.size
        of_units = np.array([[longer, 0, width / 2], [0, longer, height / 2], [0, 0, 1]])
        motion = of_units @ self.map[0] @ np.linalg.inv(before.map[0]) @ np.linalg.inv(of_units)
        return motion / motion[2, 2]

    def _units(self, uv_px: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
        return (uv_px - np.array(self.size) / 2) / max(self.size)

    def _pixels(self, units: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 2"]:
        return units * max(self.size) + np.array(self.size) / 2

    def _with(self, index: int, map: Float[np.ndarray, "3 3"], covariance: Float[np.ndarray, "8 8"]) -> Layers:
        """With another map; one that folds a layer, or shrinks it to nothing, is none."""
        scale = np.linalg.det(map) / map[2, 2] ** 3 if map[2, 2] > 0 else 0.0
        if not scale > _LEAST_AREA:
            return self
        maps, covariances = self.map.copy(), self.map_covariance.copy()
        maps[index], covariances[index] = map / map[2, 2], covariance
        return replace(self, map=maps, map_covariance=covariances)


def observe_layers(layers: Layers, previous: GreyPicture, picture: GreyPicture, dt_s: float, noise: Noise) -> Layers:
    """Follow points into the next frame, and tell the map of each layer, and which of them carries each point."""
    motion = follow(previous, picture, layers.uv_px, layers.uv_px)
    from_px = layers.uv_px[motion.found]
    covariance = layers.covariance + motion.covariance
    layers = replace(layers, uv_px=motion.uv_px, covariance=covariance, new=None).only(motion.found)
    layers = _gone_on(layers, dt_s, noise)
    layer, spread = layers.layer, layers.covariance + noise.point_px**2 * np.eye(2)
    for i in range(len(layers)):
        mine = np.flatnonzero(layer == i)
        layers = _fitted(_guessed(layers, i, from_px[mine], mine), i, mine, spread)
    of_world = layer == 0
    off = ((layers.brought(layers.place)[of_world, 0] - layers.uv_px[of_world]) ** 2).sum(axis=-1)
    if np.isfinite(off).any():  # the median of chi-square is ln 4
        spread = layers.covariance + max(noise.point_px**2, float(np.nanmedian(off)) / np.log(4)) * np.eye(2)
    off = np.stack([_misfit(layers, i, spread) for i in range(len(layers))], axis=1)
    told = (GATE - np.minimum(off, 3 * GATE)) / 2 + np.log(layers.share(layers.uv_px) + noise.stray)
    weight = layers.log_weight + (told - layers.log_weight) * min(dt_s / noise.points_s, 1.0)
    layers = _founded(replace(layers, log_weight=weight), off.min(axis=1) > GATE, spread, dt_s, noise)
    return layers.only(layers.log_weight.max(axis=1) > -SURE)


def sow_layers(layers: Layers, picture: GreyPicture, around_px: Float[np.ndarray, "K 2"]) -> Layers:
    """Add corners where there are none, closer together around the queries."""
    uv_px = new_corners(picture, layers.uv_px, around_px)
    return replace(
        layers,
        uv_px=np.concatenate([layers.uv_px, uv_px]),
        covariance=np.concatenate([layers.covariance, np.zeros((len(uv_px), 2, 2))]),
        place=np.concatenate([layers.place, layers.onto(uv_px)]),
        log_weight=np.concatenate([layers.log_weight, np.log(np.maximum(layers.share(uv_px), 1e-2))]),
    )


def _gone_on(layers: Layers, dt_s: float, noise: Noise) -> Layers:
    """Some time later, before anything is seen: a plane moves as fast as a body does that is one metre away."""
    rate = np.array([noise.speed_m_s] * 2 + [noise.turn_rad_s] * 6)
    return replace(layers, map_covariance=layers.map_covariance + np.diag(2 * noise.stops_s * dt_s * rate**2))


def _guessed(layers: Layers, index: int, from_px: Float[np.ndarray, "M 2"], mine: Int[np.ndarray, " M"]) -> Layers:
    """A layer goes on as most of its points did since the frame before, if they are enough to say so."""
    if len(mine) < LEAST:
        return layers
    both = (layers._units(from_px), layers._units(layers.uv_px[mine]))
    step, _ = cv2.estimateAffinePartial2D(*both, method=cv2.RANSAC, ransacReprojThreshold=INLIER_PX / max(layers.size))
    if step is None:
        return layers
    return layers._with(index, _square(step) @ layers.map[index], layers.map_covariance[index])


def _fitted(layers: Layers, index: int, mine: Int[np.ndarray, " M"], spread: Float[np.ndarray, "N 2 2"]) -> Layers:
    """The most probable map of a layer by where its points are seen: Gauss-Newton with robust weights."""
    known, inverse = np.linalg.inv(layers.map_covariance[index]), np.linalg.inv(spread[mine])
    told, change = np.zeros((8, 8)), np.zeros(8)
    for scale in SCALES:
        off, by_change = _residual(layers, index, mine)
        use = np.asarray(np.isfinite(off).all(axis=1))
        off, by_change = np.where(use[:, None], off, 0.0), np.where(use[:, None, None], by_change, 0.0)
        weight = use * (1 + np.einsum("ni,nij,nj->n", off, inverse, off) / (scale * GATE)) ** -2
        weighted = weight[:, None, None] * np.swapaxes(by_change, 1, 2) @ inverse
        told = (weighted @ by_change).sum(axis=0)
        delta = np.linalg.solve(told + known, np.einsum("nij,nj->i", weighted, off) - known @ change)
        change = change + delta
        # Not by SciPy: threads of its OpenBLAS keep all cores busy with waiting long after such a product.
        moved = torch.linalg.matrix_exp(torch.from_numpy(np.einsum("i,ijk->jk", delta, _CHANGES))).numpy()
        layers = layers._with(index, moved @ layers.map[index], layers.map_covariance[index])
    return layers._with(index, layers.map[index], np.linalg.inv(told + known))


def _misfit(layers: Layers, index: int, spread: Float[np.ndarray, "N 2 2"]) -> Float[np.ndarray, " N"]:
    """Squared distances of where points are seen to where a layer brings them, in standard deviations."""
    off, by_change = _residual(layers, index, np.arange(len(layers.uv_px)))
    spread = spread + by_change @ layers.map_covariance[index] @ np.swapaxes(by_change, 1, 2)
    value = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
    return np.where(np.isfinite(value), value, np.inf)


def _residual(
    layers: Layers, index: int, which: Int[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2 8"]]:
    """From where a layer brings points to where they are seen, pixels, and the derivatives by a change of its map."""
    units = _through(layers.map[index], layers.place[which, index])
    moved = np.einsum("mij,nj->nim", _CHANGES, _homogeneous(units))
    by_change = (moved[:, :2] - units[..., None] * moved[:, 2:]) * max(layers.size)
    return layers.uv_px[which] - layers._pixels(units), by_change


def _founded(
    layers: Layers, odd: Bool[np.ndarray, " N"], spread: Float[np.ndarray, "N 2 2"], dt_s: float, noise: Noise
) -> Layers:
    """With one layer more, if points that no layer explains, and most points near each, share a motion of their own.

    Where there are as many as there may be, it takes the place of one that carries no point any more.
    """
    unused = np.setdiff1d(np.arange(1, len(layers)), layers.layer)
    new = len(layers) if len(layers) < MOST_BODIES else next(iter(unused.tolist()), None)
    free = np.flatnonzero(odd & surrounded(layers.uv_px, odd))
    if len(free) < LEAST or new is None:
        return layers
    both = (layers.place[free, 0], layers._units(layers.uv_px[free]))
    motion, inlier = cv2.estimateAffine2D(*both, method=cv2.RANSAC, ransacReprojThreshold=INLIER_PX / max(layers.size))
    if motion is None or inlier.sum() < LEAST or not np.linalg.det(motion[:, :2]) > _LEAST_AREA:
        return layers
    members = free[inlier[:, 0] > 0]
    joins = np.full(len(layers.uv_px), -SURE)
    joins[members] = SURE
    layers = replace(
        layers,
        place=with_column(layers.place, new, layers.place[:, 0]),
        log_weight=with_column(layers.log_weight, new, joins),
        map=np.concatenate([layers.map[:new], _square(motion)[None], layers.map[new + 1 :]]),
        map_covariance=np.concatenate(
            [layers.map_covariance[:new], np.zeros((1, 8, 8)), layers.map_covariance[new + 1 :]]
        ),
        new=new,
    )
    unsure = _gone_on(layers, dt_s, noise).map_covariance[new]
    return _fitted(layers._with(new, layers.map[new], unsure), new, members, spread)


def with_column(values: np.ndarray, index: int, column: np.ndarray) -> np.ndarray:
    """Values with one column replaced, or one more at the end."""
    return np.concatenate([values[:, :index], column[:, None], values[:, index + 1 :]], axis=1)


def _homogeneous(units: Float[np.ndarray, "*N 2"]) -> Float[np.ndarray, "*N 3"]:
    return np.concatenate([units, np.ones((*units.shape[:-1], 1))], axis=-1)


def _through(map: Float[np.ndarray, "3 3"], units: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    point = _homogeneous(units) @ map.T
    there = point[:, :2] / np.where(point[:, 2:] > 0, point[:, 2:], np.nan)
    return np.where(np.abs(there) < _FARTHEST, there, np.nan)


def _square(affine: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "3 3"]:
    return np.vstack([affine, [0.0, 0.0, 1.0]])
