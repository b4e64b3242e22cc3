"""Evidence of depth along the ray on which a query was named: how deep it lies, by the depths of all frames.

One depth may well be that of the door behind a thin handle, or be missing. So a histogram filter over places along that
ray, which goes with the body, gathers the depths of all frames.

Reference: Thrun, Burgard and Fox, Probabilistic Robotics, 2005, chapter 4.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from quest.filter.noise import Noise
from quest.filter.surfaces import depth_error, occluded_ratio, seen_ratio

ALONG_M: Float[np.ndarray, " R"] = np.linspace(-0.2, 0.2, 41)
"""How much farther along the ray than the first depth said, metres."""
_AROUND = 3
"""Steps on either side of the most probable one that are one place."""


def depths_told(
    depth_m: Float[np.ndarray, " K"],
    deeper: Float[np.ndarray, " K"],
    along_m: Float[np.ndarray, " K"],
    measured_m: Float[np.ndarray, " K"],
    seen: Float[np.ndarray, " K"],
    elsewhere: Float[np.ndarray, " K"],
    noise: Noise,
) -> Float[np.ndarray, "K R"]:
    """Log-likelihood ratio of each of :data:`ALONG_M`, by a depth measured where queries should be.

    At each the query is seen, or behind what is nearer; or it is elsewhere, and the depth is of something else.

    Args:
        depth_m: predicted, metres; NaN where it is not.
        deeper: by how much that grows along the ray, metres a metre.
        along_m: how far along it is predicted.
        measured_m: NaN where nothing was measured.
        seen: log-odds that it is seen there and not occluded there, by looks alone.
        elsewhere: log-odds that it is elsewhere and not occluded there.
        noise: parameters.
    """
    expected = depth_m[:, None] + (ALONG_M - along_m[:, None]) * deeper[:, None]
    off_m, spread_m = measured_m[:, None] - expected, depth_error(expected, noise)
    there = seen[:, None] + seen_ratio(off_m, spread_m, noise)
    return np.logaddexp(np.logaddexp(there, occluded_ratio(off_m, spread_m, noise)), elsewhere[:, None])


def most_probable(told: Float[np.ndarray, "K R"], noise: Noise) -> Float[np.ndarray, " K"]:
    """How far along the ray queries are, metres: the mean around the maximum."""
    log_p = told - (ALONG_M / noise.relief_m) ** 2 / 2
    best = log_p.argmax(axis=1)[:, None]
    near = abs(np.arange(len(ALONG_M)) - best) <= _AROUND
    p = np.where(near, np.exp(log_p - np.take_along_axis(log_p, best, axis=1)), 0.0)
    return np.asarray((p * ALONG_M).sum(axis=1) / p.sum(axis=1))
