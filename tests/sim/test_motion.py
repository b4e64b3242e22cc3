"""Motion scripts: hold, one joint after the other, inside its limits, smooth, always the same."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quest.errors import ConfigError
from quest.sim.articulation import MAX_TURN_RAD, Articulation
from quest.sim.motion import (
    HOLD_FRAMES,
    PROFILES,
    MotionStyle,
    ProfileKind,
    draw_profile,
    long_script,
    motion_script,
    share_plan,
)
from tests.sim.small_objects import articulation

seeds = st.integers(0, 2**31 - 1)
limits = st.tuples(st.floats(-3, 0), st.floats(0.1, 3))
joints = st.lists(st.tuples(st.sampled_from(["revolute", "prismatic"]), limits), min_size=1, max_size=4)
styles = st.builds(
    MotionStyle,
    kind=st.sampled_from([*PROFILES, "mixed"]),
    overlap=st.floats(0, 0.89),
    margin=st.tuples(st.integers(0, 8), st.integers(0, 8)),
    cycles=st.integers(1, 3),
)


def assert_possible(script: np.ndarray, thing: Articulation, longest: float) -> None:
    """Nothing moves in the hold, nothing leaves its limits, nothing jumps."""
    np.testing.assert_array_equal(script[:HOLD_FRAMES], np.tile(thing.rest, (len(script[:HOLD_FRAMES]), 1)))
    for j, joint in enumerate(thing.joints):
        assert script[:, j].min() >= joint.joint.lower - 1e-9
        assert script[:, j].max() <= joint.joint.upper + 1e-9
        if joint.joint.kind == "revolute":
            assert np.abs(script[:, j] - joint.rest).max() <= MAX_TURN_RAD + 1e-9
        assert np.abs(np.diff(script[:, j])).max(initial=0) <= longest * max(joint.travel()) + 1e-9


@settings(max_examples=50)
@given(joints, seeds, st.integers(27, 60), styles | st.just(MotionStyle()))
def test_script_of_any_style(drawn: list, seed: int, frames: int, style: MotionStyle) -> None:
    thing = articulation(*((kind, *limit) for kind, limit in drawn))
    order = tuple(int(j) for j in np.random.default_rng(seed).permutation(len(thing.joints)))
    moved = order[: 1 + seed % len(order)]
    script, again = (
        motion_script(thing, moved, np.random.default_rng(seed), frames_per_joint=frames, style=style) for _ in range(2)
    )
    np.testing.assert_array_equal(script, again)
    plan = share_plan(moved, frames_per_joint=frames, style=style)
    assert len(script) == plan[-1].end
    assert_possible(script, thing, 10 / (frames - HOLD_FRAMES - sum(style.margin)))
    may_move = np.zeros(script.shape, dtype=bool)
    for share in plan:
        assert not may_move[share.start : share.end, share.joint].any()  # a joint waits for itself
        assert share.moves >= max(share.start, HOLD_FRAMES) + style.margin[0]
        assert share.stops == share.end - style.margin[1]
        may_move[share.moves : share.stops, share.joint] = True
        path = np.abs(script[share.start : share.end, share.joint] - thing.rest[share.joint])
        assert (path[-1] > 0) == share.opens
        if not share.opens:
            assert path[-1] == pytest.approx(0, abs=1e-9)
        else:
            joint = thing.joints[share.joint]
            travel = min(joint.travel()) if min(joint.travel()) > 0 else max(joint.travel())
            assert path.max() >= 0.55 * travel
    assert not (np.diff(script, axis=0, prepend=script[:1])[~may_move] != 0).any()
    if style.cycles == 1:
        assert len(script) == frames + (len(moved) - 1) * round((1 - style.overlap) * frames)
        assert [share.joint for share in plan] == list(moved)


def test_the_usual_script_stays_what_it_was() -> None:
    """Takes that exist were made by these numbers: a seed must go on to mean the same motion."""
    thing = articulation(("revolute", -1.0, 1.2), ("prismatic", 0, 0.4), ("revolute", 0, 3))
    script = motion_script(thing, (2, 0, 1), np.random.default_rng(7), frames_per_joint=40)
    digest = hashlib.sha256(np.round(script, 9).tobytes()).hexdigest()
    assert digest.startswith("c79eb246ade118d9"), digest


def test_shares_overlap_and_the_last_to_open_closes_first() -> None:
    plan = share_plan((0, 1, 2), frames_per_joint=60, style=MotionStyle(overlap=0.5))
    assert [(s.start, s.end) for s in plan] == [(0, 60), (30, 90), (60, 120)]
    plan = share_plan((2, 0), frames_per_joint=60, style=MotionStyle(cycles=3))
    assert [(s.joint, s.opens) for s in plan] == [(2, True), (0, True), (0, False), (2, False), (2, True), (0, True)]
    assert plan[-1].end == 360


@settings(max_examples=30)
@given(joints, seeds, st.integers(27, 60), styles, st.integers(9, 1500))
def test_long_script(drawn: list, seed: int, frames_per_joint: int, style: MotionStyle, frames: int) -> None:
    thing = articulation(*((kind, *limit) for kind, limit in drawn))
    moved = tuple(range(len(thing.joints)))
    rng = np.random.default_rng(seed)
    script = long_script(thing, moved, rng, frames=frames, frames_per_joint=frames_per_joint, style=style)
    assert script.shape == (frames, len(moved))
    shortest = max(round(0.7 * frames_per_joint), 11 + sum(style.margin)) - HOLD_FRAMES - sum(style.margin)
    assert_possible(script, thing, 10 / shortest)


def test_long_script_opens_and_closes_every_joint_again_and_again() -> None:
    thing = articulation(("revolute", 0, 1.5), ("prismatic", 0, 0.4), ("prismatic", 0, 0.4))
    script = long_script(thing, (0, 2), np.random.default_rng(0), frames=10_000, style=MotionStyle("mixed"))
    assert (script[:, 1] == 0).all()
    for j in (0, 2):
        assert (np.diff((script[:, j] > 1e-9).astype(int)) != 0).sum() > 40
        assert np.flatnonzero(np.diff(script[:, j]) != 0)[0] < 250


@given(st.sampled_from(PROFILES), seeds, st.integers(3, 200), st.none() | st.floats(0.1, 1))
def test_profiles(kind: ProfileKind, seed: int, frames: int, closing_from: float | None) -> None:
    profile = draw_profile(kind, frames, np.random.default_rng(seed), closing_from=closing_from)
    assert profile.shape == (frames,)
    assert profile.min() >= 0
    assert profile.max() <= (1 if closing_from is None else closing_from)
    assert np.abs(np.diff(np.concatenate(([closing_from or 0.0], profile)))).max() <= 10 / frames
    if closing_from is not None:
        assert profile[-1] == pytest.approx(0, abs=1e-12)
    elif frames > 20:
        assert profile.max() > 0.55


def test_people_stop_and_return_at_times_and_robots_keep_their_speed() -> None:
    human, robot = ([draw_profile(k, 200, np.random.default_rng(s)) for s in range(40)] for k in ("human", "robot"))
    for profiles in (human, robot):
        assert 5 < sum(np.diff(p).min() < -1e-6 for p in profiles) < 30
        assert len({p.tobytes() for p in profiles}) == len(profiles)
    # A minimum-jerk movement is at its fastest 1.875 times its mean speed; the shortest one takes a fifth of the time.
    assert max(np.abs(np.diff(p)).max() for p in human) <= 1.875 / (0.2 * 200)
    for speed in (np.abs(np.diff(p)) for p in robot):
        assert (np.isclose(speed, speed.max(), rtol=1e-6)).mean() > 0.25


def test_what_creeps_sticks_and_slips_all_the_way() -> None:
    for seed in range(20):
        profile = draw_profile("creep", 240, np.random.default_rng(seed))
        speed = np.diff(profile)
        assert speed.min() >= 0
        assert profile[-1] >= 0.85
        middle = speed[24:-24]
        assert 0.05 < (middle == 0).mean() < 0.5
        assert ((middle > 0) & (middle < 1.6 / 240)).sum() > 0.4 * len(middle)


@pytest.mark.parametrize("setting", [{"overlap": 0.9}, {"overlap": -0.1}, {"margin": (-1, 0)}, {"cycles": 0}])
def test_style_refuses_what_cannot_be(setting: dict) -> None:
    with pytest.raises(ConfigError, match="motion"):
        MotionStyle(**setting)


def test_no_time_to_move() -> None:
    thing, style = articulation(("revolute", 0, 1)), MotionStyle(margin=(20, 20))
    with pytest.raises(ConfigError, match="frames per joint: expected at least 51"):
        motion_script(thing, (0,), np.random.default_rng(0), frames_per_joint=50, style=style)
    assert len(motion_script(thing, (0,), np.random.default_rng(0), frames_per_joint=51, style=style)) == 51
    for moved, frames in (((), 100), ((0,), 8)):
        with pytest.raises(ConfigError, match="long script"):
            long_script(thing, moved, np.random.default_rng(0), frames=frames)
