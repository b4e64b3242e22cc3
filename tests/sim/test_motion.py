"""Motion scripts: hold, one joint after the other, inside its limits, smooth, always the same."""

import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quest.errors import ConfigError
from quest.sim.articulation import MAX_TURN_RAD
from quest.sim.motion import (
    HOLD_FRAMES,
    PROFILES,
    MotionStyle,
    ProfileKind,
    draw_profile,
    joint_profile,
    long_script,
    minimum_jerk,
    motion_script,
    share_plan,
    trapezoid,
)
from tests.sim.small_objects import articulation

seeds = st.integers(0, 2**31 - 1)
kinds = st.sampled_from(["revolute", "prismatic"])
limits = st.tuples(st.floats(-3, 0), st.floats(0.1, 3))
joints = st.lists(st.tuples(kinds, limits), min_size=1, max_size=4)
styles = st.builds(
    MotionStyle,
    kind=st.sampled_from([*PROFILES, "mixed"]),
    overlap=st.floats(0, 0.89),
    margin=st.tuples(st.integers(0, 8), st.integers(0, 8)),
    cycles=st.integers(1, 3),
)


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


def test_the_usual_script_stays_what_it_was() -> None:
    """Takes that exist were made by these numbers: a seed must go on to mean the same motion."""
    thing = articulation(("revolute", -1.0, 1.2), ("prismatic", 0, 0.4), ("revolute", 0, 3))
    script = motion_script(thing, (2, 0, 1), np.random.default_rng(7), frames_per_joint=40)
    digest = hashlib.sha256(np.round(script, 9).tobytes()).hexdigest()
    assert digest.startswith("c79eb246ade118d9"), digest


def assert_possible(script: np.ndarray, thing: object, longest: float) -> None:
    """Nothing moves in the hold, nothing leaves its limits, nothing jumps."""
    np.testing.assert_array_equal(script[:HOLD_FRAMES], np.tile(thing.rest, (len(script[:HOLD_FRAMES]), 1)))  # type: ignore[attr-defined]
    for j, joint in enumerate(thing.joints):  # type: ignore[attr-defined]
        assert script[:, j].min() >= joint.joint.lower - 1e-9
        assert script[:, j].max() <= joint.joint.upper + 1e-9
        assert np.abs(np.diff(script[:, j])).max(initial=0) <= longest * max(joint.travel()) + 1e-9


@given(joints, seeds, st.integers(27, 60), styles)
def test_script_of_any_style(drawn: list, seed: int, frames: int, style: MotionStyle) -> None:
    thing = articulation(*((kind, *limit) for kind, limit in drawn))
    order = tuple(int(j) for j in np.random.default_rng(seed).permutation(len(thing.joints)))
    script = motion_script(thing, order, np.random.default_rng(seed), frames_per_joint=frames, style=style)
    plan = share_plan(order, frames_per_joint=frames, style=style)
    assert len(script) == plan[-1].end
    assert_possible(script, thing, 10 / (frames - HOLD_FRAMES - sum(style.margin)))
    may_move = np.zeros(script.shape, dtype=bool)
    for share in plan:
        assert not may_move[share.start : share.end, share.joint].any()  # a joint waits for itself
        assert share.moves >= max(share.start, HOLD_FRAMES) + style.margin[0]
        assert share.stops == share.end - style.margin[1]
        may_move[share.moves : share.stops, share.joint] = True
        opened = np.abs(script[share.end - 1, share.joint] - thing.rest[share.joint])
        assert (opened > 0) == share.opens
        if not share.opens:
            assert script[share.end - 1, share.joint] == pytest.approx(thing.rest[share.joint], abs=1e-9)
    assert not (np.diff(script, axis=0, prepend=script[:1])[~may_move] != 0).any()
    if style.cycles == 1:
        step = round((1 - style.overlap) * frames)
        assert len(script) == frames + (len(order) - 1) * step
        assert [share.joint for share in plan] == list(order)


def test_overlapping_shares() -> None:
    plan = share_plan((0, 1, 2), frames_per_joint=60, style=MotionStyle(overlap=0.5))
    assert [(s.start, s.end) for s in plan] == [(0, 60), (30, 90), (60, 120)]


def test_the_last_to_open_closes_first() -> None:
    plan = share_plan((2, 0), frames_per_joint=60, style=MotionStyle(cycles=3))
    assert [(s.joint, s.opens) for s in plan] == [(2, True), (0, True), (0, False), (2, False), (2, True), (0, True)]
    assert plan[-1].end == 360


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
        closed = np.flatnonzero(np.abs(np.diff((script[:, j] > 1e-9).astype(int))) > 0)
        assert len(closed) > 40
    firsts = [np.flatnonzero(np.diff(script[:, j]) != 0)[0] for j in (0, 2)]
    assert max(firsts) < 250


@given(st.sampled_from(PROFILES), seeds, st.integers(3, 200), st.none() | st.floats(0.1, 1))
def test_profiles(kind: ProfileKind, seed: int, frames: int, closing_from: float | None) -> None:
    profile = draw_profile(kind, frames, np.random.default_rng(seed), closing_from=closing_from)
    start = closing_from or 0.0
    assert profile.shape == (frames,)
    assert profile.min() >= 0
    assert profile.max() <= (1 if closing_from is None else closing_from)
    assert np.abs(np.diff(np.concatenate(([start], profile)))).max() <= 10 / frames
    if closing_from is not None:
        assert profile[-1] == pytest.approx(0, abs=1e-12)
    elif frames > 20:
        assert profile.max() > 0.55


def test_robots_keep_their_speed_and_give_back_at_times() -> None:
    profiles = [draw_profile("robot", 200, np.random.default_rng(seed)) for seed in range(40)]
    returned = 0
    for profile in profiles:
        speed = np.abs(np.diff(profile))
        assert (np.isclose(speed, speed.max(), rtol=1e-6)).mean() > 0.25
        returned += bool(np.diff(profile).min() < 0)
    assert 5 < returned < 30


def test_what_creeps_sticks_and_slips_all_the_way() -> None:
    for seed in range(20):
        profile = draw_profile("creep", 240, np.random.default_rng(seed))
        speed = np.diff(profile)
        assert speed.min() >= 0
        assert profile[-1] >= 0.85
        middle = speed[24:-24]
        assert 0.05 < (middle == 0).mean() < 0.5
        going = middle[(middle > 0) & (middle < 1.6 / 240)]
        assert len(going) > 0.4 * len(middle)


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0.05, 0.45))
def test_trapezoid_is_monotone_from_zero_to_one(a: float, b: float, ramp: float) -> None:
    low, high = trapezoid(np.array(sorted((a, b))), ramp)
    assert -1e-12 <= low <= high + 1e-12
    assert high <= 1 + 1e-12
    np.testing.assert_allclose(trapezoid(np.array([0.0, 0.5, 1.0]), ramp), [0, 0.5, 1], atol=1e-12)


@pytest.mark.parametrize("setting", [{"overlap": 0.9}, {"overlap": -0.1}, {"margin": (-1, 0)}, {"cycles": 0}])
def test_style_refuses_what_cannot_be(setting: dict) -> None:
    with pytest.raises(ConfigError, match="motion"):
        MotionStyle(**setting)


def test_no_time_beside_the_margins() -> None:
    thing = articulation(("revolute", 0, 1))
    style = MotionStyle(margin=(20, 20))
    with pytest.raises(ConfigError, match="at least 51"):
        motion_script(thing, (0,), np.random.default_rng(0), frames_per_joint=50, style=style)
    assert len(motion_script(thing, (0,), np.random.default_rng(0), frames_per_joint=51, style=style)) == 51


@pytest.mark.parametrize(("moved", "frames"), [((), 100), ((0,), 8)])
def test_no_long_script(moved: tuple[int, ...], frames: int) -> None:
    with pytest.raises(ConfigError, match="long script"):
        long_script(articulation(("revolute", 0, 1)), moved, np.random.default_rng(0), frames=frames)
