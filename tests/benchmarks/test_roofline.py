"""Which part of a frame the time of a kernel is counted to."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.roofline import Clock
from quest.track.preprocess import Preprocessor
from quest.types import Camera


def test_kernels_count_within_their_part() -> None:
    clock, before = Clock(), cv2.cvtColor
    with clock.running():
        Preprocessor(Camera(50, 50, 32, 24, 64, 48), follow_px=480).picture(np.zeros((48, 64, 3), np.uint8))
        cv2.cvtColor(np.zeros((480, 640, 3), np.uint8), cv2.COLOR_RGB2GRAY)
    assert cv2.cvtColor is before
    spent_s = clock.spent_s
    assert 0 < spent_s["checks of the frame", "compiled"] <= spent_s["checks of the frame", "all"]
    assert spent_s["", "compiled"] > 0  # outside of all parts
    assert spent_s["", "all"] == pytest.approx(0)
