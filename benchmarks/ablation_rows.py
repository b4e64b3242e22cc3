"""Tables of variants: pooled metrics over seeds, and what a variant loses against its reference on the same answers.

An answer is one (take, view, entity) of one seed. Intervals are over objects: an object is drawn with all its takes,
views, entities and seeds. Differences pair every answer with the reference's of the same seed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quest.errors import InputError
from quest.evaluation.bootstrap import Value, draw_objects, mean_value
from quest.evaluation.metrics import Sums
from quest.evaluation.records import Discovery, EntityRecord
from quest.evaluation.summary import READINGS, Reading, precision_sums, recall_sums, record_sums
from quest.evaluation.take_suite import TakeSuite

PAIRED = ("ape", "ape_2d", "d100", "acc")
"""Metrics that are compared with the reference's."""


@dataclass(frozen=True)
class Answers:
    """What one variant answered in one seed.

    Attributes:
        variant: its name in the table.
        seed: of its training.
        records: per take, view and entity.
        discoveries: per take and view of the semantic protocol.
        reference: the variant that it is compared with; None for the reference itself.
    """

    variant: str
    seed: int
    records: tuple[EntityRecord, ...]
    discoveries: tuple[Discovery, ...] = ()
    reference: str | None = None


@dataclass(frozen=True)
class Scores:
    """Metrics of one row, or their differences (variant - reference); None where nothing was counted.

    ``docs/metrics.md`` defines them.
    """

    ape: Value | None
    ape_2d: Value | None
    d100: Value | None
    acc: Value | None
    precision: Value | None = None
    recall: Value | None = None


@dataclass(frozen=True)
class SeedScores:
    """One seed's means."""

    seed: int
    ape: float
    d100: float
    acc: float


@dataclass(frozen=True)
class AblationRow:
    """One row of a table.

    Attributes:
        variant: its name.
        protocol: ``point`` or ``semantic``.
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        suite: of the simulator, with its variant; ``standard`` for ordinary takes.
        level: how many joints move one after the other.
        reading: ``all`` entities or those that ``moved``.
        objects: how many different objects.
        takes: how many takes.
        tracks: how many (take, view, entity), each counted once however many seeds answered it.
        metrics: pooled over seeds.
        reference: what the differences are from; None for the reference itself.
        difference: variant - reference over the answers of the same seeds; None for the reference itself, and where it
            has no answers under this protocol.
        seeds: every seed by itself.
    """

    variant: str
    protocol: str
    part: str
    source: str
    suite: str
    level: int
    reading: Reading
    objects: int
    takes: int
    tracks: int
    metrics: Scores
    reference: str | None
    difference: Scores | None
    seeds: tuple[SeedScores, ...]


Key = tuple[str, str, str, str, int, str]
Numbered = tuple[int, EntityRecord]


def ablation_rows(answers: Sequence[Answers], *, resamples: int, seed: int) -> tuple[AblationRow, ...]:
    """Rows per protocol, part, source, suite, level, reading and variant, in the order of the variants.

    Args:
        answers: of all variants and seeds.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap; every row draws from a generator of its own.

    Raises:
        InputError: two answers are of one variant and seed, or a variant and its reference were asked about different
            entities or frames.
    """
    groups: dict[Key, dict[str, list[Numbered]]] = defaultdict(lambda: defaultdict(list))
    found: dict[Key, dict[str, list[Discovery]]] = defaultdict(lambda: defaultdict(list))
    references: dict[str, str | None] = {}
    known: set[tuple[str, int]] = set()
    for a in answers:
        if (a.variant, a.seed) in known:
            raise InputError(f"ablation: expected variant {a.variant!r}, seed {a.seed} once, got it twice")
        known.add((a.variant, a.seed))
        references[a.variant] = a.reference
        for record in a.records:
            for reading in READINGS:
                if reading == "all" or record.moved:
                    groups[_key(record, reading)][a.variant].append((a.seed, record))
        for discovery in a.discoveries:
            found[_key(discovery, "all")][a.variant].append(discovery)
    rows = []
    for key in sorted(groups):
        for variant, reference in references.items():
            own = groups[key].get(variant)
            if own:
                other = groups[key].get(reference) if reference else None
                rows.append(_row(key, variant, reference, own, other, found[key][variant], resamples, seed))
    return tuple(rows)


def _key(kept: EntityRecord | Discovery, reading: str) -> Key:
    s = kept.subject
    return s.protocol, s.part, s.source, TakeSuite.of(kept.take).title, s.level, reading


def _row(
    key: Key,
    variant: str,
    reference: str | None,
    own: list[Numbered],
    other: list[Numbered] | None,
    found: list[Discovery],
    resamples: int,
    seed: int,
) -> AblationRow:
    protocol, part, source, suite, level, reading = key
    records = [record for _, record in own]
    names = sorted({r.subject.object_id for r in records} | {d.subject.object_id for d in found})
    place = {name: i for i, name in enumerate(names)}
    draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))
    owner = np.array([place[r.subject.object_id] for r in records])
    sums = _sums(records)
    metrics = {name: mean_value(s, owner, draws) for name, s in sums.items()}
    if protocol == "semantic":
        metrics["recall"] = mean_value(recall_sums(records), owner, draws)
    if found:
        of = np.array([place[d.subject.object_id] for d in found])
        metrics["precision"] = mean_value(precision_sums(found), of, draws)
    difference = None
    if other and {s for s, _ in own} & {s for s, _ in other}:
        kept, gap = _paired(variant, own, other)
        owner = np.array([place[r.subject.object_id] for r in kept])
        difference = Scores(**{name: mean_value(gap[name], owner, draws) for name in PAIRED})
    return AblationRow(
        variant=variant,
        protocol=protocol,
        part=part,
        source=source,
        suite=suite,
        level=level,
        reading="moved" if reading == "moved" else "all",
        objects=len({r.subject.object_id for r in records}),
        takes=len({r.take for r in records}),
        tracks=len({(r.take, r.view, r.entity) for r in records}),
        metrics=Scores(**metrics),
        reference=reference,
        difference=difference,
        seeds=_per_seed(own, sums),
    )


def _sums(records: Sequence[EntityRecord]) -> dict[str, Sums]:
    sums = record_sums(records)
    return {name: sums[name] for name in PAIRED}


def _paired(variant: str, own: list[Numbered], other: list[Numbered]) -> tuple[list[EntityRecord], dict[str, Sums]]:
    """The variant's records whose seed the reference has, and its differences from the reference."""
    seeds = {s for s, _ in own} & {s for s, _ in other}
    mine = {(s, r.take, r.view, r.entity): r for s, r in own if s in seeds}
    theirs = {(s, r.take, r.view, r.entity): r for s, r in other if s in seeds}
    alone = min(mine.keys() ^ theirs.keys(), default=None)
    if alone is not None:
        raise InputError(
            f"ablation: expected answers of {variant!r} and of its reference to the same entities, got only one of "
            f"them in seed {alone[0]}, take {alone[1]!r}, view {alone[2]}, entity {alone[3]}; evaluate both again"
        )
    a, b = _sums(list(mine.values())), _sums([theirs[key] for key in mine])
    for name in PAIRED:
        if not np.array_equal(a[name].count, b[name].count):
            raise InputError(f"ablation: {variant!r} and its reference were asked about different frames")
    return list(mine.values()), {name: Sums(a[name].total - b[name].total, a[name].count) for name in PAIRED}


def _per_seed(own: list[Numbered], sums: dict[str, Sums]) -> tuple[SeedScores, ...]:
    seed = np.array([s for s, _ in own])

    def mean(name: str, chosen: np.ndarray) -> float:
        return Sums(sums[name].total[chosen], sums[name].count[chosen]).mean()

    return tuple(
        SeedScores(int(s), *(mean(name, seed == s) for name in ("ape", "d100", "acc"))) for s in np.unique(seed)
    )
