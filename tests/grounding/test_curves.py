"""Lines and circles by least squares without outliers."""

from __future__ import annotations

import numpy as np
import pytest

from quest.geometry.vectors import perpendicular
from quest.grounding import JointKind, JointPrior, curves
from quest.grounding.curves import Track, fit_circle, fit_line
from quest.grounding.starts import start_circles, start_lines
from tests.grounding.tracks import angle_deg, make_track


def make_curve_track(kind: JointKind, *, prior: JointPrior | None = None) -> tuple[Track, np.ndarray]:
    points, axis, _ = make_track(kind, amount=0.8, sigma=0.002, seed=3)
    points[::7] += 0.2
    return Track(points, np.full(len(points), 0.002), 0.5, prior, np.ones(len(points), bool)), axis


@pytest.mark.parametrize("kind", [JointKind.PRISMATIC, JointKind.REVOLUTE])
def test_outliers_are_left_out(kind: JointKind):
    track, axis = make_curve_track(kind)
    line = start_lines(track.points, track.sigma)
    fitted = (
        fit_line(track, line)
        if kind is JointKind.PRISMATIC
        else fit_circle(track, start_circles(track.points, track.sigma, line))
    )
    assert angle_deg(fitted.axis, axis) < 1.5
    assert not fitted.used[::7].any()
    assert fitted.used.mean() > 0.8


@pytest.mark.parametrize("with_prior", [False, True])
def test_slopes_are_those_of_the_residuals(with_prior: bool):
    axis = np.array([0.0, 0.6, 0.8])
    prior = JointPrior(0.5, axis, 0.2, axis, 0.2, np.zeros(3), 0.3) if with_prior else None
    track, _ = make_curve_track(JointKind.REVOLUTE, prior=prior)
    other = np.array([0.6, 0.0, 0.8])
    chart = (other, np.array([0.1, 0.2, 0.3]), perpendicular(other))
    rng = np.random.default_rng(0)
    for model, size in ((curves._line(track, *chart), 4), (curves._circle(track, *chart), 6)):
        x, step = 0.2 * rng.normal(size=size), 1e-6
        for change in (lambda values: values, curves._cauchy):
            rows, slopes = curves._rows(change(model(x)), None)
            numeric = [(curves._rows(change(model(x + step * e)), None)[0] - rows) / step for e in np.eye(size)]
            np.testing.assert_allclose(slopes, np.array(numeric).T, rtol=1e-3, atol=2e-2)
