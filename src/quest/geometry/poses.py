"""Camera poses as they come from outside: rounded, and not always rigid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

RIGID_TOLERANCE = 1e-3
"""How far the product of a rotation with its transpose may be off: numbers in files are rounded."""


def is_rigid(pose: Float[np.ndarray, "*T 4 4"]) -> bool:
    """Whether poses are finite rotations and translations with a last row 0 0 0 1, up to rounding."""
    rotation = pose[..., :3, :3]
    if not np.isfinite(pose).all() or not np.allclose(pose[..., 3, :], [0, 0, 0, 1]):
        return False
    off = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max()
    return bool(off < RIGID_TOLERANCE and (np.linalg.det(rotation) > 0).all())


def nearest_rigid(pose: Float[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The rigid pose nearest to one that is rigid up to rounding."""
    exact = np.array(pose, np.float64)
    left, _, right = np.linalg.svd(exact[:3, :3])
    exact[:3, :3] = left @ right
    return exact
