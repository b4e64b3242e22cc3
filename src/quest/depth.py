"""Depth images in metres: missing values, and units that cannot be right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from quest.errors import RecordingError

PLAUSIBLE_DEPTH_M = (0.05, 50.0)
"""A clip whose median depth lies outside is taken to be in other units."""

_USUAL_SCALES_M = (1e-3, 1e-4, 2e-4, 1e-2, 1e-5, 1e-6, 0.1, 1.0)
_USUAL_DEPTH_M = 1.5


def clean_depth(depth_m: Shaped[np.ndarray, "*S"]) -> Float32[np.ndarray, "*S"]:
    """Depth as float32 in which 0 stands for whatever was not finite or not positive."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float32)


def metres(units: Shaped[np.ndarray, "*S"], unit_m: float) -> Float32[np.ndarray, "*S"]:
    """Depth of an image in some unit; the largest of 16 bits says, as 0 does, that there is none."""
    missing = units == np.iinfo(np.uint16).max if np.issubdtype(units.dtype, np.integer) else False
    return clean_depth(np.where(missing, 0, units.astype(np.float32) * np.float32(unit_m)))


def check_units(depth_m: Float32[np.ndarray, "T H W"], where: Path | str, scale_m: float) -> None:
    """Raise RecordingError if the median depth is not one that a camera sees."""
    step = max(1, len(depth_m) // 16)
    sample = depth_m[::step, ::2, ::2] if depth_m[0].size > 64 else depth_m
    valid = sample[sample > 0]
    if valid.size == 0:
        valid = depth_m[depth_m > 0]
    if valid.size == 0:
        raise RecordingError(f"depth of {where}: every pixel is missing; omit the depth to use colours only")
    median_m = float(np.median(valid))
    low, high = PLAUSIBLE_DEPTH_M
    if low <= median_m <= high:
        return
    likely = min(_USUAL_SCALES_M, key=lambda scale: abs(np.log(median_m / scale_m * scale / _USUAL_DEPTH_M)))
    raise RecordingError(
        f"depth of {where}: the median is {median_m:.3g} m with depth_scale_m = {scale_m:g}, expected {low:g} to "
        f"{high:g} m; the units are wrong, depth_scale_m = {likely:g} would give {median_m / scale_m * likely:.2f} m"
    )
