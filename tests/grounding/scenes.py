"""Points of several queries on doors and drawers that move together or one after the other."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

FRAMES = 120


def opened(amount: float, first: int, last: int) -> np.ndarray:
    """A position per frame that starts and stops slowly, between two frames."""
    s = np.clip((np.arange(FRAMES) - first) / (last - first), 0, 1)
    return amount * (10 * s**3 - 15 * s**4 + 6 * s**5)


def turning(q: np.ndarray, axis: np.ndarray, origin: np.ndarray, point: np.ndarray) -> np.ndarray:
    return origin + Rotation.from_rotvec(q[:, None] * axis).apply(point - origin)


def door(seed: int, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two points of one door (T x 2 x 3), and its axis."""
    turn, origin = frame(seed)
    points = [origin + turn @ place for place in ([0.5, 0.0, 0.1], [0.35, 0.0, -0.3])]
    return np.stack([turning(q, turn[:, 2], origin, p) for p in points], axis=1), turn[:, 2]


def two_doors(seed: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The handles of two doors with hinges on opposite sides."""
    turn, origin = frame(seed)
    other = origin + 0.8 * turn[:, 0]
    return np.stack(
        [
            turning(first, turn[:, 2], origin, origin + turn @ [0.38, 0.0, 0.1]),
            turning(-second, turn[:, 2], other, other + turn @ [-0.38, 0.0, 0.1]),
        ],
        axis=1,
    )


def drawers(seed: int, *q: np.ndarray) -> np.ndarray:
    """Handles of drawers that slide in parallel, each by its own way."""
    turn, origin = frame(seed)
    return np.stack([origin + turn @ [0.2, 0.0, 0.2 * i] + a[:, None] * turn[:, 1] for i, a in enumerate(q)], axis=1)


def frame(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)


def noisy(tracks: np.ndarray, seed: int, *, sigma: float = 0.002, outliers: float = 0.1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    seen = tracks + sigma * rng.normal(size=tracks.shape)
    wrong = rng.random(tracks.shape[:2]) < outliers
    seen[wrong] += rng.normal(0, 0.15, (int(wrong.sum()), 3))
    return seen
