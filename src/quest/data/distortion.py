"""Lens distortion: camera models with coefficients, and pictures resampled to a pinhole camera without any.

Models and coefficients are those of ROS (REP 104 and ``sensor_msgs/CameraInfo``), which are OpenCV's. The rectified
camera keeps the focal lengths, principal point and size of the distorted one: the middle of the picture stays as sharp
as it was, and what falls outside is cut off.

Reference: Brown 1966 (plumb_bob), Claus and Fitzgibbon 2005 (rational), Kannala and Brandt 2006 (equidistant).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from quest.errors import InputError
from quest.types import Camera

_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
_ALIASES = {"fisheye": "equidistant", "kannala_brandt4": "equidistant"}
_NEAR_ZERO = 1e-12
_LEAST_SEEN = 0.05
"""Share of a rectified picture that the lens saw, below which the lens is told wrongly."""


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
        if self._kind == "equidistant" and self.coefficients:
            return False
        return all(abs(value) < _NEAR_ZERO for value in self.coefficients)

    @property
    def _kind(self) -> str:
        return _ALIASES.get(self.model, self.model)

    def maps(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """For every pixel of the rectified picture where to look in the distorted one, in OpenCV's integer centres."""
        matrix = camera.matrix
        matrix[:2, 2] -= 0.5
        values = np.array(self.coefficients, dtype=np.float64)
        size = (camera.width, camera.height)
        if self._kind == "equidistant":
            return cv2.fisheye.initUndistortRectifyMap(matrix, values, np.eye(3), matrix, size, cv2.CV_32FC1)
        return cv2.initUndistortRectifyMap(matrix, values, np.eye(3), matrix, size, cv2.CV_32FC1)


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
