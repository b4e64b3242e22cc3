"""What a joint says of a query that is seen, jumps, or is hidden."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import pytest

from quest.grounding import JointKind
from quest.track.expectation import BeliefRow
from quest.track.grounded import Ground
from quest.track.saving import load, save
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


_OPENING = 40


def opened(to: float = 1.2, *, seed: int = 0) -> Ground:
    """A door that has been seen opening."""
    ground, rng = Ground(CONFIG), np.random.default_rng(seed)
    for t, angle in enumerate(np.linspace(0, to, _OPENING)):
        ground.see(on_door(angle) + 0.005 * rng.normal(size=3), door_row(on_door(angle)), now=t)
    return ground


def see(ground: Ground, angle: float, *, now: float) -> None:
    ground.see(on_door(angle), door_row(on_door(angle)), now=now)


@dataclass
class Sight:
    """A frame that shows the query at some places and sees others behind or before something."""

    shown: Callable[[np.ndarray], np.ndarray] = lambda p: np.full(len(p), np.nan)
    behind: Callable[[np.ndarray], np.ndarray] = lambda p: np.full(len(p), np.nan)

    def ratio(self, point: np.ndarray) -> np.ndarray:
        return self.shown(point)

    def room(self, point: np.ndarray) -> np.ndarray:
        return self.behind(point)


BLIND = Sight()
COVERED = Sight(behind=lambda p: np.full(len(p), -1.0))


def hide(
    ground: Ground,
    before: np.ndarray,
    *,
    point=(np.nan,) * 3,
    seen=0.0,
    frame: Sight = BLIND,
    buried: bool = False,
    elapsed: float = 1.0,
):
    return ground.hide(before, np.array(point), seen, frame, buried=buried, elapsed=elapsed)


def test_what_is_fixed_stands_where_it_was_first_seen_whatever_is_taken_for_it_later():
    ground, plain = Ground(CONFIG, fixed=True), Ground(CONFIG)
    for t, angle in enumerate([0.0] * 10 + list(np.linspace(0, 1.2, 30))):
        for each in (ground, plain):
            see(each, angle, now=t)
    assert ground.joint is not None
    assert ground.joint.kind is JointKind.STATIC
    assert plain.joint is not None
    assert plain.joint.kind is JointKind.REVOLUTE
    there, away = ground.favour(np.stack((on_door(0.0), on_door(1.2))))
    assert there == pytest.approx(0.0, abs=0.1)
    assert away < CONFIG.off_joint  # a joint that was never seen could not say so
    again = load(save(ground), Ground)
    see(again, 1.2, now=40)
    assert again.fixed
    np.testing.assert_array_equal(again.favour(on_door(1.2)[None]), [away])
    # What the image shows plainly is followed nevertheless: the whole thing may be carried away.
    np.testing.assert_allclose(ground.settle(on_door(1.2)), on_door(1.2), atol=1e-3)


def test_before_anything_moves_the_belief_favours_its_curve():
    ground = Ground(CONFIG)
    for t in range(5):
        see(ground, 0.0, now=t)
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
        place = hide(ground, place, frame=Sight(lambda p, g=goal: -50 * np.linalg.norm(p - g, axis=1)))
    assert np.linalg.norm(place - on_door(2.0)) < 0.08


def test_a_hidden_query_is_not_where_one_looks_through():
    """Everything up to 1.5 rad is seen to be empty, so the door must have gone on."""
    ground, place = opened(), on_door(1.2)
    for _ in range(30):
        place = hide(ground, place, frame=Sight(behind=lambda p: np.where(np.arctan2(p[:, 1], p[:, 0]) < 1.5, 1.0, -1)))
    assert np.arctan2(place[1], place[0]) > 1.45


def test_behind_something_nothing_is_learnt_from_what_is_before_it():
    """What looks like the query on a board that covers it everywhere does not draw it back; it moves on as it moved."""
    ground, place = opened(), on_door(1.2)
    goal = on_door(0.2)
    board = Sight(lambda p: -50 * np.linalg.norm(p - goal, axis=1) + 9, COVERED.behind)
    for _ in range(30):
        place = hide(ground, place, frame=board, buried=True)
    assert 1.2 < np.arctan2(place[1], place[0]) < 1.9


def test_frames_that_tell_nothing_make_nothing_faster():
    """A door that goes on opening while depth is missing, or its identity is not believed, for ten frames."""
    steady, gap = Ground(CONFIG), Ground(CONFIG)
    for t, angle in enumerate(np.linspace(0, 1.2, 40)):
        see(steady, angle, now=t)
        if not 26 <= t < 36:
            see(gap, angle, now=t)
    reached = []
    for ground in (steady, gap):
        place = on_door(1.2)
        for _ in range(10):
            place = hide(ground, place, frame=COVERED, buried=True)
        reached.append(np.arctan2(place[1], place[0]))
    assert reached[0] == pytest.approx(reached[1], abs=0.02)


def test_being_seen_again_ends_hiding():
    ground = opened()
    hide(ground, on_door(1.2))
    see(ground, 0.3, now=_OPENING + 1)
    place = hide(ground, on_door(0.3))
    assert np.linalg.norm(place - on_door(0.3)) < 0.1


@pytest.mark.parametrize("per_frame", [1.0, 3.0])
def test_what_is_buried_moves_on_as_fast_at_any_frame_rate(per_frame: float):
    """Half a radian a second, hidden for half a second."""
    ground, place = Ground(CONFIG), on_door(0.0)
    for t, angle in enumerate(np.arange(0.0, 1.0, 0.5 * per_frame / 30)):
        place = on_door(angle)
        see(ground, angle, now=t * per_frame)
    begun = np.arctan2(place[1], place[0])
    for _ in range(round(15 / per_frame)):
        place = hide(ground, place, frame=COVERED, buried=True, elapsed=per_frame)
    assert np.arctan2(place[1], place[0]) - begun == pytest.approx(0.14, abs=0.06)


def test_one_sight_after_a_long_time_hidden_is_no_leap():
    ground, place = opened(), on_door(1.2)
    for _ in range(60):
        place = hide(ground, place, frame=COVERED, buried=True)
    see(ground, 2.0, now=_OPENING + 60)
    place = on_door(2.0)
    for _ in range(10):
        place = hide(ground, place, frame=COVERED, buried=True)
    assert np.arctan2(place[1], place[0]) < 2.25


@pytest.mark.parametrize("slides", [False, True])
def test_what_never_moved_stays_while_it_is_buried(slides: bool):
    """Its joint is only believed, so that neither side of it is the closed one."""
    ground, place = Ground(CONFIG), on_door(0.0)
    row = replace(door_row(place), revolute_logit=-3.0 if slides else 3.0)
    for t in range(20):
        ground.see(place, row, now=t)
    for _ in range(60):
        place = hide(ground, place, frame=COVERED, buried=True)
    assert np.linalg.norm(place - on_door(0.0)) < 0.03


def test_what_was_put_elsewhere_is_held_there():
    """As by another query of its link, or by a search; it was not seen in between."""
    ground = opened()
    hide(ground, on_door(0.4))
    place = hide(ground, on_door(0.9))
    assert np.linalg.norm(place - on_door(0.9)) < 0.05


def test_what_turns_far_is_still_on_its_joint():
    ground, far = opened(2.9), on_door(2.9)
    assert ground.favour(far[None])[0] > -0.1
    assert np.linalg.norm(hide(ground, far) - far) < 0.05


def test_a_query_that_may_be_seen_after_all_is_near_that_place():
    ground, place = opened(), on_door(1.2)
    for target in np.linspace(1.2, 1.9, 20):
        place = hide(ground, place, point=on_door(target), seen=0.4)
    assert np.linalg.norm(place - on_door(1.9)) < 0.1
    far = hide(ground, place, point=on_door(1.9) + 2 * AXIS, seen=0.4)
    assert np.linalg.norm(far - on_door(1.9)) < 0.15


def test_what_the_joint_allows_may_be_covered():
    ground, place = opened(), on_door(1.2)
    assert ground.covered(place, COVERED, 1.0) == pytest.approx(1.0)
    ahead = Sight(behind=lambda p: np.where(np.arctan2(p[:, 1], p[:, 0]) > 1.2, -1.0, 0.0))
    assert 0.3 < ground.covered(place, ahead, 1.0) < 0.7
    assert ground.covered(place, BLIND, 1.0) == 0.0
    assert Ground(CONFIG).covered(place, COVERED, 1.0) == 1.0


def test_a_hidden_query_is_expected_along_its_joint():
    ground = opened()
    on, off = on_door(1.25), on_door(1.25) + 0.4 * AXIS
    expected = ground.expected(on_door(1.2), np.stack((on, off, np.full(3, np.nan))), 1.0)
    assert expected is not None
    assert expected.sum() == pytest.approx(1.0)
    assert expected[0] > 0.99
    assert ground.expected(on_door(1.2), np.full((4, 3), np.nan), 1.0) is None
    assert Ground(CONFIG).expected(on, on[None], 1.0) is None


def test_residual_is_in_standard_deviations():
    ground = opened()
    assert ground.residual(on_door(0.7)) < 1
    assert ground.residual(on_door(0.7) + 0.2 * AXIS) == pytest.approx(0.2 / CONFIG.point_sigma, rel=0.3)
    assert np.isnan(ground.residual(np.full(3, np.nan)))
    assert np.isnan(Ground(CONFIG).residual(on_door(0.0)))


@pytest.mark.parametrize("hidden", [False, True])
def test_a_copy_answers_alike_and_learns_by_itself(hidden: bool):
    ground = opened()
    if hidden:
        hide(ground, on_door(1.2))
    copy = deepcopy(ground)
    points = on_door(np.linspace(-1, 2, 50)) + 0.08 * AXIS
    np.testing.assert_array_equal(copy.favour(points), ground.favour(points))
    np.testing.assert_array_equal(hide(copy, on_door(1.2)), hide(ground, on_door(1.2)))
    for t, angle in enumerate(np.linspace(1.2, 1.6, 10), start=_OPENING + 1):
        see(copy, angle, now=t)
        see(ground, angle, now=t)
    np.testing.assert_array_equal(copy.favour(points), ground.favour(points))
    see(copy, 2.4, now=_OPENING + 11)
    assert (copy.favour(points) != ground.favour(points)).any()
