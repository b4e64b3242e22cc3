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
    """Upper end of the interval."""
    count: int
    """How many terms (frames, records or slots) it is over."""


R = TypeVar("R")


class Pool(Generic[R]):
    """Records of one row of a table; every statistic of them has its interval over objects.

    Args:
        records: what is pooled.
        object_of: the object of a record.
        resamples: of the bootstrap.
        seed: of the bootstrap; pools over the same objects are resampled alike.
        objects: objects that count though they may have no record.
    """

    def __init__(
        self,
        records: Iterable[R],
        object_of: Callable[[Any], str],
        *,
        resamples: int,
        seed: int,
        objects: Iterable[str] = (),
    ) -> None:
        self.records: Sequence[R] = list(records)
        self._object_of = object_of
        names = sorted({*map(object_of, self.records), *objects})
        self._index = {name: i for i, name in enumerate(names)}
        self._draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))

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

    def ratio(self, sums: Sums) -> Value | None:
        """The pooled mean of sums per record; None where nothing was counted."""
        return mean_value(sums, self.owner, self._draws)

    def mean(self, total: Callable[[R], float], count: Callable[[R], float] = lambda record: 1.0) -> Value | None:
        """The mean of a value of each record, or of the sum and number of several; None where nothing was counted."""
        terms = np.array([(total(record), count(record)) for record in self.records], np.float64).reshape(-1, 2)
        return self.ratio(Sums(terms[:, 0], terms[:, 1]))

    def median(self, values: Callable[[R], Any]) -> Value | None:
        """The median of a value or an array of values of each record, NaN left out; None without any."""
        parts = [np.atleast_1d(np.asarray(values(record), dtype=np.float64)) for record in self.records]
        owner = np.repeat(self.owner, [len(part) for part in parts])
        return median_value(np.concatenate([np.zeros(0), *parts]), owner, self._draws)


def draw_objects(objects: int, *, resamples: int, generator: np.random.Generator) -> Int[np.ndarray, "B O"]:
    """How often each object is drawn in each resample of as many objects."""
    return generator.multinomial(objects, np.full(objects, 1.0 / objects), size=resamples)


def mean_value(sums: Sums, object_of: Int[np.ndarray, " N"], draws: Int[np.ndarray, "B O"]) -> Value | None:
    """The pooled mean and its interval; None where nothing was counted.

    Args:
        sums: per record.
        object_of: object index per record, below O.
        draws: from :func:`draw_objects`.
    """
    if sums.count.sum() == 0:
        return None
    size = draws.shape[1]
    total = draws @ np.bincount(object_of, weights=sums.total, minlength=size)
    count = draws @ np.bincount(object_of, weights=sums.count, minlength=size)
    with_terms = count > 0  # a resample may hold only objects to which the metric does not apply
    low, high = _percentiles(total[with_terms] / count[with_terms], objects=objects_with_terms(sums, object_of))
    return Value(sums.mean(), low, high, int(sums.count.sum()))


def median_value(
    value: Float[np.ndarray, " M"], object_of: Int[np.ndarray, " M"], draws: Int[np.ndarray, "B O"]
) -> Value | None:
    """The median of pooled terms and its interval; None without terms. NaN terms are left out."""
    known = ~np.isnan(value)
    value, object_of = value[known], object_of[known]
    if not len(value):
        return None
    order = np.argsort(value, kind="stable")
    ordered, owner = value[order], object_of[order]
    medians = []
    for drawn in draws:
        below = np.cumsum(drawn[owner])
        if half := 0.5 * below[-1]:
            middle = [np.searchsorted(below, half), np.searchsorted(below, half, side="right")]
            medians.append(ordered[middle].mean())
    low, high = _percentiles(np.array(medians), objects=len(np.unique(owner)))
    return Value(float(np.median(value)), low, high, len(value))


def statistic_value(
    statistic: Callable[[Int[np.ndarray, " O"]], float], draws: Int[np.ndarray, "B O"], *, count: int
) -> Value | None:
    """A statistic that is no mean or median, and its interval; None where it is NaN.

    Args:
        statistic: of how often each object is drawn; NaN where it does not apply.
        draws: from :func:`draw_objects`.
        count: how many terms it is over.
    """
    objects = draws.shape[1]
    whole = statistic(np.ones(objects, dtype=draws.dtype))
    if np.isnan(whole):
        return None
    drawn = np.array([statistic(times) for times in draws])
    low, high = _percentiles(drawn[~np.isnan(drawn)], objects=objects)
    return Value(float(whole), low, high, count)


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
    low, high = np.quantile(statistic(units[draws]), _ENDS)
    return Value(float(statistic(units)), float(low), float(high), len(units))


def objects_with_terms(sums: Sums, object_of: Int[np.ndarray, " N"]) -> int:
    """How many objects have anything that a metric counts."""
    return len(np.unique(object_of[sums.count > 0]))


def _percentiles(samples: np.ndarray, *, objects: int) -> tuple[float | None, float | None]:
    if objects < 2 or not len(samples):
        return None, None
    low, high = np.quantile(samples, _ENDS)
    return float(low), float(high)
