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
from quest.evaluation.summary import READINGS, record_sums
from quest.evaluation.take_suite import TakeSuite

PAIRED = ("ape", "ape_2d", "d50", "d100", "acc", "switches", "slope")
"""Metrics that are compared with the reference's."""


@dataclass(frozen=True)
class Answers:
    """What one line of a table answered in one seed."""

    line: str
    """Its name in the table."""
    seed: int
    """Of its training."""
    records: tuple[EntityRecord, ...]
    """Per take, view and entity."""
    reference: str | None = None
    """The line that it is compared with; None for the reference itself."""


Key = tuple[str, str, str, int, str]
Numbered = tuple[int, EntityRecord]


def rows_of(answers: Sequence[Answers], *, resamples: int, seed: int) -> list[dict[str, Any]]:
    """Rows per part, source, suite, level, reading and line, in the order of the lines.

    ``metrics`` are pooled over seeds, ``tracks`` count each (take, view, entity) once, ``seeds`` has every seed by
    itself, and ``difference`` is line - reference over the answers of the same seeds: None for the reference, and
    where they have no seed in common.

    Args:
        answers: of all lines and seeds.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap; every row draws from a generator of its own.

    Raises:
        InputError: two answers are of one line and seed, or a line and its reference were asked about different
            entities or frames.
    """
    groups: dict[Key, dict[str, list[Numbered]]] = defaultdict(lambda: defaultdict(list))
    references: dict[str, str | None] = {}
    known: set[tuple[str, int]] = set()
    for a in answers:
        if (a.line, a.seed) in known:
            raise InputError(f"table: expected line {a.line!r}, seed {a.seed} once, got it twice")
        known.add((a.line, a.seed))
        references[a.line] = a.reference
        for record in a.records:
            for reading in READINGS:
                if reading == "all" or record.moved:
                    groups[_key(record, reading)][a.line].append((a.seed, record))
    rows = []
    for key in sorted(groups):
        for line, reference in references.items():
            own, other = groups[key].get(line), groups[key].get(reference or "")
            if own:
                head = dict(zip(("part", "source", "suite", "level", "reading"), key, strict=True))
                rows.append({"line": line, "reference": reference} | head | _row(line, own, other, resamples, seed))
    return rows


def _key(record: EntityRecord, reading: str) -> Key:
    s = record.subject
    return s.part, s.source, TakeSuite.of(record.take).title, s.level, reading


def _row(line: str, own: list[Numbered], other: list[Numbered] | None, resamples: int, seed: int) -> dict[str, Any]:
    pool = Pool([r for _, r in own], lambda r: r.subject.object_id, resamples=resamples, seed=seed)
    sums, of_seed = _sums(pool.records), np.array([s for s, _ in own])
    seeds = []
    for number in np.unique(of_seed).tolist():
        chosen = of_seed == number
        means = {name: Sums(s.total[chosen], s.count[chosen]).mean() for name, s in sums.items()}
        seeds.append({"seed": number} | {name: means[name] for name in ("ape", "ape_2d", "d100", "acc")})
    difference = None
    if other and set(of_seed.tolist()) & {s for s, _ in other}:
        kept, gap = _paired(line, own, other)
        difference = {name: pool.of(kept).ratio(gap[name]) for name in PAIRED}
    return {
        "objects": pool.objects,
        "takes": len({r.take for r in pool.records}),
        "tracks": len({(r.take, r.view, r.entity) for r in pool.records}),
        "metrics": {name: pool.ratio(s) for name, s in sums.items()}
        | {"median_px": pool.median(lambda r: r.distance_px[r.first_frame :])},
        "difference": difference,
        "seeds": seeds,
    }


def _sums(records: Sequence[EntityRecord]) -> dict[str, Sums]:
    sums = record_sums(records)
    return {name: sums[name] for name in PAIRED}


def _paired(line: str, own: list[Numbered], other: list[Numbered]) -> tuple[list[EntityRecord], dict[str, Sums]]:
    """The line's records whose seed the reference has, and its differences from the reference."""
    seeds = {s for s, _ in own} & {s for s, _ in other}
    mine = {(s, r.take, r.view, r.entity): r for s, r in own if s in seeds}
    theirs = {(s, r.take, r.view, r.entity): r for s, r in other if s in seeds}
    alone = min(mine.keys() ^ theirs.keys(), default=None)
    if alone is not None:
        raise InputError(
            f"table: expected answers of {line!r} and of its reference to the same entities, got only one of "
            f"them in seed {alone[0]}, take {alone[1]!r}, view {alone[2]}, entity {alone[3]}; evaluate both again"
        )
    a, b = _sums(list(mine.values())), _sums([theirs[key] for key in mine])
    for name in PAIRED:
        if not np.array_equal(a[name].count, b[name].count):
            raise InputError(f"table: {line!r} and its reference were asked about different frames")
    return list(mine.values()), {name: Sums(a[name].total - b[name].total, a[name].count) for name in PAIRED}
