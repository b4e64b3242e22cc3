"""Tracks of points on joints with known axes."""

from __future__ import annotations

import numpy as np

from quest.grounding import JointKind


def unit(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def make_track(
    kind: JointKind, *, amount: float, sigma: float, seed: int, n: int = 60, radius: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noisy points that start slowly and stop slowly, the axis, and a point of it."""
    rng = np.random.default_rng(seed)
    axis, origin = unit(rng), 0.5 * rng.normal(size=3)
    s = np.linspace(0, 1, n)
    q = amount * (10 * s**3 - 15 * s**4 + 6 * s**5)
    across = np.cross(axis, unit(rng))
    across /= np.linalg.norm(across)
    if kind is JointKind.REVOLUTE:
        turned = np.cos(q)[:, None] * across + np.sin(q)[:, None] * np.cross(axis, across)
        points = origin + radius * turned
    else:
        points = origin + q[:, None] * axis
    return points + sigma * rng.normal(size=points.shape), axis, origin


def angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    """Angle between two axes, whatever their signs."""
    return float(np.degrees(np.arccos(min(1.0, abs(float(one @ other))))))
