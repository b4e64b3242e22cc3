"""The evaluation loop: every chosen take once, each view by every tracker under every protocol it has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

from quest.baselines import ClipTracker
from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.finished import FinishedTakes
from quest.evaluation.protocols import (
    ProtocolName,
    evaluate_point,
    evaluate_semantic,
    starts_at_rest,
    unscored_entities,
)
from quest.evaluation.records import Discovery, EntityRecord, Subject, TakeOutcome, Unscored
from quest.evaluation.selection import WHOLE, Shard
from quest.types import Take


@dataclass(frozen=True)
class Evaluated:
    """Everything that an evaluation found out."""

    records: tuple[EntityRecord, ...]
    discoveries: tuple[Discovery, ...]
    unscored: tuple[Unscored, ...]
    notes: tuple[str, ...]
    """What a reader must know, in words."""
    missing: int = 0
    """Takes that are left to other shards; what is known is not whole before there are none."""


def has_protocol(tracker: ClipTracker, protocol: ProtocolName) -> bool:
    """Whether a tracker takes part in a protocol; those that do not say have both."""
    return protocol in getattr(tracker, "protocols", ("point", "semantic"))


def evaluate(
    store: TakeStore,
    takes: Mapping[str, SplitPart],
    trackers: Sequence[ClipTracker],
    *,
    protocols: Sequence[ProtocolName] = ("point",),
    finished: FinishedTakes | None = None,
    shard: Shard = WHOLE,
    progress: Callable[[str, int], None] = lambda doing, frames: None,
) -> Evaluated:
    """Evaluate trackers on takes.

    Args:
        store: where the takes are.
        takes: names and part of the object split, from :func:`quest.evaluation.selection.select_takes`.
        trackers: with names of their own.
        protocols: each tracker is evaluated under those that it has.
        finished: where takes are kept as they are done, and taken up again; nothing is kept by default.
        shard: the part of the takes that this process evaluates; those of the others are taken from ``finished``.
        progress: called before each view with what is being done, and the number of frames done since the last call.

    Raises:
        ConfigError: two trackers have one name, none has any of the protocols, or a shard has nothing to share by.
        InputError: a finished take is damaged.
        TakeError: a take cannot be read.
    """
    names = [tracker.name for tracker in trackers]
    if len(set(names)) < len(names):
        raise ConfigError(f"trackers: expected different names, got {', '.join(names)}")
    if finished is None and shard.count > 1:
        raise ConfigError("shard: expected a folder of finished takes that the processes share, got none")
    protocols = tuple(dict.fromkeys(protocols))
    runs: list[tuple[ProtocolName, ClipTracker]] = [
        (protocol, tracker) for protocol in protocols for tracker in trackers if has_protocol(tracker, protocol)
    ]
    if not runs:
        raise ConfigError(f"no tracker of {', '.join(names)} has the protocol {' or '.join(protocols)}; add quest")
    hashes = {} if finished is None else {name: store.data_hash(name) for name in takes}
    done: dict[str, TakeOutcome] = {}
    frames = 0

    def tell(doing: str, coming: int) -> None:
        nonlocal frames
        progress(doing, frames)
        frames = coming

    def take_up(name: str) -> bool:
        known = None if finished is None else finished.read(name, hashes[name])
        if known is not None:
            done[name] = known
        return known is not None

    for name in [name for i, name in enumerate(takes) if i in shard]:
        if take_up(name):
            header = store.header(name)
            tell(f"{name} is there", header.frames * len(header.cameras) * len(runs))
            continue
        done[name] = _evaluate_take(store.read(name), runs, takes[name], tell)
        if finished is not None:
            finished.write(name, hashes[name], done[name])
    tell("done", 0)
    missing = sum(not take_up(name) for name in takes if name not in done)  # only now: other shards went on meanwhile
    outcomes = {name: done[name] for name in takes if name in done}
    records, discoveries, unscored = (
        tuple(chain.from_iterable(getattr(outcome, what) for outcome in outcomes.values()))
        for what in ("records", "discoveries", "unscored")
    )
    moving = [name for name, outcome in outcomes.items() if outcome.moving]
    return Evaluated(records, discoveries, unscored, _notes(unscored, moving, protocols), missing)


def _evaluate_take(
    take: Take, runs: Sequence[tuple[ProtocolName, ClipTracker]], part: SplitPart, tell: Callable[[str, int], None]
) -> TakeOutcome:
    info, records, discoveries = take.info, list[EntityRecord](), list[Discovery]()
    for view in range(len(take.views)):
        for protocol, tracker in runs:
            tell(f"{tracker.name} {protocol} {info.name}", len(take))
            subject = Subject(tracker.name, protocol, part, info.source, info.level, info.object_id)
            if protocol == "point":
                records += evaluate_point(tracker, take, view, subject)
            else:
                found, discovery = evaluate_semantic(tracker, take, view, subject)
                records += found
                discoveries.append(discovery)
    return TakeOutcome(tuple(records), tuple(discoveries), unscored_entities(take), moving=not starts_at_rest(take))


def _notes(unscored: Sequence[Unscored], moving: Sequence[str], protocols: Sequence[ProtocolName]) -> tuple[str, ...]:
    notes = []
    if unscored:
        notes.append(
            f"{len(unscored)} (take, view, entity) not scored: not visible in frames 0 to 7 (listed in the file)"
        )
    if moving:
        shown = ", ".join(moving[:3]) + (", ..." if len(moving) > 3 else "")
        notes.append(f"{len(moving)} takes already move in frames 0 to 7, against the protocol: {shown}")
    if "semantic" in protocols:
        notes.append("trackers that only follow given points have no row in semantic")
    return tuple(notes)
