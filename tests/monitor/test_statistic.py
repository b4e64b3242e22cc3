"""Sequential statistics, against plain loops and another implementation."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.monitor.statistic import Cusum, Latest, PageHinkley, Statistic

# Made with river 0.26.1: PageHinkley(min_instances=1, delta=0.1, alpha=1.0, mode="up"), its sum less its minimum.
COURSE = [0.637, 0.27, 0.041, 0.017, 0.813, 0.913, 0.607, 0.729, 0.544, 0.935, 0.816, 0.003, 2.012, 2.45, 1.644]
RIVER = [0.0, 0.0, 0.0, 0.0, 0.3574, 0.7219, 0.757757, 0.883382, 0.819493, 1.103893, 1.245166, 0.621083]


def course(statistic: Statistic, evidence: np.ndarray) -> np.ndarray:
    """Values of the statistic, T by N."""
    state, values = np.zeros((evidence.shape[1], statistic.size)), []
    for frame in evidence:
        state, value = statistic.update(state, frame)
        values.append(value)
    return np.array(values)


@pytest.mark.parametrize(("drift", "keep"), [(0.0, 1.0), (0.5, 1.0), (-1.0, 0.6), (0.2, 0.0)])
def test_cusum(drift: float, keep: float):
    evidence = np.random.default_rng(0).normal(size=(50, 3))
    found = course(Cusum(drift, keep), evidence)
    for k in range(3):
        s = 0.0
        for t in range(50):
            s = max(0.0, keep * s + evidence[t, k] - drift)
            assert found[t, k] == pytest.approx(s)


@pytest.mark.parametrize(("drift", "keep"), [(-1.0, 1.0), (-1.0, 0.6), (0.5, 0.0), (9.0, 1.0)])
def test_the_most_that_a_sum_can_be(drift: float, keep: float):
    assert course(Cusum(drift, keep), np.full((7, 1), 8.0))[-1, 0] == pytest.approx(Cusum(drift, keep).most(8.0, 7))


def test_page_hinkley_as_river_has_it():
    evidence = np.array(COURSE)[:, None]
    np.testing.assert_allclose(course(PageHinkley(0.1), evidence)[: len(RIVER), 0], RIVER, atol=2e-6)
    np.testing.assert_allclose(course(PageHinkley(0.1), np.ones((9, 1))), 0.0)


def test_latest_forgets():
    evidence = np.random.default_rng(0).normal(size=(9, 2))
    np.testing.assert_array_equal(course(Latest(), evidence), evidence)


@pytest.mark.parametrize("statistic", [Cusum(0.1, 0.9), PageHinkley(0.01), Latest()])
def test_queries_do_not_depend_on_each_other(statistic: Statistic):
    evidence = np.random.default_rng(1).normal(size=(20, 4))
    np.testing.assert_array_equal(course(statistic, evidence)[:, [3, 1]], course(statistic, evidence[:, [3, 1]]))


def test_settings_out_of_range():
    for drift, keep in ((np.inf, 1.0), (0.0, 1.1), (0.0, -0.1), (np.nan, 0.5)):
        with pytest.raises(ConfigError, match="keep"):
            Cusum(drift, keep)
