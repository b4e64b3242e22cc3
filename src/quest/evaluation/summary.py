"""From records to table rows: pooled metrics with intervals, in two readings."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from quest.evaluation.bootstrap import Pool, Value
from quest.evaluation.metrics import INPUT_PX, Sums, accuracy, distance_at, frame_mean, slope, switches
from quest.evaluation.records import Discovery, EntityRecord

Reading = Literal["all", "moved"]
READINGS: tuple[Reading, ...] = ("all", "moved")
STANDARD = "standard"
"""The suite of ordinary takes, which belong to none."""
_SUITE = re.compile(r"-L\d+-(?P<name>[a-z]+?)(\d*(?P<alike>alike)?|-(?P<variant>[a-z0-9-]+))-s\d+$")


@dataclass(frozen=True)
class TakeSuite:
    """The suite of the simulator that a take belongs to, read out of its name: records know no more of their take."""

    name: str
    """Such as ``occlusion`` or ``shift``, or :data:`STANDARD`."""
    look_alike: bool
    """Whether the name says that a look-alike stays in view while an entity is hidden."""
    title: str
    """The suite with its variant, such as ``shift-blur``."""

    @classmethod
    def of(cls, take: str) -> TakeSuite:
        """The suite of a take by its name, such as ``desk-102015-L1-occlusion60alike-s000000``."""
        found = _SUITE.search(take)
        if found is None:
            return cls(STANDARD, False, STANDARD)
        return cls(found["name"], found["alike"] is not None, "-".join(filter(None, found.group("name", "variant"))))


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
    median_px_vis: Value | None
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
    protocol: str
    part: str
    source: str
    level: int
    reading: Reading
    """``all`` entities or those that ``moved``."""
    objects: int
    """How many different objects."""
    takes: int
    entities: int
    """How many entities of these takes; each counts once, however many views see it."""
    tracks: int
    """How many (take, view, entity)."""
    frames: int
    """How many scored frames of these."""
    metrics: Metrics
    suite: str = STANDARD
    """Of the simulator, with its variant, such as ``noise-5``; ``standard`` for ordinary takes."""


def summarise(
    records: Sequence[EntityRecord], discoveries: Sequence[Discovery] = (), *, resamples: int, seed: int
) -> tuple[Row, ...]:
    """Rows per protocol, part, source, suite, level, reading and tracker; a reading without records has no row.

    Every row draws its resamples from a generator of its own with the same seed, so that rows over the same objects
    are resampled alike and a row does not depend on which others are there.
    """
    groups: dict[tuple, list[EntityRecord]] = defaultdict(list)
    for record in records:
        for reading in readings_of(record):
            groups[_key(record, reading)].append(record)
    found: dict[tuple, list[Discovery]] = defaultdict(list)
    for discovery in discoveries:
        found[_key(discovery, "all")].append(discovery)
    order = {tracker: i for i, tracker in enumerate(dict.fromkeys(r.subject.tracker for r in records))}
    keys = sorted(groups, key=lambda key: (*key[:-1], order[key[-1]]))
    return tuple(_row(key, groups[key], found[key], resamples=resamples, seed=seed) for key in keys)


def readings_of(record: EntityRecord) -> tuple[Reading, ...]:
    """The readings that a record is counted in."""
    return READINGS if record.moved else ("all",)


def object_of(kept: EntityRecord | Discovery) -> str:
    """Whose interval a record counts in."""
    return kept.subject.object_id


def _key(kept: EntityRecord | Discovery, reading: Reading) -> tuple:
    s = kept.subject
    return s.protocol, s.part, s.source, TakeSuite.of(kept.take).title, s.level, reading, s.tracker


def _row(key: tuple, records: list[EntityRecord], found: list[Discovery], *, resamples: int, seed: int) -> Row:
    protocol, part, source, suite, level, reading, tracker = key
    # Views in which nothing could be scored still belong to the objects that the discovery was judged on.
    pool = Pool(records, object_of, resamples=resamples, seed=seed, objects=map(object_of, found))
    views = pool.of(found)
    metrics = Metrics(
        **{name: pool.ratio(sums) for name, sums in record_sums(records).items()},
        median_px=pool.median(lambda r: r.distance_px[r.counted]),
        median_px_vis=pool.median(lambda r: r.distance_px[r.counted & r.visible]),
        recall=pool.mean(lambda r: r.found) if protocol == "semantic" else None,
        precision=views.mean(lambda d: d.matched, lambda d: d.slots),
        place_recall=views.where(lambda d: d.placed is not None).mean(lambda d: d.placed, lambda d: d.entities),
    )
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
        metrics=metrics,
        suite=suite,
    )


def record_sums(records: Sequence[EntityRecord]) -> dict[str, Sums]:
    """Sums of every averaged metric, in the order of the records; records of equal length are computed together."""
    by_length: dict[int, list[int]] = defaultdict(list)
    for i, record in enumerate(records):
        by_length[len(record.distance)].append(i)
    blocks = [_block_sums([records[i] for i in rows]) for rows in by_length.values()]
    back = np.argsort(np.concatenate(list(by_length.values())))
    return {
        name: Sums(*(np.concatenate([getattr(b[name], part) for b in blocks])[back] for part in ("total", "count")))
        for name in blocks[0]
    }


def _block_sums(records: list[EntityRecord]) -> dict[str, Sums]:
    gap = np.stack([r.distance for r in records]).astype(np.float64)
    gap_px = np.stack([r.distance_px for r in records]).astype(np.float64)
    follows = np.stack([r.follows for r in records]).astype(np.int64)
    counted, visible = (np.stack([getattr(r, name) for r in records]) for name in ("counted", "visible"))
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
