"""The joint of a track that grows."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.grounding import JointEstimator, JointKind, JointPrior, fit_joint
from quest.track.saving import load, save
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


def test_another_belief_counts_at_once():
    """No further point is needed."""
    estimator = JointEstimator(0.01)
    for x in (0.0, 0.05, 0.1):
        estimator.add(np.array([x, 0.0, 0.0]))
    across, upright = np.eye(3)[0], np.eye(3)[2]
    turns = JointPrior(0.99, across, 0.1, upright, 0.02, np.array([0.0, 0.3, 0.0]), 0.02)
    slides = JointPrior(0.01, across, 0.1, upright, 0.02, np.array([0.0, 0.3, 0.0]), 0.02)
    for prior, kind in ((turns, JointKind.REVOLUTE), (slides, JointKind.PRISMATIC)):
        estimator.believe(prior)
        assert estimator.joint is not None
        assert estimator.joint.kind is kind
    JointEstimator(0.01).believe(turns)  # nothing to fit yet


@pytest.mark.slow
def test_outliers_do_not_crowd_out_the_motion():
    """Every fifth point is wrong by decimetres, for far more frames than are kept."""
    points, axis, _ = make_track(JointKind.REVOLUTE, amount=1.2, sigma=0.002, seed=2, n=400)
    rng = np.random.default_rng(2)
    points[::5] += 0.15 * rng.normal(size=points[::5].shape)
    estimator = JointEstimator(0.002, capacity=32)
    for point in points:
        estimator.add(point)
        joint = estimator.joint
    assert joint is not None
    assert joint.kind is JointKind.REVOLUTE
    assert angle_deg(joint.axis, axis) < 1.5
    assert joint.upper - joint.lower == pytest.approx(1.2, abs=0.05)


def test_what_the_joint_foretold_waits_for_more(monkeypatch: pytest.MonkeyPatch):
    points, _, _ = make_track(JointKind.PRISMATIC, amount=0.5, sigma=0.002, seed=1)
    estimator = JointEstimator(0.002)
    for point in points:
        estimator.add(point)
    joint, fits = estimator.joint, []
    assert joint is not None
    monkeypatch.setattr("quest.grounding.online.fit_joint", lambda *a, **k: fits.append(1) or joint)
    for q in np.linspace(0.05, 0.45, 9):
        estimator.add(joint.at(np.array([q]))[0] + [0.003, 0.0, 0.0])
        assert estimator.joint is joint
    assert len(fits) <= 3
    estimator.add(joint.at(np.array([0.2]))[0] + 0.1)
    assert estimator.joint is joint
    assert len(fits) <= 4


@pytest.mark.parametrize("kind", [JointKind.PRISMATIC, JointKind.REVOLUTE])
def test_restored_estimators_go_on_to_the_same_bytes(kind: JointKind):
    points, axis, origin = make_track(kind, amount=1.0, sigma=0.003, seed=6, n=120)
    points[7::11] += 0.1
    whole, first = JointEstimator(0.003, capacity=24), JointEstimator(0.003, capacity=24)
    for t, point in enumerate(points):
        prior = JointPrior(0.6, axis, 0.3 + 0.001 * t, axis, 0.3, origin, 0.2) if t > 20 else None
        for estimator in (whole, first):
            estimator.prior = prior
            estimator.add(point)
        if t % 3:
            assert whole.joint is not None
            assert first.joint is not None
        if t in (0, 5, 40, 90):
            first = load(save(first), JointEstimator)
    assert save(first) == save(whole)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="sigma"):
        JointEstimator(0.0)
    with pytest.raises(InputError, match="finite point"):
        JointEstimator(0.01).add(np.array([0.0, np.nan, 0.0]))
