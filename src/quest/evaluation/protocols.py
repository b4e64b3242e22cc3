"""The two protocols: how a tracker is asked, and how its answers become records.

``point``: every scored entity is asked for by its true pixel at its first visible frame; the label is not given.
``semantic``: the tracker gets no query. Its answers are the slots with confidence above 0.5 at frame 7; they are
assigned once to scored entities of the same label and never re-assigned.

Scored are the entities that are visible at some time in frames 0 to 7 of the view; nothing moves meanwhile.
Each view of a take is one clip.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, Protocol, SupportsIndex, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.baselines import ClipTracker
from quest.baselines.redetect import link
from quest.errors import ConfigError
from quest.evaluation.metrics import GATE, distance, distance_px, identity
from quest.evaluation.records import Discovery, EntityRecord, Subject, Unscored
from quest.types import Query, Take, Tracks, View

ProtocolName = Literal["point", "semantic"]

START_FRAMES = 8
"""Frames 0 to 7: nothing moves, entities must show themselves, slots must bind."""

MIN_CONFIDENCE = 0.5
"""A slot is an answer when its confidence after the start is above this."""


@runtime_checkable
class Oracle(Protocol):
    """What is no tracker but is judged as one: it answers out of the truth."""

    def told(self, take: Take, view: int) -> ClipTracker:
        """The same, knowing what is true of a view."""
        ...


def first_visible(visible: Bool[np.ndarray, "T E"], tracked: Int[np.ndarray, " R"]) -> tuple[np.ndarray, np.ndarray]:
    """Scored entities among the tracked ones, and the first frame in which each is visible."""
    start = visible[:START_FRAMES, tracked]
    seen = start.any(axis=0)
    return tracked[seen], start.argmax(axis=0)[seen]


def true_queries(view: View, entities: Iterable[SupportsIndex], frames: Iterable[SupportsIndex]) -> list[Query]:
    """Point queries at the true pixels of entities; of their names a tracker can read nothing."""
    pairs = zip(frames, entities, strict=True)
    return [Query.point(int(t), *map(float, view.uv_px[t, e]), name=f"query-{int(e)}") for t, e in pairs]


def unscored_entities(take: Take) -> tuple[Unscored, ...]:
    """Entities that could be followed but do not show themselves in the first frames, per view."""
    return tuple(
        Unscored(take.info.name, v, take.info.entities[e].name, take.info.entities[e].label)
        for v, view in enumerate(take.views)
        for e in np.setdiff1d(take.tracked, first_visible(view.visible, take.tracked)[0])
    )


def starts_at_rest(take: Take) -> bool:
    """Whether no entity moves visibly in frames 0 to 7, as the protocols assume."""
    start = take.point_world[:START_FRAMES, take.tracked]
    return bool((np.linalg.norm(start - start[:1], axis=-1) <= 0.01 * take.info.half_diagonal_m).all())


def evaluate_point(tracker: ClipTracker, take: Take, view: int, subject: Subject) -> tuple[EntityRecord, ...]:
    """Ask for every scored entity of a view by its true pixel: a record each.

    Frames before an entity's query are not scored: nothing was asked yet.

    Raises:
        ConfigError: the tracker did not answer every query in every frame.
    """
    truth = take.views[view]
    scored, first = first_visible(truth.visible, take.tracked)
    if not len(scored):
        return ()
    if isinstance(tracker, Oracle):
        tracker = tracker.told(take, view)
    tracks = tracker.track(truth.clip, true_queries(truth, scored, first))
    _check(tracks, tracker=tracker.name, frames=len(take), queries=len(scored))
    return _records(tracks, take, view, subject, scored, first, np.arange(len(scored)))


def evaluate_semantic(
    tracker: ClipTracker, take: Take, view: int, subject: Subject
) -> tuple[tuple[EntityRecord, ...], Discovery]:
    """Let the tracker discover, assign its answers to entities once, and score all frames.

    Raises:
        ConfigError: the tracker's answer has another number of frames than the clip.
    """
    truth, info = take.views[view], take.info
    scored, first = first_visible(truth.visible, take.tracked)
    tracks = tracker.track(truth.clip, None)
    _check(tracks, tracker=tracker.name, frames=len(take), queries=None)
    slots = np.flatnonzero(tracks.confidence[min(START_FRAMES, len(take)) - 1] > MIN_CONFIDENCE)
    answers = np.full(len(scored), -1)
    gap = _start_distance(tracks.point_world[:, slots], take.point_world[:, scored], info.half_diagonal_m)
    slot_labels = np.array([tracks.labels[s] or "" for s in slots], dtype=object)
    entity_labels = np.array([info.entities[e].label for e in scored], dtype=object)
    for k, e in assign(gap, slot_labels[:, None] == entity_labels[None]):
        answers[e] = slots[k]
    placed, matched = len(assign(gap, np.ones_like(gap, bool))), int((answers >= 0).sum())
    discovery = Discovery(subject, info.name, view, len(slots), matched, placed, entities=len(scored))
    return _records(tracks, take, view, subject, scored, np.zeros_like(first), answers), discovery


def assign(gap: Float[np.ndarray, "S E"], allowed: Bool[np.ndarray, "S E"]) -> list[tuple[int, int]]:
    """Hungarian assignment of slots to entities: most pairs within :data:`GATE` first, then least distance.

    Args:
        gap: mean distance of slot and entity, normalised units; NaN where unknown.
        allowed: pairs of the same label.
    """
    return [(int(s), int(e)) for s, e in zip(*link(np.where(allowed, gap, np.inf), GATE), strict=True)]


def _start_distance(
    point_world: Float[np.ndarray, "T S 3"], true_world: Float[np.ndarray, "T E 3"], half_diagonal_m: float
) -> Float[np.ndarray, "S E"]:
    """Mean distance over the start frames in which the slot has a point: it may need several frames to bind."""
    gap = np.linalg.norm(point_world[:START_FRAMES, :, None] - true_world[:START_FRAMES, None], axis=-1)
    known = np.isfinite(gap)
    count = known.sum(axis=0)
    mean = np.where(known, gap, 0.0).sum(axis=0) / np.maximum(count, 1) / half_diagonal_m
    return np.where(count > 0, mean, np.nan)


def _check(tracks: Tracks, *, tracker: str, frames: int, queries: int | None) -> None:
    got = tracks.point_world.shape[:2]
    expected = (frames, got[1] if queries is None else queries)
    if got != expected:
        raise ConfigError(f"tracker {tracker!r}: expected answers for (frames, queries) = {expected}, got {got}")


def _records(
    tracks: Tracks,
    take: Take,
    view: int,
    subject: Subject,
    scored: Int[np.ndarray, " R"],
    first: Int[np.ndarray, " R"],
    answers: Int[np.ndarray, " R"],
) -> tuple[EntityRecord, ...]:
    """One record per scored entity; ``answers`` is its query's index, -1 if no slot was assigned to it."""
    truth, info = take.views[view], take.info
    # A NaN track stands in for the missing answer, so that one rule scores all missing predictions.
    point_world, uv_px = (
        np.concatenate([places, np.full((len(take), 1, places.shape[2]), np.nan, places.dtype)], axis=1)[:, answers]
        for places in (tracks.point_world, tracks.uv_px)
    )
    unit, camera, tracked, moved = info.half_diagonal_m, truth.clip.camera, take.tracked, take.moved
    gap = distance(point_world, take.point_world[:, scored], half_diagonal_m=unit)
    gap_px = distance_px(uv_px, truth.uv_px[:, scored], width=camera.width, height=camera.height)
    rank = np.searchsorted(tracked, scored)
    nearest = identity(point_world, take.point_world[:, tracked], rank, half_diagonal_m=unit)
    follows = np.where(nearest >= 0, tracked[nearest], nearest)
    return tuple(
        EntityRecord(
            subject=subject,
            take=info.name,
            view=view,
            entity=int(e),
            name=info.entities[e].name,
            label=info.entities[e].label,
            moved=bool(moved[e]),
            found=bool(answers[k] >= 0),
            first_frame=int(first[k]),
            distance=gap[:, k].astype(np.float32),
            distance_px=gap_px[:, k].astype(np.float32),
            follows=follows[:, k].astype(np.int16),
            visible=truth.visible[:, e].copy(),
        )
        for k, e in enumerate(scored)
    )
