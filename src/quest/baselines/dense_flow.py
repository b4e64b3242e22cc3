"""Dense optical flow, read off bilinearly and chained from frame to frame.

Reference: Kroeger et al., Fast optical flow using dense inverse search, ECCV 2016 (OpenCV's ``DISOpticalFlow``).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from quest.baselines.chained import Chained


class DenseFlow(Chained):
    """Follows by DIS flow, medium preset; it never says that it lost anything that is in the image."""

    name = "dis"

    def step(
        self, previous: UInt8[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], uv_px: Float32[np.ndarray, "M 2"]
    ) -> tuple[Float32[np.ndarray, "M 2"], Bool[np.ndarray, " M"]]:
        """The flow at the point."""
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        flow = dis.calc(previous, grey, np.zeros((*grey.shape, 2), np.float32))
        x, y = (uv_px - np.float32(0.5)).T[..., None]
        moved = cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        return (uv_px + moved).astype(np.float32), np.ones(len(uv_px), dtype=bool)
