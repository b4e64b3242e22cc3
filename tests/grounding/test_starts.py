"""Lines and circles that a fit begins with."""

from __future__ import annotations

import numpy as np

from quest.grounding import JointKind
from quest.grounding.starts import circle_through, start_circles, start_lines
from tests.grounding.tracks import angle_deg, make_track


def test_points_on_a_line_start_there_among_outliers():
    points, axis, _ = make_track(JointKind.PRISMATIC, amount=0.5, sigma=0.001, seed=0)
    points[::4] += np.random.default_rng(0).normal(size=points[::4].shape)
    line = start_lines(points, np.full(len(points), 0.001))
    assert len(line) == 1
    assert angle_deg(line.axis[0], axis) < 2


def test_points_on_a_circle_start_there_among_outliers():
    points, axis, _ = make_track(JointKind.REVOLUTE, amount=1.5, sigma=0.001, seed=0)
    points[::4] += np.random.default_rng(0).normal(size=points[::4].shape)
    sigma = np.full(len(points), 0.001)
    circle = start_circles(points, sigma, start_lines(points, sigma))
    assert angle_deg(circle.axis[0], axis) < 2
    assert abs(circle.radius[0] - 0.5) < 0.05


def test_a_line_has_no_circle():
    assert len(circle_through(np.linspace(0, 1, 9)[:, None] * [1.0, 2.0, 3.0])) == 0
    assert len(circle_through(np.zeros((2, 3)))) == 0
