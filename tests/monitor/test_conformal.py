"""Thresholds: ranks, tails, and the promise on streams that are exchangeable."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quest.errors import ConfigError
from quest.monitor.conformal import Budget, threshold
from tests.monitor.calibrations import share


@pytest.mark.parametrize(
    ("n", "alpha", "rank"), [(99, 0.01, 99), (99, 0.1, 90), (19, 0.05, 19), (100, 0.05, 96), (199, 0.01, 198)]
)
def test_rank(n: int, alpha: float, rank: int):
    found = threshold(np.arange(1.0, n + 1), alpha)
    assert (found.value, found.extrapolated, found.alpha) == (rank, False, alpha)


@given(st.integers(1, 60), st.floats(0.01, 0.9), st.integers(0, 2**32 - 1))
def test_promise(n: int, alpha: float, seed: int):
    """Leave each of n + 1 streams out in turn: at most a share of alpha exceeds the threshold of the others."""
    maxima = np.random.default_rng(seed).integers(0, 20, size=n + 1).astype(float)  # with ties
    if alpha < 1 / (n + 1):
        return
    false = sum(v > threshold(np.sort(np.delete(maxima, i)), alpha).value for i, v in enumerate(maxima))
    assert false <= alpha * (n + 1) + 1e-9


def test_tail_is_flagged_and_near_the_truth():
    rng = np.random.default_rng(0)
    found = [threshold(np.sort(rng.exponential(size=200)), 0.001) for _ in range(200)]
    assert all(f.extrapolated for f in found)
    assert np.median([f.value for f in found]) == pytest.approx(-math.log(0.001), rel=0.15)
    exceeded = np.mean([math.exp(-f.value) for f in found])
    assert exceeded < 0.003


def test_heavier_tails_reach_farther():
    q = (np.arange(400) + 0.5) / 400
    light, heavy = -np.log1p(-q), ((1 - q) ** -0.4 - 1) / 0.4
    assert threshold(heavy, 1e-4).value > threshold(light, 1e-4).value > light[-1]


def test_tail_never_comes_below_what_was_seen():
    bounded = np.sort(np.random.default_rng(0).random(100))
    levels = [threshold(bounded, alpha).value for alpha in (0.02, 0.009, 0.005, 0.0001)]
    assert levels == sorted(levels)
    assert levels[1] >= bounded[-1]
    assert threshold(np.full(100, 2.0), 0.001).value == 2.0
    few = threshold(np.arange(30.0), 0.01)
    assert (few.value, few.extrapolated) == (math.inf, True)


@given(st.integers(1, 400), st.integers(1, 100), st.integers(0, 5))
def test_so_many_frames_share_alpha(frames: int, block_frames: int, n: int):
    """The blocks of the n-th so many frames spend all of alpha, none of them longer than calibration streams."""
    budget = Budget(0.1, frames)
    since = budget.since(np.arange(n * frames, (n + 1) * frames))
    begun = np.flatnonzero(since % block_frames == 0)
    assert begun[0] == 0
    assert np.diff(np.append(begun, frames)).max() <= block_frames
    parts = [budget.part(block=int(since[t] // block_frames) + 1, restart=3, block_frames=block_frames) for t in begun]
    assert sum(parts) == pytest.approx(0.1)


def test_no_probability_and_no_budget():
    frames: Any
    for alpha in (0.0, 1.0, -1.0, math.nan):
        with pytest.raises(ConfigError, match="alpha"):
            threshold(np.arange(3.0), alpha)
        with pytest.raises(ConfigError, match="alpha"):
            Budget(alpha)
    with pytest.raises(ConfigError, match="stream"):
        threshold(np.zeros(0), 0.1)
    for frames in (0, -60, 1800.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="frames"):
            Budget(0.1, frames)


def test_what_is_spent_adds_up():
    blocks = [share(0.1, block=b, restart=0) for b in range(1, 10_001)]
    assert sum(blocks) == pytest.approx(0.1, rel=1e-3)
    assert sum(blocks) < 0.1
    restarts = [share(0.1, block=b, restart=j) for j in range(1, 60) for b in range(1, 2000)]
    assert sum(restarts) == pytest.approx(0.1, rel=1e-2)
    assert share(0.01, block=10**6, restart=10**6) > 0.0
    assert (
        threshold(np.sort(np.random.default_rng(0).random(300)), share(0.01, block=9, restart=10**6)).value < math.inf
    )
