"""Pictures of an RGB-D sensor: lenses rectified to pinhole cameras, and depth as the colour camera sees it.

Models of lenses and their coefficients are those of ROS (REP 104 and ``sensor_msgs/CameraInfo``), which are OpenCV's.
The rectified camera keeps the focal lengths, principal point and size of the distorted one: the middle of the picture
stays as sharp as it was, and what falls outside is cut off.

Reference: Brown 1966 (plumb_bob), Claus and Fitzgibbon 2005 (rational), Kannala and Brandt 2006 (equidistant).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from quest.errors import InputError
from quest.types import Camera

_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
_ALIASES = {"fisheye": "equidistant", "kannala_brandt4": "equidistant"}
_NEAR_ZERO = 1e-12
_LEAST_SEEN = 0.05
"""Share of a rectified picture that the lens saw, below which the lens is told wrongly."""
_FOOTPRINT = 1.25
"""Side of the square that a depth pixel covers, over what it would cover on a surface that faces both cameras: slanted
surfaces are stretched, and tear open without it. Below two, pixels that fall on pixels cover nothing else."""
_MOST_STRETCH = 4.0
_MOST_WIDER = 16.0
"""Pixels of the colours that one of the depth covers, across."""


@dataclass(frozen=True)
class Distortion:
    """A lens."""

    model: str = "plumb_bob"
    """``plumb_bob`` (k1 k2 p1 p2, k3), ``rational_polynomial`` (k1 k2 p1 p2 k3 k4 k5 k6, and OpenCV's thin prism and
    tilt) or ``equidistant`` (k1 k2 k3 k4), also called fisheye."""
    coefficients: tuple[float, ...] = ()
    """In that order; none at all is a lens without distortion, as all zero is, but for an equidistant one, which is
    never a pinhole."""

    def __post_init__(self) -> None:
        if not np.isfinite(self.coefficients).all():
            raise InputError(f"distortion {self.model!r}: expected finite coefficients, got {self.coefficients}")
        if self.none:
            return
        numbers = _COEFFICIENTS.get(self._kind)
        if numbers is None:
            raise InputError(
                f"distortion model {self.model!r} is unknown; expected one of {', '.join(_COEFFICIENTS)}, or rectified "
                "images with no coefficients"
            )
        if len(self.coefficients) > numbers[-1] and not any(self.coefficients[numbers[-1] :]):
            object.__setattr__(self, "coefficients", self.coefficients[: numbers[-1]])  # some drivers send more zeros
        if len(self.coefficients) not in numbers:
            expected = " or ".join(str(number) for number in numbers)
            raise InputError(
                f"distortion {self.model!r}: expected {expected} coefficients, got {len(self.coefficients)}"
            )

    @property
    def none(self) -> bool:
        """Whether the lens is a pinhole; an equidistant one never is, even with coefficients of zero."""
        bent = self._kind == "equidistant" and bool(self.coefficients)
        return not bent and all(abs(value) < _NEAR_ZERO for value in self.coefficients)

    @property
    def _kind(self) -> str:
        return _ALIASES.get(self.model, self.model)

    def maps(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """For every pixel of the rectified picture where to look in the distorted one, in OpenCV's integer centres."""
        matrix = camera.matrix
        matrix[:2, 2] -= 0.5
        values = np.array(self.coefficients, dtype=np.float64)
        lens: Any = cv2.fisheye if self._kind == "equidistant" else cv2
        size = (camera.width, camera.height)
        return lens.initUndistortRectifyMap(matrix, values, np.eye(3), matrix, size, cv2.CV_32FC1)


class Rectifier:
    """Resamples the pictures of one lens to its pinhole camera.

    Args:
        camera: intrinsics of the distorted pictures, and of the rectified ones.
        distortion: its lens.
    """

    def __init__(self, camera: Camera, distortion: Distortion) -> None:
        self.camera = camera
        self._maps = None if distortion.none else distortion.maps(camera)
        if self._maps is not None:
            column, row = self._maps
            with np.errstate(invalid="ignore"):
                inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            if inside.mean() < _LEAST_SEEN:
                raise InputError(
                    f"distortion {distortion.model!r} {distortion.coefficients}: rectified pictures would be black; "
                    "check the coefficients, their order and the model"
                )

    def rgb(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Colours, interpolated; black where the lens saw nothing."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR))

    def depth(self, depth_m: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Depth of the nearest pixel, so that no value lies between two surfaces; 0 where the lens saw nothing."""
        if self._maps is None:
            return depth_m
        return np.asarray(cv2.remap(depth_m, *self._maps, interpolation=cv2.INTER_NEAREST))


def register_depth(
    depth_m: Float32[np.ndarray, "h w"],
    depth_camera: Camera,
    camera: Camera,
    colour_from_depth: Float[np.ndarray, "4 4"],
) -> Float32[np.ndarray, "H W"]:
    """Depth image of another camera, from that of a depth camera.

    Every depth pixel is lifted, moved and drawn as a square of the size that it covers; the nearest one wins. Depth is
    along +z of each camera, metres; 0 is missing, or where no depth pixel falls.
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
