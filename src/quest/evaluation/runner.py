"""The evaluation loop: every chosen take once, each view by every tracker under every protocol it has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.protocols import (
    ClipTracker,
    ProtocolName,
    ViewOutcome,
    evaluate_point,
    evaluate_semantic,
    starts_at_rest,
    unscored_entities,
)
from quest.evaluation.records import Discovery, EntityRecord, Subject, Unscored
from quest.evaluation.selection import SplitPart
from quest.types import Take


@dataclass(frozen=True)
class Evaluated:
    """Everything that an evaluation found out.

    Attributes:
        records: per tracker, take, view and scored entity.
        discoveries: per tracker, take and view of the semantic protocol.
        unscored: entities not scored, per take and view.
        notes: what a reader must know, in words.
    """

    records: tuple[EntityRecord, ...]
    discoveries: tuple[Discovery, ...]
    unscored: tuple[Unscored, ...]
    notes: tuple[str, ...]


def has_protocol(tracker: ClipTracker, protocol: ProtocolName) -> bool:
    """Whether a tracker takes part in a protocol; those that do not say have both."""
    return protocol in getattr(tracker, "protocols", ("point", "semantic"))


def evaluate(
    store: TakeStore,
    takes: Mapping[str, SplitPart],
    trackers: Sequence[ClipTracker],
    *,
    protocols: Sequence[ProtocolName] = ("point",),
    progress: Callable[[str, int], None] = lambda doing, frames: None,
) -> Evaluated:
    """Evaluate trackers on takes.

    Args:
        store: where the takes are.
        takes: names and part of the object split, from :func:`quest.evaluation.selection.select_takes`.
        trackers: with names of their own.
        protocols: each tracker is evaluated under those that it has.
        progress: called before each view with what is being done, and the number of frames done since the last call.

    Raises:
        ConfigError: two trackers have one name, or no tracker has any of the protocols.
        TakeError: a take cannot be read.
    """
    names = [tracker.name for tracker in trackers]
    if len(set(names)) < len(names):
        raise ConfigError(f"trackers: expected different names, got {', '.join(names)}")
    runs: list[tuple[ProtocolName, ClipTracker]] = [
        (protocol, tracker) for protocol in protocols for tracker in trackers if has_protocol(tracker, protocol)
    ]
    if not runs:
        raise ConfigError(f"no tracker of {', '.join(names)} has the protocol {' or '.join(protocols)}; add quest")
    records: list[EntityRecord] = []
    discoveries: list[Discovery] = []
    unscored: list[Unscored] = []
    moving = []
    done = 0
    for name, part in takes.items():
        take = store.read(name)
        unscored += unscored_entities(take)
        if not starts_at_rest(take):
            moving.append(name)
        for view in range(len(take.views)):
            for protocol, tracker in runs:
                progress(f"{tracker.name} {protocol} {name}", done)
                outcome = _evaluate_view(tracker, protocol, take, view, part)
                records += outcome.records
                discoveries += () if outcome.discovery is None else (outcome.discovery,)
                done = len(take)
    progress("done", done)
    return Evaluated(tuple(records), tuple(discoveries), tuple(unscored), _notes(unscored, moving, protocols))


def _evaluate_view(tracker: ClipTracker, protocol: ProtocolName, take: Take, view: int, part: SplitPart) -> ViewOutcome:
    info = take.info
    subject = Subject(tracker.name, protocol, part, info.source, info.level, info.object_id)
    run = evaluate_point if protocol == "point" else evaluate_semantic
    return run(tracker, take, view, subject)


def _notes(unscored: list[Unscored], moving: list[str], protocols: Sequence[ProtocolName]) -> tuple[str, ...]:
    notes = []
    if unscored:
        notes.append(
            f"{len(unscored)} (take, view, entity) not scored: not visible in frames 0 to 7 (listed in the file)"
        )
    if moving:
        shown = ", ".join(moving[:3]) + (", ..." if len(moving) > 3 else "")
        notes.append(f"{len(moving)} takes already move in frames 0 to 7, against the protocol: {shown}")
    if "semantic" in protocols:
        notes.append("lk and hold-still only have the protocol point; they have no row in semantic")
    return tuple(notes)
