"""Which objects are for training, validation and test: the committed file ``split.json``."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal

from quest.errors import ObjectError
from quest.types import TakeInfo

Part = Literal["train", "validation", "test"]
PARTS: tuple[Part, ...] = ("train", "validation", "test")
"""The parts of the split, in the order of the file."""
SplitPart = Part | Literal["unlisted"]
"""A part of the object split; ``unlisted`` objects are in none."""


@dataclass(frozen=True)
class ObjectSplit:
    """The object split."""

    partnet_mobility: dict[str, tuple[str, ...]]
    """Folder names per part."""
    sweethome3d: dict[str, dict[str, str]]
    """Names of imported objects per part, and of which models of their libraries they are made."""
    procedural_seeds: dict[str, tuple[int, int]]
    """First and last object seed per part, both included."""


@cache
def object_split() -> ObjectSplit:
    """The split that the package ships."""
    raw = json.loads(resources.files("quest.data").joinpath("split.json").read_text(encoding="utf-8"))
    ids, seeds = ({part: tuple(raw[kind][part]) for part in PARTS} for kind in ("partnet-mobility", "procedural_seeds"))
    return ObjectSplit(ids, raw["sweethome3d"], {part: (first, last) for part, (first, last) in seeds.items()})


def part_of_object(source: str, object_id: str) -> Part | None:
    """Which part of the split an object belongs to; None for none.

    Raises:
        ObjectError: it is procedural and has no seed in its name.
    """
    split = object_split()
    named = {"partnet-mobility": split.partnet_mobility, "sweethome3d": split.sweethome3d}
    if source in named:
        return next((part for part in PARTS if object_id in named[source][part]), None)
    if source != "procedural":
        return None
    match = re.fullmatch(r".+-(\d+)", object_id)
    if match is None:
        raise ObjectError(
            f"object {object_id!r}: expected a procedural object to be called category-seed, such as "
            f"'fridge-100003'; rename it so that its part of the split is known"
        )
    ranges = split.procedural_seeds
    return next((part for part in PARTS if ranges[part][0] <= int(match[1]) <= ranges[part][1]), None)


def split_of(info: TakeInfo) -> Part:
    """Which part of the split the object of a take belongs to.

    Raises:
        ObjectError: the object is in no part, so that neither training nor a reported number may use it.
    """
    found = part_of_object(info.source, info.object_id)
    if found is None:
        raise ObjectError(
            f"object {info.object_id!r} ({info.source}) is in no part of the split; expected one of split.json's "
            "objects or a procedural seed in its ranges"
        )
    return found


def part_of(info: TakeInfo) -> SplitPart:
    """The part that a take's object is in, or ``unlisted``."""
    try:
        return split_of(info)
    except ObjectError:
        return "unlisted"
