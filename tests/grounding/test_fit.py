"""The joint that explains a track."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quest.errors import InputError
from quest.grounding import JointKind, JointPrior, fit_joint, joint_from_prior
from tests.grounding.tracks import angle_deg, make_track

PRISMATIC, REVOLUTE = JointKind.PRISMATIC, JointKind.REVOLUTE
REAL = Path(__file__).parents[3] / "shared" / "data" / "articulation-tracks"


def make_prior(axis: np.ndarray, origin: np.ndarray, *, revolute: float = 0.5) -> JointPrior:
    return JointPrior(revolute, axis, 0.1, axis, 0.1, origin, 0.2)


@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.2])
@pytest.mark.parametrize(("kind", "amount"), [(PRISMATIC, 0.1), (REVOLUTE, np.pi / 6)])
def test_short_motions_are_told_apart(kind: JointKind, amount: float, outliers: float):
    """Outliers are gross: fifteen centimetres in noise of two millimetres."""
    right, angles = 0, []
    for seed in range(20):
        points, axis, _ = make_track(kind, amount=amount, sigma=0.002, seed=seed)
        joint = fit_joint(with_outliers(points, outliers, seed), 0.002)
        right += joint.kind is kind
        angles.append(angle_deg(joint.axis, axis))
    assert right >= 19
    assert np.median(angles) <= 2


def with_outliers(points: np.ndarray, share: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(points)) < share
    points[wrong] += 0.15 * rng.normal(size=(int(wrong.sum()), 3))
    return points


def test_an_outlier_near_the_curve_by_chance_makes_no_range():
    points, axis, _ = make_track(PRISMATIC, amount=0.1, sigma=0.001, seed=0)
    points[30] = points[0] + 0.4 * axis
    assert fit_joint(points, 0.001).upper == pytest.approx(0.1, abs=0.005)
    # What was seen several times is no chance.
    sigma = np.full(len(points), 0.001)
    sigma[30] = 0.0005
    assert fit_joint(points, sigma).upper == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize("kind", [PRISMATIC, REVOLUTE])
def test_beginning_at_the_last_joint_leads_to_the_same(kind: JointKind):
    for seed in range(5):
        points, _, _ = make_track(kind, amount=0.8, sigma=0.002, seed=seed)
        points = with_outliers(points, 0.1, seed)
        before = fit_joint(points[:45], 0.002)
        warm, cold = fit_joint(points, 0.002, near=before), fit_joint(points, 0.002)
        assert warm.kind is cold.kind is kind
        assert angle_deg(warm.axis, cold.axis) < 0.2
    # A joint of another track is of no use and does no harm.
    other = fit_joint(make_track(kind, amount=1.0, sigma=0.002, seed=99)[0], 0.002)
    again = fit_joint(points, 0.002, near=other)
    np.testing.assert_array_equal(again.axis, cold.axis)


def test_a_still_point_is_static():
    points = 0.01 * np.random.default_rng(0).normal(size=(40, 3)) + [1.0, 2.0, 3.0]
    joint = fit_joint(points, 0.01)
    assert joint.kind is JointKind.STATIC
    np.testing.assert_allclose(joint.at(np.array([0.0, 1.0])), [[1.0, 2.0, 3.0]] * 2, atol=0.01)
    assert 0.8 < joint.spread(np.zeros(1))[0] / (0.01 / 40**0.5) < 2


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 10.0), st.sampled_from([PRISMATIC, REVOLUTE]))
def test_the_fit_moves_and_grows_with_the_track(seed: int, scale: float, kind: JointKind):
    points, _, _ = make_track(kind, amount=1.0, sigma=0.002, seed=seed)
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    before = fit_joint(points, 0.002)
    after = fit_joint(scale * points @ turn.T + [1.0, -2.0, 0.5], scale * 0.002)
    assert after.kind is before.kind is kind
    np.testing.assert_allclose(after.axis, turn @ before.axis, atol=1e-2)
    unit = scale if kind is PRISMATIC else 1.0
    assert after.upper - after.lower == pytest.approx(unit * (before.upper - before.lower), rel=2e-2)


@pytest.mark.parametrize("kind", [PRISMATIC, REVOLUTE])
def test_points_of_the_curve_locate_to_themselves(kind: JointKind):
    points, _, _ = make_track(kind, amount=1.2, sigma=0.001, seed=3)
    joint = fit_joint(points, 0.001)
    q = np.linspace(-1.0, 2.0, 13)
    np.testing.assert_allclose(joint.locate(joint.at(q)), q, atol=1e-9)
    assert joint.upper > abs(joint.lower)


@pytest.mark.parametrize("kind", [PRISMATIC, REVOLUTE])
def test_the_spread_is_that_of_repeated_fits(kind: JointKind):
    clean, _, _ = make_track(kind, amount=1.0, sigma=0.0, seed=1)
    rng = np.random.default_rng(0)
    joints = [fit_joint(clean + 0.005 * rng.normal(size=clean.shape), 0.005) for _ in range(40)]
    # Fits do not share their coordinate q: compare at places that are fixed by the track.
    places = clean[[0, 30, 59]]
    gaps = np.array([j.at(j.locate(places)) - places for j in joints])
    measured = np.sqrt(np.square(gaps).sum(-1).mean(0) / 2)
    claimed = np.median([j.spread(j.locate(places)) for j in joints], axis=0)
    assert (claimed > 0.4 * measured).all()
    assert (claimed < 4 * measured).all()


def test_a_prior_decides_what_the_track_cannot():
    """Two centimetres of arc with a centimetre of noise: alone no door, with a belief in its axis a good one."""
    points, axis, origin = make_track(REVOLUTE, amount=0.3, sigma=0.01, seed=5)
    joint = fit_joint(points, 0.01, prior=make_prior(axis, origin, revolute=0.9))
    assert joint.kind is REVOLUTE
    assert angle_deg(joint.axis, axis) < 6
    drawer, axis, origin = make_track(PRISMATIC, amount=0.3, sigma=0.01, seed=5)
    assert fit_joint(drawer, 0.01, prior=make_prior(axis, origin, revolute=0.1)).kind is PRISMATIC


@pytest.mark.parametrize("kind", [PRISMATIC, REVOLUTE])
def test_a_prior_alone_is_sure_at_rest_only(kind: JointKind):
    axis, rest = np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.0, 0.2])
    joint = joint_from_prior(make_prior(axis, np.zeros(3)), rest, kind=kind, rest_sigma=0.01)
    np.testing.assert_allclose(joint.at(np.zeros(1))[0], rest, atol=1e-12)
    spread = joint.spread(np.array([0.0, 0.5, 1.0]))
    assert spread[0] == pytest.approx(0.01, rel=0.1)
    assert (np.diff(spread) > 0).all()


def test_noisy_tracks_do_not_explode():
    rng = np.random.default_rng(2)
    for _ in range(10):
        wander = np.cumsum(0.01 * rng.normal(size=(30, 3)), axis=0)
        joint = fit_joint(wander, 0.04)
        assert np.isfinite(joint.at(np.linspace(joint.lower, joint.upper, 5))).all()
        assert np.linalg.norm(joint.at(joint.locate(wander)) - wander, axis=1).max() < 0.2


def test_one_and_two_points_are_static():
    assert fit_joint(np.zeros((1, 3)), 0.01).kind is JointKind.STATIC
    assert fit_joint(np.eye(3)[:2], 0.01).kind is JointKind.STATIC


@pytest.mark.parametrize(
    ("points", "sigma"),
    [
        (np.zeros((0, 3)), 0.01),
        (np.zeros((5, 2)), 0.01),
        (np.full((5, 3), np.nan), 0.01),
        (np.zeros((5, 3)), 0.0),
        (np.zeros((5, 3)), np.nan),
        (np.zeros((5, 3)), np.ones(4)),
    ],
)
def test_what_cannot_be_fitted_is_refused(points: np.ndarray, sigma: float | np.ndarray):
    with pytest.raises(InputError, match=r"joint: expected|points"):
        fit_joint(points, sigma)


def test_priors_are_checked():
    good = make_prior(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    bad = ({"revolute_probability": 1.0}, {"origin_sigma": 0.0}, {"origin": np.full(3, np.nan)})
    for change in (*bad, {"revolute_axis": 2 * good.revolute_axis}, {"prismatic_axis": np.zeros(3)}):
        with pytest.raises(InputError, match="joint prior"):
            replace(good, **change)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real tracks (articulation-tracks) are not here")
def test_labelled_real_tracks():
    """A drawer slides; cabinets, doors and dishwashers turn."""
    wrong = []
    for path in sorted(REAL.rglob("*.log")):
        if "kitchen" in path.parts:
            continue
        points = np.loadtxt(path)[:, :3]
        points = points[:: max(1, len(points) // 100)]
        expected = PRISMATIC if "drawer" in str(path.relative_to(REAL)) else REVOLUTE
        if fit_joint(points, None).kind is not expected:
            wrong.append(path.name)
    assert not wrong
