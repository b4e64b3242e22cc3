"""A joint by itself: other frames, words, arrays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from quest.errors import InputError
from quest.grounding import Joint, JointEstimator, JointKind
from tests.grounding.tracks import make_track, unit

SIZES = {JointKind.STATIC: 3, JointKind.PRISMATIC: 4, JointKind.REVOLUTE: 6}


def make_joint(kind: JointKind, seed: int) -> Joint:
    rng = np.random.default_rng(seed)
    axis, origin = unit(rng), rng.normal(size=3)
    rest = origin + 0.4 * np.cross(axis, unit(rng)) if kind is JointKind.REVOLUTE else origin
    root = 0.1 * rng.normal(size=(SIZES[kind], SIZES[kind]))
    return Joint(kind, axis, origin, rest, -0.1, 0.8, root @ root.T, 0.01, 20)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(list(JointKind)), st.floats(0.05, 20.0))
def test_a_joint_goes_into_another_frame_as_its_curve_does(seed: int, kind: JointKind, scale: float):
    rng = np.random.default_rng(seed + 1)
    joint, turn, shift = make_joint(kind, seed), Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    moved = joint.transformed(turn, shift, scale)
    q, points = np.linspace(-0.5, 1.5, 9), rng.normal(size=(7, 3))
    unit_of_q = scale if kind is JointKind.PRISMATIC else 1.0
    np.testing.assert_allclose(moved.at(unit_of_q * q), scale * joint.at(q) @ turn.T + shift, atol=1e-9 * (1 + scale))
    there = scale * points @ turn.T + shift
    np.testing.assert_allclose(moved.locate(there), unit_of_q * joint.locate(points), atol=1e-7 * (1 + scale))
    np.testing.assert_allclose(moved.spread(unit_of_q * q), scale * joint.spread(q), rtol=1e-7)
    assert (moved.lower, moved.upper) == pytest.approx((unit_of_q * joint.lower, unit_of_q * joint.upper))
    assert moved.sigma == pytest.approx(scale * joint.sigma)
    back = moved.transformed(turn.T, -turn.T @ shift / scale, 1 / scale)
    np.testing.assert_allclose(back.covariance, joint.covariance, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(back.axis, joint.axis, atol=1e-9)


@pytest.mark.parametrize("kind", list(JointKind))
def test_the_covariance_of_the_line_is_in_the_frame_of_the_track(kind: JointKind):
    joint, turn = make_joint(kind, 5), Rotation.random(rng=np.random.default_rng(6)).as_matrix()
    found, moved = joint.line_covariance, joint.transformed(turn, np.ones(3), 3.0).line_covariance
    change = np.zeros((6, 6))
    change[:3, :3], change[3:, 3:] = turn, 3.0 * turn
    if kind is JointKind.STATIC:
        assert np.isnan(found[:3]).all()
        assert np.isnan(found[:, :3]).all()
        found, moved, change = found[3:, 3:], moved[3:, 3:], change[3:, 3:]
    else:
        assert np.linalg.matrix_rank(found, tol=1e-9) == 4
        np.testing.assert_allclose(found[:3] @ np.concatenate((joint.axis, np.zeros(3))), 0, atol=1e-12)
        np.testing.assert_allclose(found[3:] @ np.concatenate((np.zeros(3), joint.axis)), 0, atol=1e-12)
    np.testing.assert_allclose(moved, change @ found @ change.T, atol=1e-9)


def square_errors(kind: JointKind, *, amount: float, sigma: float) -> np.ndarray:
    """Of the axis and its place in 80 noisy tracks, measured by the covariance: chi^2 of four if that is right."""
    found = []
    for seed in range(80):
        points, axis, origin = make_track(kind, amount=amount, sigma=sigma, seed=seed, n=40)
        estimator = JointEstimator(sigma)
        for point in points:
            estimator.add(point)
        joint = estimator.joint
        assert joint is not None
        assert joint.kind is kind
        axis = axis * np.sign(axis @ joint.axis)
        place = origin + ((joint.origin - origin) @ joint.axis) / (axis @ joint.axis) * axis
        error = np.concatenate((axis - joint.axis, place - joint.origin))
        found.append(error @ np.linalg.pinv(joint.line_covariance, rcond=1e-9, hermitian=True) @ error)
    return np.array(found)


@pytest.mark.parametrize(
    ("kind", "amount"), [(JointKind.REVOLUTE, 0.8), (JointKind.REVOLUTE, 1.5), (JointKind.PRISMATIC, 0.4)]
)
def test_the_true_axis_lies_within_the_covariance_as_often_as_it_says(kind: JointKind, amount: float):
    """Of independent noise, and rather more often: of many points at one place no more than four count.

    Two standard deviations of a rate in 80 tracks are 0.11 at 0.5 and 0.07 at 0.9; an exact covariance has a mean of 4.
    """
    square = square_errors(kind, amount=amount, sigma=0.01)
    assert (square < chi2.ppf(0.5, 4)).mean() > 0.5 - 0.11
    assert (square < chi2.ppf(0.9, 4)).mean() > 0.9 - 0.07
    assert 2.5 < square.mean() < 5


def test_no_axis_is_known_better_than_motions_of_real_joints_are_exact():
    """No point counts as better than a hundredth of the track's extent, so that clean tracks promise no more."""
    square = square_errors(JointKind.REVOLUTE, amount=1.5, sigma=0.002)
    assert (square < chi2.ppf(0.9, 4)).mean() > 0.97


def test_only_rigid_motions_and_scales_are_frames():
    joint = make_joint(JointKind.REVOLUTE, 0)
    for turn, scale in ((np.diag([1.0, 1.0, -1.0]), 1.0), (2 * np.eye(3), 1.0), (np.eye(3), 0.0)):
        with pytest.raises(InputError, match="expected a rotation"):
            joint.transformed(turn, np.zeros(3), scale)
    with pytest.raises(InputError):
        joint.transformed(np.eye(3), np.full(3, np.nan), 1.0)


def test_joints_are_told_in_words():
    covariance = np.diag(np.square([0.03, 0.03, 0.01, 0.01, 0.01, 0.01]))
    axis, arm = np.array([0.0, 0.0, 1.0]), np.array([0.41, 0.0, 0.0])
    door = Joint(JointKind.REVOLUTE, axis, np.zeros(3), arm, -0.05, 0.82, covariance, 0.01, 20)
    assert door.axis_sigma_rad == pytest.approx(0.03)
    assert door.radius == pytest.approx(0.41)
    assert door.describe() == (
        "revolute, axis (0.00, 0.00, 1.00), radius 0.41 m, seen -3 to 47 degrees, axis +-1.7 degrees"
    )
    drawer = Joint(JointKind.PRISMATIC, axis, arm, arm, 0.0, 0.3, covariance[:4, :4], 0.01, 20)
    assert drawer.describe() == "prismatic, axis (0.00, 0.00, 1.00), seen 0.00 to 0.30 m, axis +-1.7 degrees"
    still = Joint(JointKind.STATIC, axis, arm, arm, 0.0, 0.0, covariance[:3, :3], 0.01, 20)
    assert still.describe() == "static, at (0.41, 0.00, 0.00) m"
    assert np.isnan(still.axis_sigma_rad)
