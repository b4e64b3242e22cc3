"""Vectors of three coordinates, in NumPy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def perpendicular(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Two unit vectors across an axis and each other, the same for the same axis."""
    first = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    first /= np.linalg.norm(first)
    return np.stack((first, np.cross(axis, first)), axis=1)
