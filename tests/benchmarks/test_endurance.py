"""Arithmetic of long runs."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.endurance import (
    Reading,
    forth_and_back,
    memory_growth,
    resident_bytes,
    time_change,
)
from quest.errors import InputError


def readings(ms_per_frame: np.ndarray, resident: np.ndarray | None = None) -> list[Reading]:
    seconds = np.concatenate([[0.0], np.cumsum(ms_per_frame)]) / 100
    resident = np.full(len(seconds), 1000) if resident is None else resident
    return [
        Reading(10 * i, int(m), float(s), 2 * float(s)) for i, (s, m) in enumerate(zip(seconds, resident, strict=True))
    ]


def test_forth_and_back():
    assert [forth_and_back(t, 4) for t in range(9)] == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    with pytest.raises(InputError, match="at least 2"):
        forth_and_back(0, 1)


def test_time_of_the_last_tenth_against_the_second():
    ms = np.ones(100)
    ms[:10], ms[10:20], ms[20:90], ms[90:] = 90, 10, 50, 11
    change = time_change(readings(ms), clock="cpu_s")
    assert (change.early_ms, change.late_ms) == (pytest.approx(10), pytest.approx(11))
    assert [change.percent, change.low, change.high] == pytest.approx([10, 10, 10])
    assert change.readings == 10
    assert time_change(readings(ms), clock="wall_s").early_ms == pytest.approx(20)
    noisy = time_change(readings(np.random.default_rng(0).uniform(9, 11, 100)), clock="cpu_s")
    assert noisy.low < noisy.percent < noisy.high
    with pytest.raises(InputError, match="run for longer"):
        time_change(readings(np.ones(4)), clock="cpu_s")


def test_memory_growth():
    resident = np.full(101, 2000)
    resident[:10], resident[50], resident[-1] = 100, 2100, 2020
    end, peak = memory_growth(readings(np.ones(100), resident), since=100)
    assert (end, peak) == (pytest.approx(1.0), pytest.approx(5.0))
    with pytest.raises(InputError, match="run for longer"):
        memory_growth(readings(np.ones(5)), since=51)


def test_resident_memory_is_that_of_this_process():
    assert 10e6 < resident_bytes() < 100e9
