"""Reasons in words."""

from __future__ import annotations

import numpy as np

from quest.monitor import SIGNALS
from quest.monitor.reason import reason


def said(lost_p: float = 0.9, /, **signals: tuple[float, float, float, int]) -> str:
    """Reason for signals given as share, value, level, frames off."""
    table = np.zeros((4, len(SIGNALS)))
    for name, row in signals.items():
        table[:, SIGNALS.index(name)] = row
    return reason(table[0], table[1], table[2], table[3], lost_p=lost_p)


def test_signals_that_speak_most():
    assert said(joint_residual=(3.0, 4.13, 1.0, 6)) == "distance to joint 4.1 sigma for 6 frames"
    found = said(anchor_cosine=(2.0, 0.31, 0.9, 4), joint_residual=(1.0, 4.0, 1.0, 1), step=(0.9, 0.5, 0.1, 2))
    assert found == "looks unlike its anchor (cosine 0.31) for 4 frames; distance to joint 4.0 sigma for 1 frame"


def test_a_signal_that_adds_little_is_not_named():
    assert said(step=(2.0, 0.3, 0.0, 0), spread=(0.5, 0.2, 0.1, 9)) == "leapt by 0.30"


def test_depth_has_two_sides():
    assert said(depth_gap=(2.0, -0.2, 0.0, 1)).startswith("what is seen lies 0.20 before its place")
    assert said(depth_gap=(2.0, 0.2, 0.0, 1)).startswith("what is seen lies 0.20 behind its place")
    assert said(depth_gap=(2.0, 0.03, 0.2, 1)).startswith("what is seen lies 0.03 behind its place")


def test_the_other_direction_gets_no_wrong_words():
    assert said(anchor_cosine=(2.0, 0.95, 0.7, 2)) == "anchor cosine 0.95, at first 0.70 for 2 frames"


def test_nothing_stands_out():
    assert said(0.71) == "no signal stands out; lost with probability 0.71"


def test_every_signal_has_words():
    for name in SIGNALS:
        for value in (-1.0, 1.0):
            assert said(**{name: (1.0, value, 0.0, 3)}).endswith("for 3 frames")
