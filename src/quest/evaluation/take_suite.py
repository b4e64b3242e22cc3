"""Which suite of the simulator a take belongs to, read out of its name: records know no more of their take."""

from __future__ import annotations

import re
from dataclasses import dataclass

STANDARD = "standard"
"""Ordinary takes, which belong to no suite."""

_TAG = re.compile(r"-L\d+-(?P<suite>[a-z]+?)\d*(?P<alike>alike)?-s\d+$")


@dataclass(frozen=True)
class TakeSuite:
    """The suite of a take.

    Attributes:
        name: ``occlusion``, ``lockers``, or :data:`STANDARD`.
        look_alike: whether the name says that a look-alike stays in view while an entity is hidden.
    """

    name: str
    look_alike: bool

    @classmethod
    def of(cls, take: str) -> TakeSuite:
        """The suite of a take by its name, such as ``desk-102015-L1-occlusion60alike-s000000``."""
        found = _TAG.search(take)
        return cls(STANDARD, False) if found is None else cls(found["suite"], found["alike"] is not None)
