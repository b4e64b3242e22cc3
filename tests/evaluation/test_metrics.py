"""Every metric against a plain loop: two records or more, nothing visible, NaN predictions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quest.errors import InputError
from quest.evaluation import metrics as m


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def _answers(rng: np.random.Generator, frames: int = 13) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predictions of three queries, truth of four entities, and whose each prediction is."""
    own = np.array([2, 0, 3])
    truth = rng.normal(size=(frames, 4, 3)).astype(np.float32) * 0.2
    scale = rng.choice([0.01, 0.08, 0.5], size=(frames, 3, 1))
    predicted = (truth[:, own] + scale * rng.normal(size=(frames, 3, 3))).astype(np.float32)
    predicted[2:5, 0] = np.nan
    predicted[7, 1, 2] = np.inf
    return predicted, truth, own


def test_distance_is_normalised_and_missing_scores_one(rng: np.random.Generator) -> None:
    predicted, truth, own = _answers(rng)
    got = m.distance(predicted, truth[:, own], half_diagonal_m=0.7)
    for t in range(13):
        for k in range(3):
            p, q = predicted[t, k].astype(float), truth[t, own[k]].astype(float)
            want = 1.0 if not np.isfinite(p).all() else math.dist(p, q) / 0.7
            assert got[t, k] == pytest.approx(want)


def test_distance_refuses_a_unit_of_zero() -> None:
    with pytest.raises(InputError, match="half_diagonal_m > 0"):
        m.distance(np.zeros((2, 3)), np.zeros((2, 3)), half_diagonal_m=0.0)


@pytest.mark.parametrize("size", [(640, 480), (224, 224), (100, 300)])
def test_distance_px_equals_letterboxing_both_points(rng: np.random.Generator, size: tuple[int, int]) -> None:
    width, height = size
    uv = (rng.uniform(size=(5, 2, 2)) * size).astype(np.float32)
    true = (rng.uniform(size=(5, 2, 2)) * size).astype(np.float32)
    uv[0, 0] = np.nan
    true[1, 1] = np.nan
    got = m.distance_px(uv, true, width=width, height=height)
    scale = 224 / max(width, height)
    pad = np.array([(224 - scale * width) / 2, (224 - scale * height) / 2])
    for t in range(5):
        for k in range(2):
            if np.isnan(true[t, k]).any():
                assert np.isnan(got[t, k])
            elif np.isnan(uv[t, k]).any():
                assert got[t, k] == pytest.approx(224 * math.sqrt(2))
            else:
                assert got[t, k] == pytest.approx(math.dist(uv[t, k] * scale + pad, true[t, k] * scale + pad), rel=1e-5)


def _plain_identity(p: np.ndarray, truth: np.ndarray, own: int, unit: float) -> int:
    if not np.isfinite(p).all():
        return -1
    gaps = [math.dist(p.astype(float), q.astype(float)) / unit for q in truth]
    best = min(range(len(gaps)), key=lambda e: (gaps[e], e != own))
    return best if gaps[best] <= 0.1 else -1


def test_identity_and_accuracy_equal_a_plain_loop(rng: np.random.Generator) -> None:
    predicted, truth, own = _answers(rng)
    got = m.identity(predicted, truth, own, half_diagonal_m=0.7)
    want = [[_plain_identity(predicted[t, k], truth[t], own[k], 0.7) for k in range(3)] for t in range(13)]
    assert got.tolist() == want
    assert len({-1, *own} & set(got.ravel().tolist())) > 1  # the draw has right and missing identities
    counted = np.ones((3, 13), dtype=bool)
    counted[1, :4] = False
    hits = [want[t][k] == own[k] for k in range(3) for t in range(13) if counted[k, t]]
    assert m.accuracy(got.T, own, counted).mean() == pytest.approx(sum(hits) / len(hits))


def test_own_entity_wins_a_tie() -> None:
    truth = np.zeros((1, 3, 3), dtype=np.float32)
    got = m.identity(np.zeros((1, 1, 3), dtype=np.float32), truth, np.array([2]), half_diagonal_m=1.0)
    assert got.item() == 2


def test_frame_mean_leaves_out_uncounted_and_unknown_frames(rng: np.random.Generator) -> None:
    value = rng.uniform(size=(4, 9))
    value[0, 3] = np.nan
    counted = rng.uniform(size=(4, 9)) > 0.4
    counted[0, 3] = True
    terms = [value[n, t] for n in range(4) for t in range(9) if counted[n, t] and not np.isnan(value[n, t])]
    assert m.frame_mean(value, counted).mean() == pytest.approx(np.mean(terms))


def test_nothing_visible_gives_nan_and_no_count() -> None:
    sums = m.frame_mean(np.ones((2, 5)), np.zeros((2, 5), dtype=bool))
    assert math.isnan(sums.mean())
    assert sums.count.tolist() == [0, 0]


@pytest.mark.parametrize(("frames", "share", "frame"), [(240, 0.5, 120), (240, 1.0, 239), (61, 0.5, 30), (1, 0.5, 0)])
def test_distance_at_frame(frames: int, share: float, frame: int) -> None:
    gap = np.tile(np.arange(frames, dtype=float), (2, 1))
    assert m.distance_at(gap, share, np.ones(gap.shape, dtype=bool)).mean() == frame


def test_distance_at_a_frame_before_the_query_does_not_count() -> None:
    gap = np.array([[0.2] * 9, [1.0] * 6 + [0.4] * 3])
    half = m.distance_at(gap, 0.5, np.arange(9) >= np.array([[0], [6]]))
    assert (half.mean(), half.count.tolist()) == (0.2, [1, 0])


@pytest.mark.parametrize(
    ("follows", "count"),
    [
        ([0] * 8, 0),
        ([0, 0, 1, 1, 0, 0, 0, 0], 0),  # two frames are no switch
        ([0, 0, 1, 1, 1, 0, 0, 0], 2),  # there and back
        ([1, 1, 1, 1, 1, 1, 1, 1], 1),  # another one from the start
        ([0, 0, -1, -1, -1, 0, 0, 0], 0),  # lost and found
        ([0, -1, -1, 2, 2, 2, -1, 1], 1),
        ([0, 1, 1, -1, 1, 1, 0, 0], 0),  # a gap ends a run
        ([-1] * 8, 0),
    ],
)
def test_switches(follows: list[int], count: int) -> None:
    both = np.array([follows, [0] * 8])
    counted = np.ones((2, 8), dtype=bool)
    sums = m.switches(both, np.array([0, 0]), counted)
    assert sums.total.tolist() == [1000.0 * count, 0.0]
    assert sums.mean() == pytest.approx(1000 * count / 16)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(-1, 2), min_size=0, max_size=30), st.integers(0, 2))
def test_switches_equal_a_plain_loop(follows: list[int], own: int) -> None:
    now, count, t = own, 0, 0
    while t < len(follows):
        end = t
        while end < len(follows) and follows[end] == follows[t]:
            end += 1
        if end - t >= 3 and follows[t] != -1 and follows[t] != now:
            now, count = follows[t], count + 1
        t = end
    got = m.switches(np.array([follows], dtype=int), np.array([own]), np.ones((1, len(follows)), dtype=bool))
    assert got.total.tolist() == [1000.0 * count]


def test_slope_equals_polyfit(rng: np.random.Generator) -> None:
    gap = rng.uniform(size=(3, 20))
    counted = np.ones((3, 20), dtype=bool)
    counted[1, :6] = False
    counted[2, 1:] = False  # one frame has no slope
    got = m.slope(gap, counted)
    want = [100 * np.polyfit(np.flatnonzero(c), g[c], 1)[0] for g, c in zip(gap[:2], counted[:2], strict=True)]
    np.testing.assert_allclose(got.total, [*want, 0.0], atol=1e-9)
    assert got.count.tolist() == [1, 1, 0]
    assert got.mean() == pytest.approx(np.mean(want))
