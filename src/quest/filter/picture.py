"""One frame's picture: grey values, their local structure, and dense descriptors."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

WINDOW_PX = 21
"""Side of the patches that are followed."""


@dataclass(frozen=True, eq=False)
class GreyPicture:
    """What is followed in a frame."""

    grey: UInt8[np.ndarray, "H W"]
    scale: tuple[float, float] = field(default=(1.0, 1.0), kw_only=True)
    """Pixels for one pixel of the camera, along x and y."""

    def to_camera(self, uv_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Pixels of the camera."""
        return uv_px / self.scale

    def from_camera(self, uv_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Pixels of this picture for those of the camera."""
        return uv_px * self.scale

    def described(self, descriptors: Float32[np.ndarray, "D h w"]) -> Picture:
        """The same, to be recognised as well."""
        return Picture(self.grey, descriptors, scale=self.scale)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.grey.shape
        return width, height

    def variance(self, uv_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
        """Of the grey values in the window around each point."""
        return self._at(self._variance, uv_px).astype(np.float64)

    def structure(self, uv_px: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """Products of the gradients, xx, xy and yy, summed over the window around each point."""
        return np.stack([self._at(each, uv_px) for each in self._structure], axis=-1).astype(np.float64)

    def patches(self, uv_px: Float[np.ndarray, "N 2"], side: int) -> Float32[np.ndarray, "N S S"]:
        """Grey values of squares around points, bilinear between pixels."""
        around = [cv2.getRectSubPix(self._float, (side, side), (float(x) - 0.5, float(y) - 0.5)) for x, y in uv_px]
        return np.array(around, dtype=np.float32).reshape(len(uv_px), side, side)

    def _at(self, image: np.ndarray, uv_px: Float[np.ndarray, "N 2"]) -> np.ndarray:
        width, height = self.size
        column, row = np.floor(uv_px).astype(np.int64).clip(0, (width - 1, height - 1)).T
        return image[row, column]

    @cached_property
    def _float(self) -> Float32[np.ndarray, "H W"]:
        return self.grey.astype(np.float32)

    @cached_property
    def _variance(self) -> Float32[np.ndarray, "H W"]:
        window = (WINDOW_PX, WINDOW_PX)
        mean, square = (each(self.grey, cv2.CV_32F, window) for each in (cv2.boxFilter, cv2.sqrBoxFilter))
        return square - mean**2

    @cached_property
    def _structure(self) -> tuple[Float32[np.ndarray, "H W"], ...]:
        dx, dy = (cv2.Scharr(self.grey, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
        products = (dx * dx, dx * dy, dy * dy)
        return tuple(cv2.boxFilter(each, -1, (WINDOW_PX, WINDOW_PX), normalize=False) for each in products)


@dataclass(frozen=True, eq=False)
class Picture(GreyPicture):
    """What is followed and recognised in a frame."""

    descriptors: Float32[np.ndarray, "D h w"]
    """Of length 1; pixel (x, y) lies at (x * w / W, y * h / H)."""

    @property
    def cell_px(self) -> Float[np.ndarray, "2"]:
        """Width and height of a cell of the descriptors."""
        return np.divide(self.size, self.descriptors.shape[:0:-1])

    def describe(self, uv_px: Float[np.ndarray, "N 2"]) -> Float32[np.ndarray, "N D"]:
        """Descriptors at points, bilinear between cells."""
        if not len(uv_px):
            return np.zeros((0, len(self.descriptors)), dtype=np.float32)
        cell = (uv_px / self.cell_px - 0.5).astype(np.float32)
        found = cv2.remap(self._channels_last, cell[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]  # type: ignore[call-overload]
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    @cached_property
    def _channels_last(self) -> Float32[np.ndarray, "h w D"]:
        return np.ascontiguousarray(self.descriptors.transpose(1, 2, 0))
