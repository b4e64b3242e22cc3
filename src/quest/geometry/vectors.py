"""Vectors of three coordinates, in NumPy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: Float[np.ndarray, "*#B 3"], b: Float[np.ndarray, "*#B 3"]) -> Float[np.ndarray, "*B 3"]:
    """Cross products along the last axis.

    To the last bit what ``np.cross`` gives, ten times faster for the few vectors of a joint, of which a frame has
    dozens per query.
    """
    return a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)


def perpendicular(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Two unit vectors across an axis and each other, the same for the same axis."""
    other = np.eye(3)[int(np.abs(axis).argmin())]
    first = cross(axis, other)
    first = first / np.linalg.norm(first)
    return np.stack((first, cross(axis, first)), axis=1)
