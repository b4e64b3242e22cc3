"""One camera's view of the world: pixels of points, and points of pixels where there is depth."""

from __future__ import annotations

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

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """The camera's place in the world, metres."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    def project(
        self, point_world: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
        """Pixels and depths of world points; NaN pixels behind the camera."""
        cam = point_world @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        depth = np.where(cam[:, 2] > 0, cam[:, 2], np.nan)
        return (cam @ self.matrix.T)[:, :2] / depth[:, None], cam[:, 2]

    def depth_at(self, uv_px: Float[np.ndarray, "N 2"]) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
        """Median depth of 3 x 3 pixels, NaN where there is none, and whether it is free of edges."""
        around = self._around(uv_px, 1)
        middle, farthest = _at_rank(around, 0.5), _at_rank(around, 1.0)
        return middle, farthest - around[:, 0] < _FLAT * middle

    def near_depth_at(self, uv_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
        """Depth of the nearest surface in 3 x 3 pixels, a handle rather than its door; NaN where there is none."""
        around = self._around(uv_px, 1)
        near = np.where(around < (1 + _FLAT) * _at_rank(around, 0.1)[:, None], around, np.nan)
        return _at_rank(near, 0.5)

    def _around(self, uv_px: Float[np.ndarray, "N 2"], reach: int) -> Float[np.ndarray, "N S"]:
        """Depths around pixels in rising order, with NaN last where there is none."""
        side = 2 * reach + 1
        if self.depth_m is None:
            return np.full((len(uv_px), side**2), np.nan)
        height, width = self.depth_m.shape
        inside = in_image(uv_px, (width, height))
        place = np.floor(np.where(inside[:, None], uv_px, 0)).astype(np.int64)
        column, row = place.clip(reach, (width - 1 - reach, height - 1 - reach)).T
        step = np.arange(-reach, reach + 1)
        around = self.depth_m[row[:, None, None] + step[:, None], column[:, None, None] + step].reshape(-1, side**2)
        return np.sort(np.where((around > 0) & inside[:, None], around.astype(np.float64), np.nan), axis=1)

    def lift(self, uv_px: Float[np.ndarray, "N 2"], depth_m: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """World points of pixels at depths along the camera's axis."""
        focal, middle = self.matrix[[0, 1], [0, 1]], self.matrix[:2, 2]
        cam = np.column_stack([(uv_px - middle) / focal, np.ones(len(uv_px))]) * depth_m[:, None]
        return (cam - self.cam_from_world[:3, 3]) @ self.cam_from_world[:3, :3]


def in_image(uv_px: Float[np.ndarray, "*N 2"], size: tuple[int, int]) -> Bool[np.ndarray, "*N"]:
    """Whether pixels are in an image of a width and height."""
    return np.asarray(((uv_px >= 0) & (uv_px <= size)).all(axis=-1))


def move(pose: Float[np.ndarray, "*#B 4 4"], point: Float[np.ndarray, "*#B 3"]) -> Float[np.ndarray, "*B 3"]:
    """Points of a body in the world; leading axes broadcast."""
    return np.einsum("...ij,...j->...i", pose[..., :3, :3], point) + pose[..., :3, 3]


def move_back(pose: Float[np.ndarray, "*#B 4 4"], point: Float[np.ndarray, "*#B 3"]) -> Float[np.ndarray, "*B 3"]:
    """Points of the world on a body."""
    return np.einsum("...ji,...j->...i", pose[..., :3, :3], point - pose[..., :3, 3])


def _at_rank(ordered: Float[np.ndarray, "N S"], share: float) -> Float[np.ndarray, " N"]:
    """The value below which a share of a row's numbers lie; NaN in a row without any."""
    count = np.isfinite(ordered).sum(axis=1)
    return ordered[np.arange(len(ordered)), np.round(share * np.maximum(count - 1, 0)).astype(np.int64)]
