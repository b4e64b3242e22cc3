"""Fit frames of any size and shape into the network's square input, and answers back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from quest.geometry import scale_camera
from quest.types import Camera


@dataclass(frozen=True)
class Letterbox:
    """Scaling and centred padding of a source image onto a square canvas.

    The image is scaled to whole pixels, so that its shorter side may be scaled a little more or less than the longer.
    """

    source: Camera
    """Intrinsics of the source frames."""
    size: int
    """Side of the canvas, pixels."""

    @property
    def scale(self) -> float:
        """Canvas pixels per source pixel along the longer side."""
        return self.size / max(self.source.width, self.source.height)

    @property
    def scale_xy(self) -> tuple[float, float]:
        """Canvas pixels per source pixel along x and along y."""
        width, height = self._resized
        return width / self.source.width, height / self.source.height

    @property
    def _resized(self) -> tuple[int, int]:
        return max(1, round(self.source.width * self.scale)), max(1, round(self.source.height * self.scale))

    @property
    def pad_px(self) -> tuple[int, int]:
        """Columns left of and rows above the image on the canvas."""
        width, height = self._resized
        return (self.size - width) // 2, (self.size - height) // 2

    @property
    def camera(self) -> Camera:
        """Intrinsics of the canvas."""
        left, top = self.pad_px
        return scale_camera(
            self.source, scale=self.scale_xy, pad_left_px=left, pad_top_px=top, width=self.size, height=self.size
        )

    def rgb(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "S S 3"]:
        """Colours on the canvas; the padding is black."""
        return self._place(image, cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR)

    def depth(self, depth_m: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "S S"]:
        """Depth on the canvas, never mixed between pixels; NaN, infinite and negative depth becomes 0 (missing)."""
        clean = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0).astype(np.float32)
        return self._place(clean, cv2.INTER_NEAREST_EXACT)  # the plain one is off by up to half a pixel

    def to_canvas(self, uv_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Canvas pixels of source pixels."""
        return uv_px * np.asarray(self.scale_xy, dtype=uv_px.dtype) + np.asarray(self.pad_px, dtype=uv_px.dtype)

    def to_source(self, uv_px: Float[np.ndarray, "*B 2"]) -> Float[np.ndarray, "*B 2"]:
        """Source pixels of canvas pixels."""
        return (uv_px - np.asarray(self.pad_px, dtype=uv_px.dtype)) / np.asarray(self.scale_xy, dtype=uv_px.dtype)

    def _place(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        width, height = self._resized
        if (width, height) == (self.size, self.size) == (self.source.width, self.source.height):
            return image
        canvas = np.zeros((self.size, self.size, *image.shape[2:]), dtype=image.dtype)
        left, top = self.pad_px
        resized = cv2.resize(image, (width, height), interpolation=interpolation)
        canvas[top : top + height, left : left + width] = resized
        return canvas
