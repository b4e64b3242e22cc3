"""Joints that are read off bodies: their kind, axis, range, and how well they are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quest.filter.bodies import Bodies, screw, update
from quest.filter.joints import Joint, JointKind, joints_of
from quest.filter.landmarks import Landmarks
from quest.filter.noise import Noise
from quest.filter.picture import Picture
from quest.filter.queries import Queries

NOISE = Noise()
MIDDLE = np.array([0.1, 0.0, 1.0])
REST = np.array([[0.3, 0.1, 0.9]])
PICTURE = Picture(np.zeros((64, 64), np.uint8), np.ones((2, 8, 8), np.float32))


def opened(twist: np.ndarray, way: np.ndarray, *, jitter: float = 0.0) -> Landmarks:
    """A body that went along a screw, seen from frame to frame."""
    rng, bodies = np.random.default_rng(0), Bodies.world().with_one(np.eye(4), MIDDLE, NOISE)
    for q in way:
        pose = screw(q * twist + jitter * rng.normal(size=6))
        bodies = update(bodies, 1, pose, 1e6 * np.eye(6), 1 / 30, NOISE)
    return replace(Landmarks.none(), bodies=bodies)


def joint(landmarks: Landmarks) -> Joint:
    """Of a query that rides on that body."""
    place = np.repeat(REST[:, None], len(landmarks.pose), axis=1)
    named = Queries.named(
        PICTURE, np.full((1, 2), 30.0), np.ones(1), place, 0 * REST, None, np.tile(np.eye(4), (place.shape[1], 1, 1))
    )
    riding = replace(named, log_odds=np.array([[-5.0, 5.0]]))
    (found,) = joints_of(riding, landmarks, NOISE)
    assert found is not None
    return found


def test_a_door_turns_about_its_hinge() -> None:
    hinge = np.array([-0.2, 0.0, 1.0])
    axis = np.array([0.0, 1.0, 0.0])
    found = joint(opened(np.concatenate([axis, np.cross(hinge, axis)]), np.linspace(0, 1.2, 40), jitter=0.002))
    assert found.kind is JointKind.REVOLUTE
    assert np.degrees(np.arccos(found.axis @ axis)) < 1
    np.testing.assert_allclose(found.origin, [-0.2, 0.1, 1.0], atol=0.01)
    assert (found.lower, found.upper) == pytest.approx((0, 1.2), abs=0.02)
    turned = hinge + Rotation.from_rotvec(0.7 * axis).apply(REST - hinge)
    assert found.locate(turned)[0] == pytest.approx(0.7, abs=0.02)
    assert 0 < found.axis_sigma_rad < 0.05


def test_a_drawer_slides() -> None:
    way = np.array([0.0, 0.6, -0.8])
    found = joint(opened(np.concatenate([np.zeros(3), way]), np.linspace(0, 0.3, 40), jitter=0.002))
    assert found.kind is JointKind.PRISMATIC
    assert np.degrees(np.arccos(found.axis @ way)) < 1
    assert (found.lower, found.upper) == pytest.approx((0, 0.3), abs=0.01)
    np.testing.assert_allclose(found.at(np.array([0.2])), REST + 0.2 * way, atol=0.005)


def test_what_was_seen_along_a_short_way_is_known_less() -> None:
    twist = np.array([0.0, 0, 0, 0, 0.6, -0.8])
    short, long = (joint(opened(twist, np.linspace(0, way, 40), jitter=0.002)) for way in (0.03, 0.3))
    assert short.axis_sigma_rad > 3 * long.axis_sigma_rad


def test_a_joint_goes_along_with_its_world() -> None:
    found = joint(opened(np.array([0.0, 1, 0, -1, 0, -0.2]), np.linspace(0, 1, 40), jitter=0.002))
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix(), [1.0, 2.0, 3.0]
    moved, q = found.moved(world), np.linspace(0, 1, 5)
    np.testing.assert_allclose(moved.at(q), found.at(q) @ world[:3, :3].T + world[:3, 3], atol=1e-9)
    turn = np.kron(np.eye(2), world[:3, :3])
    np.testing.assert_allclose(moved.line_covariance, turn @ found.line_covariance @ turn.T, atol=1e-9)


def test_the_world_is_static() -> None:
    landmarks = opened(np.zeros(6), np.zeros(0))
    found = joint(landmarks)
    assert found.kind is JointKind.STATIC
    np.testing.assert_array_equal(found.at(np.zeros(2)), np.repeat(REST, 2, axis=0))
    assert np.isnan(found.axis_sigma_rad)


def test_what_was_found_again_elsewhere_has_no_joint() -> None:
    place = np.repeat(REST[:, None], 2, axis=1)
    named = Queries.named(
        PICTURE, np.full((1, 2), 30.0), np.ones(1), place, 0 * REST, None, np.tile(np.eye(4), (place.shape[1], 1, 1))
    )
    there = replace(named, log_odds=np.array([[5.0, -5.0]]), anew=np.ones(1, dtype=bool))
    assert joints_of(there, opened(np.zeros(6), np.zeros(0)), NOISE) == (None,)
