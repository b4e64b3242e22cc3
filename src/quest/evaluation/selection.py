"""Which takes of a store are evaluated, and the guard that keeps training objects out of reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from quest.data.provenance import combined_hash
from quest.data.split import PARTS, SplitPart, part_of
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.types import TakeInfo


@dataclass(frozen=True)
class Shard:
    """A part of the takes or streams, for processes side by side."""

    index: int = 0
    """From 0."""
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read ``0/2``, the first of two.

        Raises:
            ConfigError: the text is of another form or the index too large.
        """
        index, _, count = text.partition("/")
        if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
            raise ConfigError(f"shard {text!r}: expected index/count such as 0/2, the index below the count")
        return cls(int(index), int(count))

    def __contains__(self, i: int) -> bool:
        return i % self.count == self.index


WHOLE = Shard()
"""All of it."""


Chosen = Sequence[tuple[TakeStore, Mapping[str, SplitPart]]]
"""Stores, and the part of the object split of the takes in them that are to be used, by name."""


def select_takes(
    infos: Mapping[str, TakeInfo],
    *,
    split: Sequence[SplitPart],
    levels: Sequence[int] = (),
    objects: Sequence[str] = (),
    same_objects: bool = False,
) -> dict[str, SplitPart]:
    """Takes to evaluate and their part of the split, in the order of their names.

    Args:
        infos: descriptions of the takes in the store.
        split: parts to keep; training objects only come in when ``train`` is named.
        levels: levels to keep; all if empty.
        objects: object ids to keep; all if empty.
        same_objects: keep only objects that have takes of every level that is kept, so that levels compare.

    Raises:
        ConfigError: an object that the store does not have, or nothing is left.
    """
    unknown = sorted(set(objects) - {info.object_id for info in infos.values()})
    if unknown:
        raise ConfigError(f"objects {', '.join(unknown)}: not in the store; it has {_list(infos)}")
    kept: dict[str, SplitPart] = {
        name: part_of(info)
        for name, info in sorted(infos.items())
        if part_of(info) in split
        and (not levels or info.level in levels)
        and (not objects or info.object_id in objects)
    }
    if same_objects:
        wanted = {infos[name].level for name in kept}
        have: dict[str, set[int]] = {}
        for name in kept:
            have.setdefault(infos[name].object_id, set()).add(infos[name].level)
        kept = {name: part for name, part in kept.items() if have[infos[name].object_id] == wanted}
    if not kept:
        asked = f"split {', '.join(split)}, levels {list(levels) or 'all'}, objects {list(objects) or 'all'}"
        raise ConfigError(
            f"no take is left to evaluate: asked for {asked}{', the same in every level' if same_objects else ''}; "
            f"the store has {_list(infos)}. Training objects are only evaluated with --split train"
        )
    return kept


def hash_of(takes: Chosen) -> str:
    """One hash over the data of takes."""
    return combined_hash((name, store.data_hash(name)) for store, chosen in takes for name in chosen)


def _list(infos: Mapping[str, TakeInfo]) -> str:
    if not infos:
        return "no takes"
    counts = {part: sum(part_of(i) == part for i in infos.values()) for part in (*PARTS, "unlisted")}
    parts = ", ".join(f"{count} {part}" for part, count in counts.items() if count)
    levels = sorted({info.level for info in infos.values()})
    return f"{len(infos)} takes ({parts}; levels {', '.join(map(str, levels))})"
