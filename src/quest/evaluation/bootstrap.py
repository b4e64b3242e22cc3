"""Intervals: 95 % bootstrap over objects, the unit that a new user's object is drawn from.

Reference: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13 (percentile intervals).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float, Int

from quest.evaluation.metrics import Sums

LEVEL = 0.95
_ENDS = ((1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0)


@dataclass(frozen=True)
class Value:
    """A number with its interval."""

    mean: float
    """The metric (a median where its name says so)."""
    low: float | None
    """Lower end of the 95 % interval; None with terms of fewer than two objects."""
    high: float | None
    count: int
    """How many terms (frames, records or slots) it is over."""


R = TypeVar("R")


class Pool(Generic[R]):
    """Records of one row of a table; every statistic of them has its interval over objects.

    Args:
        records: what is pooled.
        object_of: the object of a record; by default each record is one of its own.
        resamples: of the bootstrap.
        seed: of the bootstrap; pools over the same objects are resampled alike.
        objects: objects that count though they may have no record.
    """

    def __init__(
        self,
        records: Iterable[R],
        object_of: Callable[[Any], Any] | None = None,
        *,
        resamples: int,
        seed: int,
        objects: Iterable[Any] = (),
    ) -> None:
        self.records: Sequence[R] = list(records)
        numbers = {id(record): i for i, record in enumerate(self.records)}
        self._object_of = object_of or (lambda record: numbers[id(record)])
        names = sorted({*map(self._object_of, self.records), *objects})
        self._index = {name: i for i, name in enumerate(names)}
        share, rng = np.full(len(names), 1.0 / len(names)), np.random.default_rng(seed)
        self.draws: Int[np.ndarray, "B O"] = rng.multinomial(len(names), share, size=resamples)
        """How often each object is drawn in each resample of as many objects."""

    @property
    def objects(self) -> int:
        """How many objects the records are of."""
        return len({self._object_of(record) for record in self.records})

    @property
    def owner(self) -> Int[np.ndarray, " N"]:
        """Index of each record's object."""
        return np.array([self._index[self._object_of(record)] for record in self.records], dtype=int)

    def of(self, records: Iterable[Any]) -> Pool[Any]:
        """Other records of the same objects, such as some of these, with the same resamples."""
        other = object.__new__(Pool)
        other.__dict__ |= self.__dict__ | {"records": list(records)}
        return other

    def where(self, chosen: Callable[[R], object]) -> Pool[R]:
        """Those of the records for which something is true."""
        return self.of(filter(chosen, self.records))

    def mean(self, total: Callable[[R], float], count: Callable[[R], float] = lambda record: 1.0) -> Value | None:
        """The mean of a value of each record, or of the sum and number of several; None where nothing was counted."""
        terms = np.array([(total(record), count(record)) for record in self.records], np.float64).reshape(-1, 2)
        return self.ratio(Sums(terms[:, 0], terms[:, 1]))

    def ratio(self, sums: Sums) -> Value | None:
        """The pooled mean of sums per record; None where nothing was counted."""
        if sums.count.sum() == 0:
            return None
        owner, size = self.owner, self.draws.shape[1]
        total = self.draws @ np.bincount(owner, weights=sums.total, minlength=size)
        count = self.draws @ np.bincount(owner, weights=sums.count, minlength=size)
        with_terms = count > 0  # a resample may hold only objects to which the metric does not apply
        samples = total[with_terms] / count[with_terms]
        return _value(sums.mean(), samples, int(sums.count.sum()), objects=len(np.unique(owner[sums.count > 0])))

    def median(self, values: Callable[[R], Any]) -> Value | None:
        """The median of a value or an array of values of each record, NaN left out; None without any."""
        parts = [np.atleast_1d(np.asarray(values(record), dtype=np.float64)) for record in self.records]
        value, owner = np.concatenate([np.zeros(0), *parts]), np.repeat(self.owner, [len(part) for part in parts])
        value, owner = value[~np.isnan(value)], owner[~np.isnan(value)]
        if not len(value):
            return None
        order = np.argsort(value, kind="stable")
        ordered, owner = value[order], owner[order]
        medians = []
        for drawn in self.draws:
            below = np.cumsum(drawn[owner])
            if half := 0.5 * below[-1]:
                middle = [np.searchsorted(below, half), np.searchsorted(below, half, side="right")]
                medians.append(ordered[middle].mean())
        return _value(float(np.median(value)), np.array(medians), len(value), objects=len(np.unique(owner)))

    def statistic(self, statistic: Callable[[Int[np.ndarray, " O"]], float], *, count: int) -> Value | None:
        """Another statistic, of how often each object is drawn, over so many terms; None where it is NaN."""
        objects = self.draws.shape[1]
        whole = statistic(np.ones(objects, dtype=self.draws.dtype))
        if np.isnan(whole):
            return None
        samples = np.array([statistic(times) for times in self.draws])
        return _value(float(whole), samples[~np.isnan(samples)], count, objects=objects)


def interval_over(
    units: Float[np.ndarray, "N ..."],
    statistic: Callable[[np.ndarray], np.ndarray],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> Value:
    """A statistic of units that are alike, such as the turns of a timing, with its interval over them.

    Args:
        units: what is drawn from, along the first axis.
        statistic: of one resample, or of many along axes ahead of those of ``units``.
        resamples: how often as many units are drawn.
        seed: of the draws.
    """
    draws = np.random.default_rng(seed).integers(len(units), size=(resamples, len(units)))
    return _value(float(statistic(units)), statistic(units[draws]), len(units), objects=2)


def _value(mean: float, samples: np.ndarray, count: int, *, objects: int) -> Value:
    """A number with the interval of its samples, which says nothing where terms are of fewer than two objects."""
    if objects < 2 or not len(samples):
        return Value(mean, None, None, count)
    low, high = np.quantile(samples, _ENDS)
    return Value(mean, float(low), float(high), count)
