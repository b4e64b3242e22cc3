"""Joints from how the front of a link stands."""

from __future__ import annotations

import numpy as np
import pytest

from quest.grounding import JointKind
from quest.grounding.hinge import HingeEstimator, Plane

AXIS = np.array([0.0, 0.6, 0.8])
ORIGIN = np.array([0.4, -0.1, 0.2])
SIGMA = 0.04


def turned(vector: np.ndarray, angle: float) -> np.ndarray:
    along = (vector @ AXIS) * AXIS
    return along + np.cos(angle) * (vector - along) + np.sin(angle) * np.cross(AXIS, vector)


FRONT = np.array([1.0, 0.0, 0.0])
HANDLE = ORIGIN + turned(np.array([0.02, 0.4, -0.3]), 0.0)


def sight(angle: float, rng: np.random.Generator, *, noise: float = 1.0) -> tuple[np.ndarray, Plane]:
    """A door's handle and the front around it, opened so far."""
    point = ORIGIN + turned(HANDLE - ORIGIN, angle) + noise * 0.01 * rng.normal(size=3)
    normal = turned(FRONT, angle) + noise * 0.01 * rng.normal(size=3)
    middle = ORIGIN + turned(np.array([0.0, 0.35, -0.26]), angle) + noise * 0.003 * rng.normal(size=3)
    return point, Plane(normal / np.linalg.norm(normal), middle, behind=False)


def opened(to: float, *, noise: float = 1.0, frames: int = 40) -> HingeEstimator:
    estimator, rng = HingeEstimator(SIGMA), np.random.default_rng(0)
    for angle in (*np.zeros(8), *np.linspace(0, to, frames)):
        estimator.add(*sight(angle, rng, noise=noise))
    return estimator


@pytest.mark.parametrize("to", [0.5, -0.5, 1.5])
def test_a_door_that_is_seen_opening(to: float):
    joint = opened(to).joint
    assert joint is not None
    assert joint.kind is JointKind.REVOLUTE
    assert joint.axis @ AXIS * np.sign(to) > np.cos(0.04)
    across = (joint.origin - ORIGIN) - ((joint.origin - ORIGIN) @ AXIS) * AXIS
    assert np.linalg.norm(across) < 0.04
    assert joint.upper == pytest.approx(abs(to), abs=0.08)
    np.testing.assert_allclose(joint.at(np.array([abs(to)]))[0], ORIGIN + turned(HANDLE - ORIGIN, to), atol=0.04)


def test_how_far_it_is_open_follows_from_the_normal_alone():
    estimator = opened(0.6)
    for angle in (0.0, 0.3, 1.2):
        assert estimator.turned(turned(FRONT, angle)) == pytest.approx(angle, abs=0.04)
        facing = estimator.facing(angle)
        assert facing is not None
        assert facing @ turned(FRONT, angle) > np.cos(0.04)


def test_nothing_is_known_before_it_has_turned():
    for to in (0.0, 0.1):
        estimator = opened(to)
        assert estimator.joint is None
        assert estimator.belief is None
        assert estimator.facing(0.0) is None
        assert estimator.turned(FRONT) == 0.0
        assert estimator.agrees(Plane(np.array([0.0, 0.0, 1.0]), np.full(3, 9.0), behind=False))


def test_a_still_point_beside_a_door_does_not_turn_with_it():
    estimator, rng = HingeEstimator(SIGMA), np.random.default_rng(0)
    for angle in (*np.zeros(8), *np.linspace(0, 1.2, 40)):
        _, plane = sight(angle, rng)
        estimator.add(HANDLE, plane)
    assert estimator.joint is None


def test_a_drawer_has_no_hinge():
    estimator, rng = HingeEstimator(SIGMA), np.random.default_rng(0)
    for way in np.linspace(0, 0.5, 40):
        point, plane = sight(0.0, rng)
        estimator.add(point + way * FRONT, Plane(plane.normal, plane.middle + way * FRONT, behind=False))
    assert estimator.joint is None


def test_nonsense_makes_no_joint():
    """Planes that turn about the point itself, and planes at random, with points at random."""
    estimator, rng = HingeEstimator(SIGMA), np.random.default_rng(0)
    for angle in np.linspace(0, 1, 20):
        estimator.add(HANDLE, Plane(turned(FRONT, angle), HANDLE, behind=False))
    assert estimator.joint is None
    for _ in range(200):
        normal = rng.normal(size=3)
        estimator.add(rng.normal(size=3), Plane(normal / np.linalg.norm(normal), rng.normal(size=3), behind=False))
    assert estimator.joint is None


def test_what_cannot_be_the_front_is_told():
    estimator, rng = opened(0.8), np.random.default_rng(1)
    _, plane = sight(1.1, rng)
    assert estimator.agrees(plane)
    far = plane.middle + 0.15 * plane.normal
    assert not estimator.agrees(Plane(plane.normal, far, behind=False))
    assert not estimator.agrees(Plane(AXIS, plane.middle, behind=False))
    back = plane.middle - 0.06 * plane.normal
    assert estimator.agrees(Plane(plane.normal, back, behind=True))
