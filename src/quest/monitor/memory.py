"""What is remembered of a query's signals, and the features that follow: a loss shows in the course, not in a frame.

The memory is one plain array, ``N`` queries by :data:`ROWS` by ``S`` signals, so that any number of queries advance
together and a continuation is a copy. Everything in it is causal. Signals are squashed first (see
:class:`~quest.monitor.calibrator.Calibrator`); a signal that is unknown in a frame leaves its memory as it is.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float64

from quest.monitor.signals import SIGNALS

LEVEL_FRAMES: Final = 5
"""A query's normal level of a signal is its mean over the first so many frames in which it is known."""

TIME_CONSTANTS: Final = (3.0, 10.0, 30.0)
"""Of the running means, frames."""

RETURN_FRAMES: Final = 20.0
"""Time constant at which the highest and lowest values are forgotten, frames."""

OFF_LEVEL: Final = 1.0
"""A signal is off when it is farther than this from its level and from what is usual of all queries, squashed units."""

MOST_AGE: Final = 60.0
"""Frames up to which a query's age is told: calibration streams may be as short, and nothing is learned beyond."""

COUNT, LEVEL, FAST, MID, SLOW, HIGH, LOW, OFF, AGE = range(9)
"""Rows: frames known, normal level, three running means, highest and
lowest value with a slow return, frames in a row that it is off, frames since the query was bound (at most
:data:`MOST_AGE`)."""
ROWS: Final = 9

_MEANS: Final = (FAST, MID, SLOW)
_RATES: Final = 1.0 / np.array(TIME_CONSTANTS)[:, None]

FEATURES: Final = 7 * len(SIGNALS) + 1
"""Number of features per query."""


def start(count: int) -> Float64[np.ndarray, "N R S"]:
    """The memory of queries that have just been bound.

    Args:
        count: number of queries.
    """
    return np.zeros((count, ROWS, len(SIGNALS)))


def remember(
    memory: Float64[np.ndarray, "N R S"], squashed: Float64[np.ndarray, "N S"]
) -> Float64[np.ndarray, "N R S"]:
    """The memory after one more frame; the one that is given stays as it is.

    Args:
        memory: before the frame.
        squashed: signals of the frame; NaN where unknown.
    """
    known = ~np.isnan(squashed)
    value = np.where(known, squashed, 0.0)
    after = memory.copy()
    after[:, AGE] = np.minimum(memory[:, AGE] + 1.0, MOST_AGE)
    count = memory[:, COUNT] + known
    after[:, COUNT] = count
    first = count == 1.0
    # The mean of all values so far until the time constant is reached: no signal starts from zero.
    one_of = 1.0 / np.maximum(count, 1.0)
    early = known & (count <= LEVEL_FRAMES)
    level = memory[:, LEVEL] + np.where(early, one_of * (value - memory[:, LEVEL]), 0.0)
    after[:, LEVEL] = level
    means = memory[:, FAST : SLOW + 1]
    rate = np.where(known[:, None], np.maximum(_RATES, one_of[:, None]), 0.0)
    after[:, FAST : SLOW + 1] = means + rate * (value[:, None] - means)
    for row, pick in ((HIGH, np.maximum), (LOW, np.minimum)):
        back = memory[:, row] + (value - memory[:, row]) / RETURN_FRAMES
        after[:, row] = np.where(known, np.where(first, value, pick(value, back)), memory[:, row])
    off = (np.abs(value - level) > OFF_LEVEL) & (np.abs(value) > OFF_LEVEL)
    after[:, OFF] = np.where(known, np.where(off, memory[:, OFF] + 1.0, 0.0), memory[:, OFF])
    return after


def features(memory: Float64[np.ndarray, "N R S"], squashed: Float64[np.ndarray, "N S"]) -> Float64[np.ndarray, "N F"]:
    """Features of a frame: seven per signal, and how long the query has been followed.

    The normal level is not among them: with a hundred streams to learn from, it tells streams apart rather than losses.

    Args:
        memory: after the frame, from :func:`remember`.
        squashed: signals of the frame; where unknown, the fast mean stands in and an indicator says so.
    """
    missing = np.isnan(squashed)
    now = np.where(missing, memory[:, FAST], squashed)
    parts = [now, *(memory[:, row] for row in (*_MEANS, HIGH, LOW)), missing]
    return np.concatenate([*parts, 0.25 * np.log1p(memory[:, AGE, :1])], axis=1)


def with_normal(found: Float64[np.ndarray, " F"], memory: Float64[np.ndarray, "R S"]) -> Float64[np.ndarray, "S F"]:
    """Features of one query in which one signal after the other is put back to its normal level.

    Args:
        found: the features as they are.
        memory: of the query.
    """
    size = len(SIGNALS)
    normal = np.tile(found, (size, 1))
    own = np.arange(size)
    for block in range(6):
        normal[own, block * size + own] = memory[LEVEL]
    normal[own, 6 * size + own] = 0.0
    return normal


def forgive(memory: Float64[np.ndarray, "R S"]) -> Float64[np.ndarray, "R S"]:
    """The memory of one query whose identity is right again: everything but its normal level and age is forgotten."""
    after = memory.copy()
    after[FAST : LOW + 1] = memory[LEVEL]
    after[OFF] = 0.0
    return after
