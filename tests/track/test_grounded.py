"""What a joint says of a query that is seen, jumps, or is hidden."""

from __future__ import annotations

import numpy as np
import pytest

from quest.grounding import JointKind
from quest.track.grounded import BeliefRow, Ground
from quest.track.settings import TrackerConfig

AXIS = np.array([0.0, 0.0, 1.0])
CONFIG = TrackerConfig(point_sigma=0.02, joint_sigma=0.05)


def door_row(point: np.ndarray) -> BeliefRow:
    """A belief in a door that turns about the z axis."""
    foot = -point * [1.0, 1.0, 0.0]
    return BeliefRow(3.0, np.array([0.0, 1.0, 0.0]), AXIS, foot, np.array([0.1, 0.05, 0.05]))


def on_door(angle: np.ndarray | float) -> np.ndarray:
    angle = np.asarray(angle)
    return np.stack((0.5 * np.cos(angle), 0.5 * np.sin(angle), np.full_like(angle, 0.1)), axis=-1)


def opened(to: float = 1.2, *, seed: int = 0) -> Ground:
    """A door that has been seen opening."""
    ground, rng = Ground(CONFIG), np.random.default_rng(seed)
    for angle in np.linspace(0, to, 40):
        ground.see(on_door(angle) + 0.005 * rng.normal(size=3), door_row(on_door(angle)))
    return ground


def nothing(points: np.ndarray) -> np.ndarray:
    return np.full(len(points), np.nan)


def nowhere(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points), bool)


def hide(ground: Ground, before: np.ndarray, *, point=(np.nan,) * 3, seen=0.0, evidence=nothing, free=nowhere):
    return ground.hide(before, np.array(point), seen, evidence, free)


def test_before_anything_moves_the_belief_favours_its_curve():
    ground = Ground(CONFIG)
    for _ in range(5):
        ground.see(on_door(0.0), door_row(on_door(0.0)))
    on, off = ground.favour(np.stack((on_door(0.5), on_door(0.5) + 0.4 * AXIS)))
    assert on > off
    assert off == pytest.approx(CONFIG.off_joint, abs=0.2)
    assert ground.favour(np.full((2, 3), np.nan)).tolist() == pytest.approx([CONFIG.off_joint] * 2)


def test_nothing_is_known_before_the_first_sight():
    ground, point = Ground(CONFIG), np.array([1.0, 2.0, 3.0])
    assert ground.joint is None
    assert (ground.favour(np.zeros((4, 3))) == 0).all()
    assert (ground.settle(point) == point).all()
    assert (hide(ground, point) == point).all()


def test_noise_is_drawn_to_the_joint_and_a_jump_is_not():
    ground = opened()
    assert ground.joint is not None
    assert ground.joint.kind is JointKind.REVOLUTE
    rng = np.random.default_rng(1)
    noisy = [on_door(1.0) + 0.02 * rng.normal(size=3) for _ in range(50)]
    before = np.mean([np.linalg.norm(p - on_door(1.0)) for p in noisy])
    after = np.mean([np.linalg.norm(ground.settle(p) - on_door(1.0)) for p in noisy])
    assert after < before
    far = on_door(1.0) + 0.5 * AXIS
    np.testing.assert_allclose(ground.settle(far), far, atol=1e-2)


def test_a_hidden_query_follows_the_evidence_along_its_joint():
    ground, place = opened(), on_door(1.2)
    for target in np.linspace(1.2, 2.0, 20):
        goal = on_door(target)
        place = hide(ground, place, evidence=lambda p, g=goal: -20 * np.linalg.norm(p - g, axis=1))
    assert np.linalg.norm(place - on_door(2.0)) < 0.08


def test_a_hidden_query_is_not_where_one_looks_through():
    """Everything up to 1.5 rad is seen to be empty, so the door must have gone on."""
    ground, place = opened(), on_door(1.2)
    for _ in range(30):
        place = hide(ground, place, free=lambda p: np.arctan2(p[:, 1], p[:, 0]) < 1.5)
    assert np.arctan2(place[1], place[0]) > 1.45


def test_being_seen_again_ends_hiding():
    ground = opened()
    hide(ground, on_door(1.2))
    ground.see(on_door(0.3), door_row(on_door(0.3)))
    place = hide(ground, on_door(0.3))
    assert np.linalg.norm(place - on_door(0.3)) < 0.1


def test_a_query_that_may_be_seen_after_all_is_near_that_place():
    ground, place = opened(), on_door(1.2)
    for target in np.linspace(1.2, 1.9, 20):
        place = hide(ground, place, point=on_door(target), seen=0.4)
    assert np.linalg.norm(place - on_door(1.9)) < 0.1
    far = hide(ground, place, point=on_door(1.9) + 2 * AXIS, seen=0.4)
    assert np.linalg.norm(far - on_door(1.9)) < 0.15
