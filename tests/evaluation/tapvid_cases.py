"""Random and adversarial inputs of the TAP-Vid metrics, made again from a seed by whoever needs them.

They and the reference evaluators' answers to them (``tapvid_reference.npz``) hold the metrics to the originals.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SEEDS = {"tapvid": 720, "tapvid3d": 576, "redetection": 270, "survival": 180}
SCALINGS = ("median", "per_trajectory", "local_neighborhood", "none")


def inputs(kind: str, seed: int) -> dict[str, Any]:
    """Positional and keyword arguments of a metric; every ninth seed is plain, the others are each odd in their way."""
    rng = np.random.Generator(np.random.PCG64([sorted(SEEDS).index(kind), seed]))
    odd, single = seed % 9, kind in ("redetection", "survival")
    long = kind == "redetection" and seed % 5 == 0
    videos, tracks = int(rng.integers(1, 4)), int(rng.integers(1, 6))
    frames = int(rng.integers(270, 300)) if long else int(rng.integers(2, 16))
    scaling = SCALINGS[seed // 9 % 4]
    lead = (tracks,) if single or (kind == "tapvid3d" and scaling == "local_neighborhood") else (videos, tracks)
    occluded, said = _flags(rng, (*lead, frames), long), _flags(rng, (*lead, frames), long)
    query = rng.integers(0, frames, size=lead) * (kind in ("tapvid", "tapvid3d"))
    three = kind == "tapvid3d"
    points = _points(rng, (*lead, frames), three)
    least, most = (2, 8) if kind == "survival" else (-3, 6)
    steps = 2.0 ** rng.integers(least, most, size=(*lead, frames, 1))
    gap = (rng.random((*lead, frames, 3 if three else 2)) - 0.5) * 2 * steps * (0.01 if three else 1.0)
    answer = points + gap
    if odd == 1 and kind != "survival":  # the original survival takes NaN for right
        answer[rng.random(answer.shape[:-1]) < 0.3] = np.nan
    elif odd == 2:
        occluded[0] = True  # nothing of a video or track is visible
    elif odd == 3:
        said[...] = True
    elif odd == 4:  # exactly at a distance, and a hair on either side
        points, aside = np.round(points * 8) / 8, np.array([1, 2, 4, 8, 16, 50.0])[rng.integers(0, 6, (*lead, frames))]
        answer = points + 0.0
        answer[..., 0] += np.nextafter(aside, aside + rng.integers(-1, 2, aside.shape)) if seed % 2 else aside
    elif odd == 5:
        query[...] = (frames - 1) * (query.max() > 0)  # no frame comes after it
    elif odd == 6:
        points, answer = points.astype(np.float32), answer.astype(np.float32)
    elif odd == 7:
        answer, said = points.copy(), occluded.copy()
    elif odd == 8:
        answer[..., 0, :] = np.inf if kind == "tapvid" else -answer[..., 0, :]
    if three:
        answer = (answer * rng.choice(np.array([0.25, 1.0, 1.5]))).astype(answer.dtype)
    focal = 100 + 300 * rng.random((*lead[:-1], 4))
    return {
        "query_frame": query, "occluded": occluded, "points": points, "said_occluded": said, "said_points": answer,
        "queries": ("first", "strided")[seed // 9 % 2], "scaling": scaling, "intrinsics": focal,
        "fixed": seed // 36 % 2 == 1, "per_track": seed % 4 == 0,
    }  # fmt: skip


def _flags(rng: np.random.Generator, shape: tuple[int, ...], long: bool) -> np.ndarray:
    """Occlusions that last: a flag changes from one frame to the next with a probability of its own."""
    change = rng.random((*shape[:-1], 1)) * (0.03 if long else 0.6)
    start = rng.random((*shape[:-1], 1)) < 0.3
    return start ^ (np.cumsum(rng.random(shape) < change, axis=-1) % 2 == 1)


def _points(rng: np.random.Generator, shape: tuple[int, ...], three: bool) -> np.ndarray:
    """Pixels, or metres in front of the camera, where tracks come nearer to each other than 5 cm."""
    if not three:
        return rng.random((*shape, 2)) * 256
    middle = np.array([0.0, 0.0, 0.5]) + rng.random(3) * [1, 1, 3]
    return middle + (rng.random((*shape[:-1], 1, 3)) - 0.5) * 0.08 + (rng.random((*shape, 3)) - 0.5) * 0.02
