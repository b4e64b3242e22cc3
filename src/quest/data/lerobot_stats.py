"""Statistics of features as LeRobot keeps them, by which policies normalise.

Reference: lerobot 0.6.2, ``lerobot/datasets/compute_stats.py``; Chan, Golub and LeVeque 1979 for merging variances.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

_FRAMES = 100
_SIDE = 100

Stats = dict[str, np.ndarray]


def feature_stats(values: Shaped[np.ndarray, "T *n"]) -> Stats:
    """Of a number or a vector per frame; what is not finite is left out, and a place without a value has zeros."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    return _stats(rows) | {"count": np.array([len(rows)])}


def image_stats(pictures: Shaped[np.ndarray, "T H W *C"], scale: float) -> Stats:
    """Of up to a hundred pictures, thinned to about a hundred pixels a side, per channel and divided by ``scale``.

    All but the count have the shape (channels, 1, 1).
    """
    index = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), _FRAMES)).round().astype(int))
    step = max(1, max(pictures.shape[1:3]) // _SIDE)
    sample = pictures[index][:, ::step, ::step]
    channels = sample.shape[3] if sample.ndim == 4 else 1
    found = _stats(sample.reshape(-1, channels).astype(np.float64) / scale)
    return {name: value.reshape(channels, 1, 1) for name, value in found.items()} | {"count": np.array([len(index)])}


def merge_stats(first: Stats | None, second: Stats) -> Stats:
    """Of two parts together. Quantiles cannot be merged: the outer of both is kept, which bounds them."""
    if first is None:
        return second
    counts = np.array([first["count"][0], second["count"][0]], dtype=np.float64)
    share = counts / counts.sum()
    mean = share[0] * first["mean"] + share[1] * second["mean"]
    variance = sum(
        weight * (part["std"] ** 2 + (part["mean"] - mean) ** 2)
        for weight, part in zip(share, (first, second), strict=True)
    )
    merged = {
        "min": np.minimum(first["min"], second["min"]),
        "max": np.maximum(first["max"], second["max"]),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": first["count"] + second["count"],
    }
    for name, q in QUANTILES.items():
        merged[name] = (np.minimum if q <= 0.5 else np.maximum)(first[name], second[name])
    return merged


def _stats(rows: np.ndarray) -> Stats:
    found = {name: np.zeros(rows.shape[1]) for name in ("min", "max", "mean", "std", *QUANTILES)}
    for column, values in enumerate(rows.T):
        finite = values[np.isfinite(values)]
        if finite.size == 0:
            continue
        found["min"][column], found["max"][column] = finite.min(), finite.max()
        found["mean"][column], found["std"][column] = finite.mean(), finite.std()
        for name, value in zip(QUANTILES, np.quantile(finite, list(QUANTILES.values())), strict=True):
            found[name][column] = value
    return found
