"""What becomes of hidden entities (suite occlusion), and how often identities switch among likes (suite lockers).

    quest eval --takes SUITES --trackers quest lk hold-still --out RUN.json
    python benchmarks/reappearance.py RUN.records.parquet --out benchmarks/results/reappearance.json

An episode is the first run of at least 20 frames in which a moved entity is hidden, after it was seen moving. It is
judged five frames after its entity is seen again. Protocol point. Records do not hold the truth, but the distance of
the tracker ``hold-still`` changes by no more than the entity moves; so where it has changed by :data:`MOVING`, the
entity has moved at least that far.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from jaxtyping import Int
from rich import box
from rich.console import Console
from rich.table import Table

from quest.errors import InputError
from quest.evaluation.bootstrap import Value, draw_objects, mean_value, median_value
from quest.evaluation.drift import clopper_pearson
from quest.evaluation.metrics import Sums
from quest.evaluation.records import EntityRecord
from quest.evaluation.report import gather, origins_json, provenance, shown, write_report
from quest.evaluation.stream_record import runs
from quest.evaluation.summary import Row, summarise
from quest.evaluation.take_suite import TakeSuite

STILL = "hold-still"
"""The tracker whose distance tells how far an entity has moved."""

LEAST_HIDDEN = 20
"""An entity that is hidden for fewer frames than this makes no episode."""

AFTER_FRAMES = 5
"""A track is judged so many frames after its entity is seen again."""

MOVING = 0.02
"""An entity was seen moving if it was visible at least so far from where it was asked for, normalised units."""

Beside = Literal["alike", "alone", "both"]


@dataclass(frozen=True)
class Episode:
    """One tracker's answers to one entity that is hidden and maybe seen again.

    Attributes:
        record: all its answers.
        start: first hidden frame.
        end: frame in which it is seen again; the number of frames if it never is.
    """

    record: EntityRecord
    start: int
    end: int

    @property
    def held_before(self) -> bool:
        """Whether its identity was right in the last frame before."""
        return bool(self.record.follows[self.start - 1] == self.record.entity)

    @property
    def judged_at(self) -> int | None:
        """Frame in which it is judged; None if the take ends before."""
        at = self.end + AFTER_FRAMES
        return at if at < len(self.record.distance) else None

    @property
    def held_again(self) -> bool:
        """Whether its identity is right where it is judged; only for those that are."""
        assert self.judged_at is not None
        return bool(self.record.follows[self.judged_at] == self.record.entity)


@dataclass(frozen=True)
class Share:
    """A share with two intervals.

    Attributes:
        hits: how often.
        trials: of how many.
        share: hits / trials.
        low: lower end of the exact 95 % interval, which takes the trials to be independent.
        high: upper end.
        over_objects: the same share with its bootstrap interval over objects.
    """

    hits: int
    trials: int
    share: float
    low: float
    high: float
    over_objects: Value


@dataclass(frozen=True)
class ReappearanceRow:
    """Episodes of one tracker; None where there are none to judge.

    Attributes:
        tracker: its name.
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        beside: whether a look-alike stays in view (``alike``), none does (``alone``), or ``both`` together.
        objects: how many.
        takes: how many.
        episodes: how many.
        judged: how many of them can be judged after they are seen again.
        hidden_frames: median length.
        held_before: share whose identity was right just before.
        ape_hidden: mean distance over the hidden frames.
        held_again: share of the judged whose identity is right when they are judged.
        held_again_if_before: the same of those that were held just before.
        distance_again: median distance when judged.
        distance_end: median distance of the same at the end of the take.
    """

    tracker: str
    part: str
    source: str
    beside: Beside
    objects: int
    takes: int
    episodes: int
    judged: int
    hidden_frames: float
    held_before: Share | None
    ape_hidden: Value | None
    held_again: Share | None
    held_again_if_before: Share | None
    distance_again: Value | None
    distance_end: Value | None


def reappearances(records: Sequence[EntityRecord], *, resamples: int, seed: int) -> tuple[ReappearanceRow, ...]:
    """Rows per part, source, look-alike and tracker, of the suite ``occlusion`` in the protocol ``point``.

    Args:
        records: of any trackers, :data:`STILL` among them; other suites and protocols are left out.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap; every row draws from a generator of its own.

    Raises:
        InputError: an entity has no answer of :data:`STILL`.
    """
    groups: dict[tuple, list[Episode]] = defaultdict(list)
    order: dict[str, int] = {}
    for episode in episodes(records):
        s = episode.record.subject
        beside: Beside = "alike" if TakeSuite.of(episode.record.take).look_alike else "alone"
        rank = order.setdefault(s.tracker, len(order))
        for kind in (beside, "both"):
            groups[(s.part, s.source, kind, rank, s.tracker)].append(episode)
    return tuple(_row(key, groups[key], resamples=resamples, seed=seed) for key in sorted(groups))


def episodes(records: Sequence[EntityRecord]) -> list[Episode]:
    """Episodes of all moved entities of the suite ``occlusion``.

    Raises:
        InputError: as :func:`reappearances`.
    """
    kept = [r for r in records if r.subject.protocol == "point" and TakeSuite.of(r.take).name == "occlusion"]
    still = {(r.take, r.view, r.entity): r for r in kept if r.subject.tracker == STILL}
    found = []
    for record in kept:
        key = (record.take, record.view, record.entity)
        if key not in still:
            raise InputError(
                f"records: expected answers of {STILL!r}, which tell when an entity moves, got none in take "
                f"{record.take!r}, view {record.view}, entity {record.name!r}; `quest eval --protocol point` has them"
            )
        span = hidden_after_moving(record, still[key]) if record.moved else None
        if span is not None:
            found.append(Episode(record, *span))
    return found


def hidden_after_moving(record: EntityRecord, still: EntityRecord) -> tuple[int, int] | None:
    """First hidden frame, and frame seen again, of the first long enough run after the entity was seen moving.

    Args:
        record: an entity's visibility.
        still: the answers of :data:`STILL` to the same entity in the same view.
    """
    first = record.first_frame
    away = np.abs(still.distance - still.distance[first]) >= MOVING
    seen_moving = away & record.visible & (np.arange(len(away)) >= first)
    for start, end in runs(~record.visible):
        if end - start >= LEAST_HIDDEN and seen_moving[:start].any():
            return start, end
    return None


def _row(key: tuple, group: list[Episode], *, resamples: int, seed: int) -> ReappearanceRow:
    part, source, beside, _, tracker = key
    names = sorted({e.record.subject.object_id for e in group})
    draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))

    def owner(of: list[Episode]) -> Int[np.ndarray, " N"]:
        return np.array([names.index(e.record.subject.object_id) for e in of], dtype=int)

    def median(distance: Callable[[Episode], float], of: list[Episode]) -> Value | None:
        return median_value(np.array([distance(e) for e in of], dtype=np.float64), owner(of), draws)

    judged = [e for e in group if e.judged_at is not None]
    held = [e for e in judged if e.held_before]
    hidden = Sums(
        np.array([e.record.distance[e.start : e.end].sum(dtype=np.float64) for e in group]),
        np.array([e.end - e.start for e in group], dtype=np.float64),
    )
    return ReappearanceRow(
        tracker=tracker,
        part=part,
        source=source,
        beside=beside,
        objects=len(names),
        takes=len({e.record.take for e in group}),
        episodes=len(group),
        judged=len(judged),
        hidden_frames=float(np.median(hidden.count)),
        held_before=share_of([e.held_before for e in group], owner(group), draws),
        ape_hidden=mean_value(hidden, owner(group), draws),
        held_again=share_of([e.held_again for e in judged], owner(judged), draws),
        held_again_if_before=share_of([e.held_again for e in held], owner(held), draws),
        distance_again=median(lambda e: e.record.distance[e.judged_at or 0], judged),
        distance_end=median(lambda e: e.record.distance[-1], judged),
    )


def share_of(flags: Sequence[bool], owner: Int[np.ndarray, " N"], draws: Int[np.ndarray, "B O"]) -> Share | None:
    """The share of True with both intervals; None where there are no flags.

    Args:
        flags: one per trial.
        owner: index of each trial's object.
        draws: from :func:`quest.evaluation.bootstrap.draw_objects`.
    """
    value = mean_value(Sums(np.array(flags, dtype=np.float64), np.ones(len(flags))), owner, draws)
    if value is None:
        return None
    low, high = clopper_pearson(sum(flags), len(flags))
    return Share(sum(flags), len(flags), value.mean, low, high, value)


@dataclass(frozen=True)
class Reappearance:
    """Identities after occlusion and among look-alikes, with intervals."""

    records: tyro.conf.Positional[tuple[Path, ...]]
    """Files of records (.records.parquet)."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Judge, print, write."""
        records, origins = gather(self.records)
        hidden = reappearances(records, resamples=self.resamples, seed=self.seed)
        lockers = summarise(
            [r for r in records if TakeSuite.of(r.take).name == "lockers" and r.subject.protocol == "point"],
            resamples=self.resamples,
            seed=self.seed,
        )
        console = Console(width=230)
        console.print(_hidden_table(hidden))
        console.print(_lockers_table(lockers))
        if self.out is not None:
            report = provenance() | {
                "least_hidden": LEAST_HIDDEN,
                "after_frames": AFTER_FRAMES,
                "moving": MOVING,
                "resamples": self.resamples,
                "seed": self.seed,
                "origins": origins_json(origins),
                "occlusion": [asdict(row) for row in hidden],
                "lockers": [asdict(row) for row in lockers],
            }
            write_report(report, self.out)
        return 0


def _hidden_table(rows: tuple[ReappearanceRow, ...]) -> Table:
    table = Table(
        title=f"suite occlusion: moved entities hidden for {LEAST_HIDDEN} frames or more after they were seen moving",
        box=box.SIMPLE_HEAD,
        caption="shares in percent with exact 95 % intervals, distances with 95 % bootstrap over objects",
    )
    headings = ("objects", "beside", "tracker", "objects/takes", "hidden", "held before", "APE hidden")
    for heading in (*headings, "held again", "of those held before", "median then", "at the end"):
        table.add_column(heading, justify="left" if heading in ("objects", "beside", "tracker") else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.beside,
            row.tracker,
            f"{row.objects}/{row.takes}",
            f"{row.hidden_frames:.0f}",
            _share(row.held_before),
            shown(row.ape_hidden),
            _share(row.held_again),
            _share(row.held_again_if_before),
            shown(row.distance_again),
            shown(row.distance_end),
        )
    return table


def _lockers_table(rows: tuple[Row, ...]) -> Table:
    table = Table(title="suite lockers", box=box.SIMPLE_HEAD, caption="95 % bootstrap over objects")
    for heading in ("objects", "of", "tracker", "objects/takes/tracks", "switches per 1,000 frames", "Acc %"):
        table.add_column(heading, justify="left" if heading in ("objects", "of", "tracker") else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.reading,
            row.tracker,
            f"{row.objects}/{row.takes}/{row.tracks}",
            shown(row.metrics.switches, decimals=2),
            shown(row.metrics.acc, factor=100, decimals=1),
        )
    return table


def _share(share: Share | None) -> str:
    if share is None:
        return "-"
    return f"{100 * share.share:.0f} ({100 * share.low:.0f} to {100 * share.high:.0f}) of {share.trials}"


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Reappearance).run())
