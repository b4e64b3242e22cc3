"""Dense optical flow, read off bilinearly and chained from frame to frame.

Reference: Kroeger et al., Fast optical flow using dense inverse search, ECCV 2016 (OpenCV's ``DISOpticalFlow``).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from quest.baselines.chained import ChainedGrey


class DenseFlow(ChainedGrey):
    """Follows by DIS flow, medium preset; it never says that it lost anything that is in the image."""

    name = "dis"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], picture: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """The flow at the point."""
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        flow_px = dis.calc(previous, picture, np.zeros((*picture.shape, 2), np.float32))
        return moved(np.asarray(flow_px, dtype=np.float32), uv_px), np.ones(len(uv_px), dtype=bool)


def moved(flow_px: Float32[np.ndarray, "H W 2"], uv_px: Float32[np.ndarray, "M 2"]) -> Float32[np.ndarray, "M 2"]:
    """Points (x, y), centres at half-integers, where a field of motions in pixels takes them."""
    x, y = (uv_px - np.float32(0.5)).T[..., None]
    motion = cv2.remap(flow_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    return (uv_px + motion).astype(np.float32)
