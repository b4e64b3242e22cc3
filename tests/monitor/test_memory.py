"""The memory of signals, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from quest.monitor import SIGNALS
from quest.monitor import memory as memories


def courses(seed: int = 0, *, frames: int = 40, queries: int = 3, missing: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(frames, queries, len(SIGNALS)))
    return np.where(rng.random(values.shape) < missing, np.nan, values)


def after(values: np.ndarray) -> np.ndarray:
    memory = memories.start(values.shape[1])
    for frame in values:
        memory = memories.remember(memory, frame)
    return memory


def plain(course: np.ndarray) -> dict[int, float]:
    """What is remembered of one signal of one query."""
    known = [float(v) for v in course if not np.isnan(v)]
    found: dict[int, float] = {memories.COUNT: len(known), memories.AGE: len(course), memories.OFF: 0}
    found[memories.LEVEL] = float(np.mean(known[: memories.LEVEL_FRAMES]))
    for row, constant in zip((memories.FAST, memories.MID, memories.SLOW), memories.TIME_CONSTANTS, strict=True):
        mean = 0.0
        for n, value in enumerate(known, start=1):
            mean += max(1 / constant, 1 / n) * (value - mean)
        found[row] = mean
    high = low = known[0]
    for value in known[1:]:
        high = max(value, high + (value - high) / memories.RETURN_FRAMES)
        low = min(value, low + (value - low) / memories.RETURN_FRAMES)
    found |= {memories.HIGH: high, memories.LOW: low}
    for n in range(len(known)):
        level = np.mean(known[: n + 1][: memories.LEVEL_FRAMES])
        off = abs(known[n] - level) > memories.OFF_LEVEL and abs(known[n]) > memories.OFF_LEVEL
        found[memories.OFF] = found[memories.OFF] + 1 if off else 0
    return found


@pytest.mark.parametrize("missing", [0.0, 0.3, 0.9])
def test_against_plain_loops(missing: float):
    values = courses(missing=missing)
    memory = after(values)
    for k in range(values.shape[1]):
        for s in range(len(SIGNALS)):
            if np.isnan(values[:, k, s]).all():
                continue
            for row, expected in plain(values[:, k, s]).items():
                assert memory[k, row, s] == pytest.approx(expected, abs=1e-12), (k, row, s)


def test_what_is_given_stays_as_it_is():
    memory = memories.start(3)
    memories.remember(memory, courses()[0])
    assert not memory.any()


def test_unknown_signals_leave_no_nan():
    values = courses()
    values[:, 1] = np.nan
    memory = after(values)
    found = memories.features(memory, values[-1])
    assert np.isfinite(found).all()
    assert found.shape == (3, memories.FEATURES)
    missing = found[1, 6 * len(SIGNALS) : 7 * len(SIGNALS)]
    assert (missing == 1).all()
    assert not found[1, : 6 * len(SIGNALS)].any()


def test_queries_do_not_depend_on_each_other():
    values = courses(queries=4)
    order = [2, 0, 3, 1]
    np.testing.assert_array_equal(after(values)[order], after(values[:, order]))
    np.testing.assert_array_equal(after(values)[:1], after(values[:, :1]))


def test_back_to_normal():
    values = courses(missing=0.0)
    memory = after(values)[0]
    found = memories.features(memory[None], values[-1, :1])[0]
    normal = memories.with_normal(found, memory)
    blocks = normal[:, :-1].reshape(len(SIGNALS), 7, len(SIGNALS))
    for s in range(len(SIGNALS)):
        assert (blocks[s, :6, s] == memory[memories.LEVEL, s]).all()
        assert not blocks[s, 6:, s].any()
        others = np.arange(len(SIGNALS)) != s
        assert (blocks[s][:, others] == found[:-1].reshape(7, -1)[:, others]).all()
    forgiven = memories.forgive(memory)
    calm = memories.features(forgiven[None], memory[None, memories.LEVEL])[0]
    assert (calm[:-1].reshape(7, -1)[:6] == memory[memories.LEVEL]).all()
    assert calm[-1] == found[-1]
