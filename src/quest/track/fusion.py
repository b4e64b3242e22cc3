"""One place in the world from what several views say of an entity.

Each view is right, and its point is off by the noise of its depth and of its pixel; or it has lost the entity, and its
point lies anywhere in a volume. Which views are right is not known: all subsets are weighed, by what each view says of
itself and by the product of the Gaussians of those that are right. Views are taken to err independently of each other.
That is not quite so: look-alikes mislead several of them, and one view's point is the anchor of the others.

Reference: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 3.4
(products of Gaussians); Hartigan, Clustering Algorithms, 1975, chapter 5 (mixtures with a uniform component).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from quest.filter.noise import Noise
from quest.filter.surfaces import depth_error
from quest.filter.view import View

MOST_VIEWS = 8
"""All subsets of views are weighed: 256 of eight."""
_LEAST_P = 1e-3
"""No view is believed to be right or lost beyond this."""


@dataclass(frozen=True)
class Fused:
    """What V views together say of one entity."""

    point_world: Float[np.ndarray, "3"]
    """Its place, metres; NaN where no view has a point."""
    covariance: Float[np.ndarray, "3 3"]
    """Of the place if it is right, square metres."""
    right_p: Float[np.ndarray, " V"]
    """Probability that each view follows the entity to that place; 0 of a view without a point."""
    lost_p: float
    """Probability that none of the views does that lead to that place."""


def place_covariance(
    point_world: Float[np.ndarray, "K 3"], visible: Bool[np.ndarray, " K"], view: View, noise: Noise
) -> Float[np.ndarray, "K 3 3"]:
    """Covariance of the world points of one view, square metres.

    Along the ray it is that of depth, across it that of an anchor which is found again, in pixels. What is not seen
    rides on its body, anywhere on its relief.
    """
    ray = point_world - view.centre
    distance = np.linalg.norm(ray, axis=-1)
    along = ray / distance[:, None]
    depth_m = ray @ view.cam_from_world[2, :3]
    across = (depth_m * noise.anchor_px / view.matrix[0, 0]) ** 2
    outer = along[:, :, None] * along[:, None, :]
    deep = depth_error(depth_m, noise) ** 2
    covariance = across[:, None, None] * np.eye(3) + (deep - across)[:, None, None] * outer
    return covariance + np.where(visible, 0.0, noise.relief_m**2)[:, None, None] * np.eye(3)


def fuse(
    point_world: Float[np.ndarray, "V 3"],
    covariance: Float[np.ndarray, "V 3 3"],
    lost_p: Float[np.ndarray, " V"],
    noise: Noise,
) -> Fused:
    """The most probable place, and how probable it is.

    A view's point is NaN where it has none; ``lost_p`` is by what a view knows alone. The volume of a lost view's point
    is the cube of the range of depths of other surfaces.
    """
    known = np.flatnonzero(np.isfinite(point_world).all(axis=-1))
    right_p = np.zeros(len(point_world))
    if not len(known):
        return Fused(np.full(3, np.nan), np.full((3, 3), np.nan), right_p, float(np.prod(lost_p)))
    subset = np.array(list(product((True, False), repeat=len(known))))
    lost = lost_p[known].clip(_LEAST_P, 1 - _LEAST_P)
    middle = point_world[known].mean(axis=0)
    place, spread, agreement = _products(subset[:-1], point_world[known] - middle, covariance[known])
    several = subset[:-1].sum(axis=1) - 1
    log_weight = np.where(subset, np.log(1 - lost), np.log(lost)).sum(axis=1)
    log_weight[:-1] += agreement + 3 * several * np.log(noise.depths_m)
    weight = np.exp(log_weight - np.logaddexp.reduce(log_weight))
    best = subset[weight[:-1].argmax()]
    same = np.asarray((subset & best).any(axis=1))
    right_p[known] = weight[same] @ subset[same]
    found_p = weight[same].sum()
    # The empty subset, which is last, shares no view with any.
    share = weight[:-1] * same[:-1] / found_p
    point = share @ place
    off = place - point
    mixed = np.einsum("s,sij->ij", share, spread + off[:, :, None] * off[:, None, :])
    return Fused(point + middle, mixed, right_p, float(weight[~same].sum()))


def _products(
    subset: Bool[np.ndarray, "S V"], point: Float[np.ndarray, "V 3"], covariance: Float[np.ndarray, "V 3 3"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3 3"], Float[np.ndarray, " S"]]:
    """Mean and covariance of the product of each subset's Gaussians, and the logarithm of its integral."""
    precision = np.linalg.inv(covariance)
    pulled = np.einsum("vij,vj->vi", precision, point)
    chosen = subset.astype(np.float64)
    spread = np.linalg.inv(np.einsum("sv,vij->sij", chosen, precision))
    total = chosen @ pulled
    mean = np.einsum("sij,sj->si", spread, total)
    squares = chosen @ (point * pulled).sum(axis=-1) - (mean * total).sum(axis=-1)
    volume = np.linalg.slogdet(spread)[1] - chosen @ np.linalg.slogdet(covariance)[1]
    return mean, spread, (volume - squares - 3 * np.log(2 * np.pi) * (chosen.sum(axis=1) - 1)) / 2
