"""What becomes of entities while they are occluded and after (suite occlusion).

An episode is the first run of at least 20 frames in which a moved entity is hidden, after it was seen moving. It is
judged five frames after its entity is seen again. Protocol point. Records do not hold the truth, but the distance of
the tracker ``hold-still`` changes by no more than the entity moves; so where it has changed by :data:`MOVING`, the
entity has moved at least that far.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from quest.errors import InputError
from quest.evaluation.bootstrap import Pool, Value
from quest.evaluation.drift import clopper_pearson
from quest.evaluation.records import EntityRecord
from quest.evaluation.stream_record import runs
from quest.evaluation.summary import TakeSuite

STILL = "hold-still"
"""The tracker whose distance tells how far an entity has moved."""

LEAST_HIDDEN = 20
"""An entity that is hidden for fewer frames than this makes no episode."""

AFTER_FRAMES = 5
"""A track is judged so many frames after its entity is seen again."""

MOVING = 0.02
"""An entity was seen moving if it was visible at least so far from where it was asked for, normalised units."""


@dataclass(frozen=True)
class Episode:
    """One tracker's answers to one entity that is hidden and maybe seen again."""

    record: EntityRecord
    start: int
    """First hidden frame."""
    end: int
    """Frame in which it is seen again; the number of frames if it never is."""

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
    """A share with two intervals."""

    hits: int
    trials: int
    share: float
    low: float
    """Lower end of the exact 95 % interval, which takes the trials to be independent."""
    high: float
    over_objects: Value
    """The same share with its bootstrap interval over objects."""


def reappearances(records: Sequence[EntityRecord], *, resamples: int, seed: int) -> list[dict[str, Any]]:
    """Rows per part, source, look-alike and tracker, of the suite ``occlusion`` in the protocol ``point``.

    ``beside``: whether a look-alike stays in view (``alike``), none does (``alone``), or ``both`` together. Shares and
    distances after an entity is seen again are over the ``judged``; None where there are none.

    Raises:
        InputError: an entity has no answer of :data:`STILL`.
    """
    groups: dict[tuple, list[Episode]] = defaultdict(list)
    found = episodes(records)
    trackers = list(dict.fromkeys(e.record.subject.tracker for e in found))
    for episode in found:
        s = episode.record.subject
        beside = "alike" if TakeSuite.of(episode.record.take).look_alike else "alone"
        for kind in (beside, "both"):
            groups[s.part, s.source, kind, trackers.index(s.tracker), s.tracker].append(episode)
    return [_row(key, groups[key], resamples=resamples, seed=seed) for key in sorted(groups)]


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
    """First hidden frame, and frame seen again, of the first long enough run after the entity was seen moving."""
    first = record.first_frame
    away = np.abs(still.distance - still.distance[first]) >= MOVING
    seen_moving = away & record.visible & (np.arange(len(away)) >= first)
    for start, end in runs(~record.visible):
        if end - start >= LEAST_HIDDEN and seen_moving[:start].any():
            return start, end
    return None


def _row(key: tuple, group: list[Episode], *, resamples: int, seed: int) -> dict[str, Any]:
    part, source, beside, _, tracker = key
    pool = Pool(group, lambda e: e.record.subject.object_id, resamples=resamples, seed=seed)
    judged = pool.where(lambda e: e.judged_at is not None)
    return {
        "tracker": tracker,
        "part": part,
        "source": source,
        "beside": beside,
        "objects": pool.objects,
        "takes": len({e.record.take for e in group}),
        "episodes": len(group),
        "judged": len(judged.records),
        "hidden_frames": float(np.median([e.end - e.start for e in group])),
        "held_before": share_of(pool, attrgetter("held_before")),
        "ape_hidden": pool.mean(
            lambda e: e.record.distance[e.start : e.end].sum(dtype=np.float64), lambda e: e.end - e.start
        ),
        "held_again": share_of(judged, attrgetter("held_again")),
        "held_again_if_before": share_of(judged.where(attrgetter("held_before")), attrgetter("held_again")),
        "distance_again": judged.median(lambda e: e.record.distance[e.judged_at]),
        "distance_end": judged.median(lambda e: e.record.distance[-1]),
    }


def share_of(pool: Pool[Episode], flag: Callable[[Episode], bool]) -> Share | None:
    """The share of episodes for which something is true, with both intervals; None without episodes."""
    value, hits = pool.mean(flag), len(pool.where(flag).records)
    if value is None:
        return None
    return Share(hits, value.count, value.mean, *clopper_pearson(hits, value.count), value)
