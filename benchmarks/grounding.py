"""Compare grounding switched on with grounding switched off, on the same frames of one run of `quest eval`.

    quest eval --takes STORE --trackers quest quest-ungrounded --out RUN.json
    python benchmarks/grounding.py RUN.records.parquet --out benchmarks/results/grounding/grounding.json

Moved entities only. A frame is well seen where its entity is visible in it and in the two frames before and after, and
the tracker without grounding follows the right entity. Frames that are chosen by the success of one tracker favour it,
so that the test is a hard one for grounding. Below zero is better for differences, below one for ratios. Both trackers
answer the same queries, so that ratios and differences are taken frame by frame and resampled together, object by
object.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Bool, Int
from rich import box
from rich.console import Console
from rich.table import Table

from quest.errors import InputError
from quest.evaluation.bootstrap import Value, draw_objects, mean_value, objects_with_terms
from quest.evaluation.metrics import Sums
from quest.evaluation.records import EntityRecord
from quest.evaluation.report import gather, origins_json, provenance, shown, write_report
from quest.evaluation.take_suite import TakeSuite

AROUND_FRAMES = 2
"""An entity is well seen if it is visible in so many frames before and after, too."""

MARGIN = 0.01
"""A frame is worse, or better, if the distances differ by more than this, normalised units."""

LEAST_OBJECTS = 6
"""With fewer objects nothing is decided: five that agree by chance are no rarer than one in sixteen (sign test)."""

Verdict = Literal["not higher", "higher", "undecided"]


@dataclass(frozen=True)
class Pair:
    """The answers of both trackers to one entity in one view.

    Attributes:
        on: of the tracker that is judged.
        off: of the one that it is compared with.
    """

    on: EntityRecord
    off: EntityRecord

    @property
    def scored(self) -> Bool[np.ndarray, " T"]:
        """Frames that count."""
        return np.arange(len(self.on.distance)) >= self.on.first_frame

    @property
    def well_seen(self) -> Bool[np.ndarray, " T"]:
        """Scored frames in and around which the entity is visible, and in which the tracker without is right."""
        return self.scored & seen_around(self.on.visible) & (self.off.follows == self.off.entity)


@dataclass(frozen=True)
class Compared:
    """A mean distance of both trackers over the same frames; None where there are none.

    Attributes:
        on: of the tracker that is judged.
        off: of the one that it is compared with.
        ratio: of the two means, on / off.
        difference: on - off.
    """

    on: Value | None
    off: Value | None
    ratio: Value | None
    difference: Value | None


@dataclass(frozen=True)
class PairedRow:
    """Moved entities of one kind.

    Attributes:
        protocol: ``point`` or ``semantic``.
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        level: how many joints move one after the other.
        suite: of the simulator.
        objects: how many.
        takes: how many.
        tracks: how many (take, view, entity).
        ape: over all scored frames.
        visible: over those in which the entity is visible.
        well_seen: over those of :attr:`Pair.well_seen`.
        worse: share of the well-seen frames in which the judged tracker is farther off by more than :data:`MARGIN`.
        better: share in which it is nearer by more than that.
        astray: share in which it follows another entity, or none.
        worst_object: the object with the greatest mean difference over its well-seen frames; None without any.
        worst_difference: that difference.
        verdict: of :func:`judge`, on the difference over well-seen frames.
    """

    protocol: str
    part: str
    source: str
    level: int
    suite: str
    objects: int
    takes: int
    tracks: int
    ape: Compared
    visible: Compared
    well_seen: Compared
    worse: Value | None
    better: Value | None
    astray: Value | None
    worst_object: str | None
    worst_difference: float | None
    verdict: Verdict


def compare(records: Sequence[EntityRecord], *, on: str, off: str, resamples: int, seed: int) -> tuple[PairedRow, ...]:
    """Rows of moved entities per protocol, part, source, level and suite.

    Args:
        records: of both trackers, and maybe of others.
        on: the tracker that is judged.
        off: the one that it is compared with.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap; every row draws from a generator of its own.

    Raises:
        InputError: an answer of one tracker lacks its counterpart, or they are of different runs.
    """
    groups: dict[tuple, list[Pair]] = defaultdict(list)
    for pair in pair_up(records, on=on, off=off):
        s = pair.on.subject
        if pair.on.moved:
            groups[(s.protocol, s.part, s.source, s.level, TakeSuite.of(pair.on.take).name)].append(pair)
    return tuple(_row(key, groups[key], resamples=resamples, seed=seed) for key in sorted(groups))


def pair_up(records: Sequence[EntityRecord], *, on: str, off: str) -> tuple[Pair, ...]:
    """The answers of two trackers to the same entities in the protocols that both have, in the judged one's order.

    Raises:
        InputError: as :func:`compare`.
    """
    sides: dict[str, dict[tuple, EntityRecord]] = {on: {}, off: {}}
    for record in records:
        if record.subject.tracker in sides:
            key = (record.subject.protocol, record.take, record.view, record.entity)
            sides[record.subject.tracker][key] = record
    both = {key[0] for key in sides[on]} & {key[0] for key in sides[off]}
    sides = {name: {k: r for k, r in side.items() if k[0] in both} for name, side in sides.items()}
    alone = sides[on].keys() ^ sides[off].keys()
    if alone or not both:
        protocol, take, view, entity = min(alone, default=("any protocol", "any", 0, 0))
        raise InputError(
            f"records: expected answers of {on!r} and {off!r} to the same entities, got only one of them in take "
            f"{take!r}, view {view}, entity {entity} ({protocol}); run `quest eval --trackers {on} {off}`"
        )
    pairs = tuple(Pair(record, sides[off][key]) for key, record in sides[on].items())
    for pair in pairs:
        a, b = pair.on, pair.off
        if a.first_frame != b.first_frame or not np.array_equal(a.visible, b.visible):
            raise InputError(
                f"records: {on!r} and {off!r} saw different frames of take {a.take!r}, view {a.view}, entity "
                f"{a.name!r}; evaluate both in one run of `quest eval`"
            )
    return pairs


def seen_around(visible: Bool[np.ndarray, " T"], frames: int = AROUND_FRAMES) -> Bool[np.ndarray, " T"]:
    """Frames in which an entity is visible, as in so many before and after; beyond the clip's ends nothing is asked."""
    padded = np.pad(visible, frames, constant_values=True)
    return np.logical_and.reduce(np.lib.stride_tricks.sliding_window_view(padded, 2 * frames + 1), axis=1)


def judge(difference: Value | None, *, objects: int) -> Verdict:
    """Whether a difference of distances is shown to be above zero, or not to be.

    Args:
        difference: with its interval over objects.
        objects: how many it is over; fewer than :data:`LEAST_OBJECTS` decide nothing.
    """
    if objects < LEAST_OBJECTS or difference is None or difference.low is None or difference.high is None:
        return "undecided"
    return "not higher" if difference.high <= 0 else "higher" if difference.low > 0 else "undecided"


def _row(key: tuple, pairs: list[Pair], *, resamples: int, seed: int) -> PairedRow:
    names = sorted({p.on.subject.object_id for p in pairs})
    draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))
    owner = np.array([names.index(p.on.subject.object_id) for p in pairs])
    scored, well_seen = [p.scored for p in pairs], [p.well_seen for p in pairs]
    visible = [s & p.on.visible for s, p in zip(scored, pairs, strict=True)]
    gaps = [p.on.distance.astype(np.float64) - p.off.distance for p in pairs]

    def share(flags: list[np.ndarray]) -> Value | None:
        return mean_value(_sums(flags, well_seen), owner, draws)

    compared = _compared(pairs, well_seen, owner, draws)
    worst, difference = _worst(names, owner, _sums(gaps, well_seen))
    protocol, part, source, level, suite = key
    return PairedRow(
        protocol=protocol,
        part=part,
        source=source,
        level=level,
        suite=suite,
        objects=len(names),
        takes=len({p.on.take for p in pairs}),
        tracks=len(pairs),
        ape=_compared(pairs, scored, owner, draws),
        visible=_compared(pairs, visible, owner, draws),
        well_seen=compared,
        worse=share([gap > MARGIN for gap in gaps]),
        better=share([gap < -MARGIN for gap in gaps]),
        astray=share([p.on.follows != p.on.entity for p in pairs]),
        worst_object=worst,
        worst_difference=difference,
        verdict=judge(compared.difference, objects=objects_with_terms(_sums(gaps, well_seen), owner)),
    )


def _compared(
    pairs: list[Pair], frames: list[np.ndarray], owner: Int[np.ndarray, " N"], draws: Int[np.ndarray, "B O"]
) -> Compared:
    on = _sums([p.on.distance for p in pairs], frames)
    off = _sums([p.off.distance for p in pairs], frames)
    ratio = mean_value(Sums(on.total, off.total), owner, draws)
    return Compared(
        on=mean_value(on, owner, draws),
        off=mean_value(off, owner, draws),
        ratio=None if ratio is None else replace(ratio, count=int(on.count.sum())),
        difference=mean_value(Sums(on.total - off.total, on.count), owner, draws),
    )


def _sums(values: list[np.ndarray], frames: list[np.ndarray]) -> Sums:
    """Sums over some frames of each record."""
    total = [v[f].sum(dtype=np.float64) for v, f in zip(values, frames, strict=True)]
    return Sums(np.array(total), np.array([f.sum() for f in frames], dtype=np.float64))


def _worst(names: list[str], owner: Int[np.ndarray, " N"], gap: Sums) -> tuple[str | None, float | None]:
    total, count = (np.bincount(owner, weights=w, minlength=len(names)) for w in (gap.total, gap.count))
    if not count.any():
        return None, None
    mean = np.where(count > 0, total / np.maximum(count, 1.0), -np.inf)
    return names[int(mean.argmax())], float(mean.max())


@dataclass(frozen=True)
class Grounding:
    """Distances with and without grounding, paired, with intervals over objects."""

    records: tyro.conf.Positional[tuple[Path, ...]]
    """Files of records (.records.parquet)."""
    on: str = "quest"
    """The tracker with grounding."""
    off: str = "quest-ungrounded"
    """The tracker without."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Compare, print, write."""
        records, origins = gather(self.records)
        rows = compare(records, on=self.on, off=self.off, resamples=self.resamples, seed=self.seed)
        Console(width=215).print(_table(rows))
        if self.out is not None:
            report = provenance() | {
                "on": self.on,
                "off": self.off,
                "around_frames": AROUND_FRAMES,
                "margin": MARGIN,
                "resamples": self.resamples,
                "seed": self.seed,
                "origins": origins_json(origins),
                "rows": [asdict(row) for row in rows],
            }
            write_report(report, self.out)
        return 0


def _table(rows: tuple[PairedRow, ...]) -> Table:
    table = Table(
        title="moved entities, distance with / without grounding, normalised units; 95 % bootstrap over objects",
        box=box.SIMPLE_HEAD,
        caption=f"worse, better: share of well-seen frames that differ by more than {MARGIN}; n: objects/takes/tracks",
    )
    headings = ("objects", "L", "suite", "n", "APE on/off", "ratio", "visible on/off", "well-seen on/off")
    for heading in (*headings, "difference", "worse %", "better %", "well-seen is"):
        table.add_column(heading, justify="left" if heading in ("objects", "suite") else "right")
    for row in rows:
        pairs = [f"{shown(c.on).split()[0]}/{shown(c.off).split()[0]}" for c in (row.ape, row.visible, row.well_seen)]
        table.add_row(
            f"{row.source}, {row.part}, {row.protocol}",
            str(row.level),
            row.suite,
            f"{row.objects}/{row.takes}/{row.tracks}",
            pairs[0],
            shown(row.ape.ratio, decimals=2),
            pairs[1],
            pairs[2],
            shown(row.well_seen.difference, decimals=4),
            shown(row.worse, factor=100, decimals=1).split()[0],
            shown(row.better, factor=100, decimals=1).split()[0],
            row.verdict,
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Grounding).run())
