"""Depth of one camera as another camera sees it: pictures of an RGB-D sensor whose depth is not aligned to colour."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, UInt8

from quest.data.distortion import Distortion, Rectifier
from quest.errors import InputError
from quest.types import Camera

_FOOTPRINT = 1.25
"""Side of the square that a depth pixel covers, over what it would cover on a surface that faces both cameras: slanted
surfaces are stretched, and tear open without it. Below two, pixels that fall on pixels cover nothing else."""
_MOST_STRETCH = 4.0
_MOST_WIDER = 16.0
"""Pixels of the colours that one of the depth covers, across."""


def register_depth(
    depth_m: Float32[np.ndarray, "h w"],
    depth_camera: Camera,
    camera: Camera,
    colour_from_depth: Float[np.ndarray, "4 4"],
) -> Float32[np.ndarray, "H W"]:
    """Depth image of another camera, from that of a depth camera.

    Every depth pixel is lifted, moved and drawn as a square of the size that it covers; the nearest one wins.

    Args:
        depth_m: depth along +z of the depth camera in metres, 0 where missing.
        depth_camera: its intrinsics.
        camera: the camera to see it from.
        colour_from_depth: rigid transform from the depth camera's axes to the other camera's, metres.

    Returns:
        Depth along +z of ``camera``, 0 where no depth pixel falls.
    """
    rows, columns = np.nonzero(depth_m > 0)
    z = depth_m[rows, columns].astype(np.float64)
    x = (columns + 0.5 - depth_camera.cx) / depth_camera.fx * z
    y = (rows + 0.5 - depth_camera.cy) / depth_camera.fy * z
    moved = np.stack((x, y, z), axis=-1) @ colour_from_depth[:3, :3].T + colour_from_depth[:3, 3]
    ahead = moved[:, 2] > 1e-6
    moved, z = moved[ahead], z[ahead]
    u = camera.fx * moved[:, 0] / moved[:, 2] + camera.cx
    v = camera.fy * moved[:, 1] / moved[:, 2] + camera.cy
    nearer = np.minimum(z / moved[:, 2], _MOST_STRETCH)
    half_u = np.maximum(1.0, _FOOTPRINT * camera.fx / depth_camera.fx * nearer) / 2
    half_v = np.maximum(1.0, _FOOTPRINT * camera.fy / depth_camera.fy * nearer) / 2
    inside = (u > -half_u) & (u < camera.width + half_u) & (v > -half_v) & (v < camera.height + half_v)
    u, v, half_u, half_v = u[inside], v[inside], half_u[inside], half_v[inside]
    near_m = moved[inside, 2].astype(np.float32)

    # Pixels whose centres lie in the square, [u - half, u + half) on each axis.
    left, right = np.ceil(u - half_u - 0.5).astype(np.int64), np.ceil(u + half_u - 0.5).astype(np.int64)
    top, bottom = np.ceil(v - half_v - 0.5).astype(np.int64), np.ceil(v + half_v - 0.5).astype(np.int64)
    nearest = np.full(camera.height * camera.width, np.inf, dtype=np.float32)
    for dy in range(int((bottom - top).max(initial=0))):
        for dx in range(int((right - left).max(initial=0))):
            column, row = left + dx, top + dy
            drawn = (column < right) & (row < bottom) & (column >= 0) & (row >= 0)
            drawn &= (column < camera.width) & (row < camera.height)
            np.minimum.at(nearest, row[drawn] * camera.width + column[drawn], near_m[drawn])
    return np.where(np.isfinite(nearest), nearest, np.float32(0)).reshape(camera.height, camera.width)


@dataclass(frozen=True)
class Rig:
    """A colour camera and where its depth comes from: raw pictures go in, RGB-D frames of a pinhole camera come out."""

    camera: Camera
    """Intrinsics of the colour pictures."""
    distortion: Distortion = field(default_factory=Distortion)
    """Lens of the colour pictures."""
    depth_camera: Camera | None = None
    """Intrinsics of the depth pictures; None where they are aligned to the colours, pixel by pixel."""
    depth_distortion: Distortion = field(default_factory=Distortion)
    """Lens of the depth pictures, where they are not aligned."""
    colour_from_depth: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Rigid transform from the depth camera's axes to the colour camera's, metres."""

    def __post_init__(self) -> None:
        depth = self.depth_grid
        wider = max(self.camera.fx / depth.fx, self.camera.fy / depth.fy)
        if wider > _MOST_WIDER:
            raise InputError(
                f"depth_camera: one of its pixels is as wide as {wider:.0f} pixels of the colours, expected at most "
                f"{_MOST_WIDER:.0f}; check the focal lengths of both"
            )

    @property
    def depth_grid(self) -> Camera:
        """Intrinsics of the depth pictures as they come."""
        return self.depth_camera or self.camera

    @cached_property
    def aligned(self) -> bool:
        """Whether depth pixels are colour pixels already."""
        same = np.allclose(self.colour_from_depth, np.eye(4), atol=1e-6)
        lens = self.depth_distortion == self.distortion or (self.depth_distortion.none and self.distortion.none)
        return self.depth_camera is None or (bool(same) and self.depth_camera == self.camera and lens)

    @cached_property
    def _lenses(self) -> tuple[Rectifier, Rectifier]:
        """Of colours and of depth; what they look up is made once."""
        depth_lens = self.distortion if self.depth_camera is None else self.depth_distortion
        return Rectifier(self.camera, self.distortion), Rectifier(self.depth_grid, depth_lens)

    def rgb(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Colours without distortion.

        Raises:
            InputError: the picture is not of the camera's size.
        """
        _check_size("colours", image, self.camera)
        return self._lenses[0].rgb(image)

    def depth(self, depth_m: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "H W"]:
        """Depth of every pixel of the colours, without distortion; 0 where missing.

        Raises:
            InputError: the picture is not of the depth camera's size.
        """
        _check_size("depth", depth_m, self.depth_grid)
        straight = self._lenses[1].depth(depth_m)
        if self.aligned:
            return straight
        return register_depth(straight, self.depth_grid, self.camera, self.colour_from_depth)


def _check_size(what: str, image: np.ndarray, camera: Camera) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{what}: {width} x {height}, but the camera is for {camera.width} x {camera.height}; all frames must be "
            "of one size, and of the size that the intrinsics belong to"
        )
