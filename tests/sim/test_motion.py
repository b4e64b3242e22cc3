"""Motion scripts: hold, one joint after the other, inside its limits, smooth, always the same."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quest.errors import ConfigError
from quest.sim.articulation import MAX_TURN_RAD
from quest.sim.motion import HOLD_FRAMES, joint_profile, minimum_jerk, motion_script
from tests.sim.small_objects import articulation

seeds = st.integers(0, 2**31 - 1)
kinds = st.sampled_from(["revolute", "prismatic"])
limits = st.tuples(st.floats(-3, 0), st.floats(0.1, 3))
joints = st.lists(st.tuples(kinds, limits), min_size=1, max_size=4)


@given(joints, seeds, st.integers(20, 60), st.data())
def test_script(drawn: list, seed: int, frames: int, data: st.DataObject) -> None:
    thing = articulation(*((kind, *limit) for kind, limit in drawn))
    order = tuple(data.draw(st.permutations(range(len(thing.joints)))))
    moved = order[: data.draw(st.integers(1, len(order)))]
    script = motion_script(thing, moved, np.random.default_rng(seed), frames_per_joint=frames)
    assert script.shape == (frames * len(moved), len(thing.joints))
    np.testing.assert_array_equal(script[:HOLD_FRAMES], np.tile(thing.rest, (HOLD_FRAMES, 1)))
    again = motion_script(thing, moved, np.random.default_rng(seed), frames_per_joint=frames)
    np.testing.assert_array_equal(script, again)
    for j, joint in enumerate(thing.joints):
        assert script[:, j].min() >= joint.joint.lower - 1e-9
        assert script[:, j].max() <= joint.joint.upper + 1e-9
        if joint.joint.kind == "revolute":
            assert np.abs(script[:, j] - joint.rest).max() <= MAX_TURN_RAD + 1e-9
        moving = np.flatnonzero(np.abs(np.diff(script[:, j])) > 0)
        if j not in moved:
            assert len(moving) == 0
        else:
            k = moved.index(j)  # frame to frame changes of its own share only
            assert moving.min() >= max(k * frames, HOLD_FRAMES) - 1
            assert moving.max() < (k + 1) * frames - 1
            travel = min(t for t in joint.travel() if t > 0) if min(joint.travel()) > 0 else max(joint.travel())
            assert np.abs(script[:, j] - joint.rest).max() >= 0.55 * travel


@given(seeds, st.integers(30, 120))
def test_profile_is_smooth_and_opens_most_of_the_way(seed: int, frames: int) -> None:
    profile = joint_profile(frames, np.random.default_rng(seed))
    assert profile.min() >= 0
    assert 0.55 < profile.max() <= 1
    steps = np.diff(np.concatenate(([0.0], profile)))
    # A minimum-jerk movement is at its fastest 1.875 times its mean speed; the shortest one takes a fifth of the time.
    assert np.abs(steps).max() <= 1.875 / (0.2 * frames)


def test_scripts_differ() -> None:
    profiles = [joint_profile(60, np.random.default_rng(seed)) for seed in range(20)]
    returned = [p for p in profiles if np.diff(p).min() < -1e-6]
    opened = [p for p in profiles if np.diff(p).min() >= 0]
    assert returned
    assert opened
    assert len({p.tobytes() for p in profiles}) == len(profiles)


@given(st.floats(0, 1), st.floats(0, 1))
def test_minimum_jerk_is_monotone_from_zero_to_one(a: float, b: float) -> None:
    low, high = minimum_jerk(np.array(sorted((a, b))))
    assert 0 <= low <= high + 1e-12
    assert high <= 1 + 1e-12
    np.testing.assert_array_equal(minimum_jerk(np.array([0.0, 1.0])), [0, 1])


def test_no_time_to_move() -> None:
    with pytest.raises(ConfigError, match="frames per joint"):
        motion_script(articulation(("revolute", 0, 1)), (0,), np.random.default_rng(0), frames_per_joint=10)
