"""One camera's view of the world: pixels of points, and points of pixels where there is depth."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

_FLAT = 0.03
"""Depth within 3 x 3 pixels that differs by more than this share has an edge in it."""


@dataclass(frozen=True)
class View:
    """A frame's depth, intrinsics and pose."""

    matrix: Float[np.ndarray, "3 3"]
    """Intrinsics."""
    cam_from_world: Float[np.ndarray, "4 4"]
    depth_m: Float[np.ndarray, "H W"] | None

    def project(
        self, point_world: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
        """Pixels and depths of world points; NaN pixels behind the camera."""
        cam = point_world @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        depth = np.where(cam[:, 2] > 0, cam[:, 2], np.nan)
        return (cam @ self.matrix.T)[:, :2] / depth[:, None], cam[:, 2]

    def depth_at(self, uv_px: Float[np.ndarray, "N 2"]) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
        """Median depth of 3 x 3 pixels, NaN where there is none, and whether it is free of edges."""
        if self.depth_m is None:
            return np.full(len(uv_px), np.nan), np.zeros(len(uv_px), dtype=bool)
        height, width = self.depth_m.shape
        inside = in_image(uv_px, (width, height))
        column, row = np.floor(np.where(inside[:, None], uv_px, 0)).astype(np.int64).clip(1, (width - 2, height - 2)).T
        reach = np.arange(-1, 2)
        around = self.depth_m[row[:, None, None] + reach[:, None], column[:, None, None] + reach].reshape(-1, 9)
        around = np.where((around > 0) & inside[:, None], around.astype(np.float64), np.nan)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category=RuntimeWarning)  # a window without depth has a NaN median: wanted
            middle = np.nanmedian(around, axis=1)
            flat = np.nanmax(around, axis=1) - np.nanmin(around, axis=1) < _FLAT * middle
        return middle, flat

    def lift(self, uv_px: Float[np.ndarray, "N 2"], depth_m: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """World points of pixels at depths along the camera's axis."""
        focal, middle = self.matrix[[0, 1], [0, 1]], self.matrix[:2, 2]
        cam = np.column_stack([(uv_px - middle) / focal, np.ones(len(uv_px))]) * depth_m[:, None]
        return (cam - self.cam_from_world[:3, 3]) @ self.cam_from_world[:3, :3]


def in_image(uv_px: Float[np.ndarray, "N 2"], size: tuple[int, int]) -> Bool[np.ndarray, " N"]:
    """Whether pixels are in an image of a width and height."""
    return np.asarray(((uv_px >= 0) & (uv_px <= size)).all(axis=-1))
