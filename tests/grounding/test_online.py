"""The joint of a track that grows."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.grounding import JointEstimator, JointKind, fit_joint
from tests.grounding.tracks import angle_deg, make_track


@pytest.mark.parametrize("kind", [JointKind.PRISMATIC, JointKind.REVOLUTE])
def test_the_joint_is_found_as_the_track_grows(kind: JointKind):
    points, axis, _ = make_track(kind, amount=1.0, sigma=0.005, seed=0)
    estimator = JointEstimator(0.005)
    assert estimator.joint is None
    for point in points:
        estimator.add(point)
    joint = estimator.joint
    assert joint is not None
    assert joint.kind is kind
    assert angle_deg(joint.axis, axis) < 4
    whole = fit_joint(points, 0.005)
    assert np.linalg.norm(joint.at(joint.locate(points)) - whole.at(whole.locate(points)), axis=1).max() < 0.01


def test_standing_still_does_not_crowd_out_the_motion():
    points, _, _ = make_track(JointKind.PRISMATIC, amount=0.5, sigma=0.002, seed=1)
    estimator = JointEstimator(0.002, capacity=32)
    for point in [*([points[0]] * 500), *points, *([points[-1]] * 500)]:
        estimator.add(point)
    assert len(estimator._points) <= 32
    joint = estimator.joint
    assert joint is not None
    assert joint.kind is JointKind.PRISMATIC
    assert joint.upper - joint.lower == pytest.approx(0.5, abs=0.02)


def test_a_point_that_tells_nothing_new_costs_no_fit(monkeypatch: pytest.MonkeyPatch):
    estimator = JointEstimator(0.01)
    for _ in range(10):
        estimator.add(np.zeros(3))
    before = estimator.joint
    monkeypatch.setattr("quest.grounding.online.fit_joint", lambda *a, **k: pytest.fail("fitted again"))
    estimator.add(np.full(3, 0.001))
    assert estimator.joint is before


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="sigma"):
        JointEstimator(0.0)
    with pytest.raises(InputError, match="finite point"):
        JointEstimator(0.01).add(np.array([0.0, np.nan, 0.0]))
