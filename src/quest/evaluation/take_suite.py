"""Which suite of the simulator a take belongs to, read out of its name: records know no more of their take."""

from __future__ import annotations

import re
from dataclasses import dataclass

STANDARD = "standard"
"""Ordinary takes, which belong to no suite."""

_TAG = re.compile(r"-L\d+-(?P<suite>[a-z]+?)(\d*(?P<alike>alike)?|-(?P<variant>[a-z0-9-]+))-s\d+$")


@dataclass(frozen=True)
class TakeSuite:
    """The suite of a take."""

    name: str
    """Such as ``occlusion`` or ``shift``, or :data:`STANDARD`."""
    look_alike: bool
    """Whether the name says that a look-alike stays in view while an entity is hidden."""
    variant: str = ""
    """Which kind of the suite, such as ``blur``; empty if there is only one."""

    @classmethod
    def of(cls, take: str) -> TakeSuite:
        """The suite of a take by its name, such as ``desk-102015-L1-occlusion60alike-s000000``."""
        found = _TAG.search(take)
        if found is None:
            return cls(STANDARD, False)
        return cls(found["suite"], found["alike"] is not None, found["variant"] or "")

    @property
    def title(self) -> str:
        """The suite with its variant, such as ``shift-blur``."""
        return f"{self.name}-{self.variant}" if self.variant else self.name
