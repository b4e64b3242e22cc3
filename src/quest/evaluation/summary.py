"""From records to table rows: pooled metrics with intervals, in two readings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from quest.evaluation.bootstrap import Pool, Value
from quest.evaluation.metrics import INPUT_PX, Sums, accuracy, distance_at, frame_mean, slope, switches
from quest.evaluation.records import Discovery, EntityRecord
from quest.evaluation.take_suite import STANDARD, TakeSuite

Reading = Literal["all", "moved"]
READINGS: tuple[Reading, ...] = ("all", "moved")


@dataclass(frozen=True)
class Metrics:
    """The metrics of one row; None where nothing was counted. ``docs/metrics.md`` defines them."""

    ape: Value | None
    """Mean 3D distance, normalised units."""
    ape_vis: Value | None
    """The same on visible frames."""
    ape_px: Value | None
    """Mean pixel distance, pixels of the letterboxed input."""
    ape_2d: Value | None
    """Mean distance in [0, 1]^2 coordinates of the letterboxed input."""
    median_px: Value | None
    """Median pixel distance."""
    median_px_vis: Value | None
    """Median pixel distance on visible frames."""
    d50: Value | None
    """3D distance at half of the take."""
    d100: Value | None
    """3D distance at its end."""
    acc: Value | None
    """Share of frames with the right identity."""
    switches: Value | None
    """Changes of identity per 1,000 frames."""
    slope: Value | None
    """Growth of the 3D distance per 100 frames."""
    precision: Value | None = None
    """Share of the tracker's own discoveries that are entities (semantic, reading ``all``)."""
    recall: Value | None = None
    """Share of the entities that were discovered (semantic)."""
    place_recall: Value | None = None
    """The same if labels do not count (semantic, reading ``all``)."""


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    tracker: str
    """Its name."""
    protocol: str
    """``point`` or ``semantic``."""
    part: str
    """Part of the object split."""
    source: str
    """As of :class:`quest.types.TakeInfo`."""
    level: int
    """How many joints move one after the other."""
    reading: Reading
    """``all`` entities or those that ``moved``."""
    objects: int
    """How many different objects."""
    takes: int
    """How many takes."""
    entities: int
    """How many entities of these takes; each counts once, however many views see it."""
    tracks: int
    """How many (take, view, entity)."""
    frames: int
    """How many scored frames of these."""
    metrics: Metrics
    """The numbers."""
    suite: str = STANDARD
    """Of the simulator, with its variant, such as ``noise-5``; ``standard`` for ordinary takes."""


def summarise(
    records: Sequence[EntityRecord],
    discoveries: Sequence[Discovery] = (),
    *,
    resamples: int,
    seed: int,
) -> tuple[Row, ...]:
    """Rows per protocol, part, source, suite, level, reading and tracker; a reading without records has no row.

    Every row draws its resamples from a generator of its own with the same seed, so that rows over the same objects
    are resampled alike and a row does not depend on which others are there.

    Args:
        records: of any number of trackers.
        discoveries: of the semantic protocol.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap.
    """
    groups: dict[tuple, list[EntityRecord]] = defaultdict(list)
    for record in records:
        for reading in READINGS:
            if reading == "all" or record.moved:
                groups[_key(record, reading)].append(record)
    slots: dict[tuple, list[Discovery]] = defaultdict(list)
    for found in discoveries:
        slots[_key(found, "all")].append(found)
    order = {tracker: i for i, tracker in enumerate(dict.fromkeys(r.subject.tracker for r in records))}
    keys = sorted(groups, key=lambda key: (*key[:-1], order[key[-1]]))
    return tuple(_row(key, groups[key], slots[key], resamples=resamples, seed=seed) for key in keys)


def _key(kept: EntityRecord | Discovery, reading: Reading) -> tuple:
    s = kept.subject
    return s.protocol, s.part, s.source, TakeSuite.of(kept.take).title, s.level, reading, s.tracker


def _row(key: tuple, records: list[EntityRecord], found: list[Discovery], *, resamples: int, seed: int) -> Row:
    protocol, part, source, suite, level, reading, tracker = key
    # Views in which nothing could be scored still belong to the objects that the discovery was judged on.
    pool = Pool(records, _object_of, resamples=resamples, seed=seed, objects=map(_object_of, found))
    return Row(
        tracker=tracker,
        protocol=protocol,
        part=part,
        source=source,
        level=level,
        reading=reading,
        objects=pool.objects,
        takes=len({r.take for r in records}),
        entities=len({(r.take, r.entity) for r in records}),
        tracks=len(records),
        frames=sum(len(r.distance) - r.first_frame for r in records),
        metrics=_metrics(pool, found, semantic=protocol == "semantic"),
        suite=suite,
    )


def _object_of(kept: EntityRecord | Discovery) -> str:
    return kept.subject.object_id


def _metrics(pool: Pool[EntityRecord], found: list[Discovery], *, semantic: bool) -> Metrics:
    values = {name: pool.ratio(sums) for name, sums in record_sums(pool.records).items()}
    for name, visible_only in (("median_px", False), ("median_px_vis", True)):
        values[name] = pool.median(lambda r, vis=visible_only: r.distance_px[_counted(r, visible_only=vis)])
    return Metrics(**values, **discovery_values(pool, found, semantic=semantic))


def discovery_values(
    pool: Pool[EntityRecord], found: Sequence[Discovery], *, semantic: bool
) -> dict[str, Value | None]:
    """Recall of the entities, precision of the discoveries, and recall if labels do not count."""
    views = pool.of(found)
    counted = views.where(lambda d: d.placed is not None)
    return {
        "recall": pool.mean(lambda r: r.found) if semantic else None,
        "precision": views.mean(lambda d: d.matched, lambda d: d.slots),
        "place_recall": counted.mean(lambda d: d.placed, lambda d: d.entities),
    }


def _counted(record: EntityRecord, *, visible_only: bool = False) -> np.ndarray:
    counted = np.arange(len(record.distance)) >= record.first_frame
    return counted & record.visible if visible_only else counted


def record_sums(records: Sequence[EntityRecord]) -> dict[str, Sums]:
    """Sums of every averaged metric, in the order of the records; records of equal length are computed together."""
    by_length: dict[int, list[int]] = defaultdict(list)
    for i, record in enumerate(records):
        by_length[len(record.distance)].append(i)
    parts: dict[str, list[Sums]] = defaultdict(list)
    for rows in by_length.values():
        for name, sums in _block_sums([records[i] for i in rows]).items():
            parts[name].append(sums)
    back = np.argsort(np.concatenate(list(by_length.values())))
    return {
        name: Sums(np.concatenate([s.total for s in blocks])[back], np.concatenate([s.count for s in blocks])[back])
        for name, blocks in parts.items()
    }


def _block_sums(records: list[EntityRecord]) -> dict[str, Sums]:
    gap = np.stack([r.distance for r in records]).astype(np.float64)
    gap_px = np.stack([r.distance_px for r in records]).astype(np.float64)
    follows = np.stack([r.follows for r in records]).astype(np.int64)
    visible = np.stack([r.visible for r in records])
    counted = np.stack([_counted(r) for r in records])
    own = np.array([r.entity for r in records])
    return {
        "ape": frame_mean(gap, counted),
        "ape_vis": frame_mean(gap, counted & visible),
        "ape_px": frame_mean(gap_px, counted),
        "ape_2d": frame_mean(gap_px / INPUT_PX, counted),
        "d50": distance_at(gap, 0.5, counted),
        "d100": distance_at(gap, 1.0, counted),
        "acc": accuracy(follows, own, counted),
        "switches": switches(follows, own, counted),
        "slope": slope(gap, counted),
    }
