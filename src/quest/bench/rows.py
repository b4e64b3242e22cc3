"""Rows of tables: pooled metrics over seeds, and how a line differs from its reference on the same answers.

An answer is one (take, view, entity) of one seed. Intervals are over objects: an object is drawn with all its takes,
views, entities and seeds. Differences pair every answer with the reference's of the same seed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quest.errors import InputError
from quest.evaluation.bootstrap import Pool
from quest.evaluation.metrics import Sums
from quest.evaluation.records import EntityRecord
from quest.evaluation.summary import TakeSuite, object_of, readings_of, record_sums

PAIRED = ("ape", "ape_2d", "d50", "d100", "acc", "switches", "slope")
"""Metrics that are compared with the reference's."""


@dataclass(frozen=True)
class Answers:
    """What one line of a table answered in one seed."""

    line: str
    seed: int
    records: tuple[EntityRecord, ...]
    reference: str | None = None
    """The line that it is compared with; None for the reference itself."""


Numbered = tuple[int, EntityRecord]


def rows_of(answers: Sequence[Answers], *, resamples: int, seed: int) -> list[dict[str, Any]]:
    """Rows per part, source, suite, level, reading and line, in the order of the lines.

    ``metrics`` are pooled over seeds, ``tracks`` count each (take, view, entity) once, ``seeds`` has every seed by
    itself, and ``difference`` is line - reference over the answers of the same seeds: None for the reference, and
    where they have no seed in common.

    Raises:
        InputError: two answers are of one line and seed, or a line and its reference were asked about different
            entities or frames.
    """
    groups: dict[tuple, dict[str, list[Numbered]]] = defaultdict(lambda: defaultdict(list))
    known: set[tuple[str, int]] = set()
    for a in answers:
        if (a.line, a.seed) in known:
            raise InputError(f"table: expected line {a.line!r}, seed {a.seed} once, got it twice")
        known.add((a.line, a.seed))
        for record in a.records:
            s, suite = record.subject, TakeSuite.of(record.take).title
            for reading in readings_of(record):
                groups[s.part, s.source, suite, s.level, reading][a.line].append((a.seed, record))
    rows = []
    for key in sorted(groups):
        for line, reference in {a.line: a.reference for a in answers}.items():
            own, other = groups[key].get(line), groups[key].get(reference or "", [])
            if own:
                head = dict(zip(("part", "source", "suite", "level", "reading"), key, strict=True))
                rows.append({"line": line, "reference": reference} | head | _row(line, own, other, resamples, seed))
    return rows


def _row(line: str, own: list[Numbered], other: list[Numbered], resamples: int, seed: int) -> dict[str, Any]:
    pool = Pool([r for _, r in own], object_of, resamples=resamples, seed=seed)
    sums, of_seed = record_sums(pool.records), np.array([s for s, _ in own])
    seeds = []
    for number in np.unique(of_seed).tolist():
        chosen = of_seed == number
        names = ("ape", "ape_2d", "d100", "acc")
        seeds.append({"seed": number} | {n: Sums(sums[n].total[chosen], sums[n].count[chosen]).mean() for n in names})
    difference = None
    if {s for s, _ in own} & {s for s, _ in other}:
        kept, gap = _paired(line, own, other)
        difference = {name: pool.of(kept).ratio(gap[name]) for name in PAIRED}
    return {
        "objects": pool.objects,
        "takes": len({r.take for r in pool.records}),
        "tracks": len({(r.take, r.view, r.entity) for r in pool.records}),
        "metrics": {name: pool.ratio(sums[name]) for name in PAIRED}
        | {"median_px": pool.median(lambda r: r.distance_px[r.counted])},
        "difference": difference,
        "seeds": seeds,
    }


def _paired(line: str, own: list[Numbered], other: list[Numbered]) -> tuple[list[EntityRecord], dict[str, Sums]]:
    """The line's records whose seed the reference has, and its differences from the reference."""
    seeds = {s for s, _ in own} & {s for s, _ in other}
    mine, theirs = ({(s, r.take, r.view, r.entity): r for s, r in each if s in seeds} for each in (own, other))
    alone = min(mine.keys() ^ theirs.keys(), default=None)
    if alone is not None:
        raise InputError(
            f"table: expected answers of {line!r} and of its reference to the same entities, got only one of "
            f"them in seed {alone[0]}, take {alone[1]!r}, view {alone[2]}, entity {alone[3]}; evaluate both again"
        )
    a, b = record_sums(list(mine.values())), record_sums([theirs[key] for key in mine])
    if not all(np.array_equal(a[name].count, b[name].count) for name in PAIRED):
        raise InputError(f"table: {line!r} and its reference were asked about different frames")
    return list(mine.values()), {name: Sums(a[name].total - b[name].total, a[name].count) for name in PAIRED}
