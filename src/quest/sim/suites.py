"""Suites: takes that put one difficulty to a tracker, as named presets."""

from __future__ import annotations

from dataclasses import dataclass

from quest.errors import ConfigError

HIDDEN_FRAMES = (10, 120)
"""How long an entity may be hidden, both included."""


@dataclass(frozen=True)
class Suite:
    """What sets the takes of a suite apart from ordinary ones: how long its entities are hidden, and beside what.

    Attributes:
        name: ``occlusion`` or ``lockers``.
        hidden: frames for which every moving entity is hidden; None draws them from 10 to 120, take by take.
        look_alike: whether another entity of the same label stays in view meanwhile; if not, none is ever in view.
        before: fewest and most frames of a joint's share before its entity is hidden; the hold is part of the
            first one's.
        after: fewest and most frames of a joint's share that follow; in the first two or three the occluder is
            still leaving.
        level: how many joints move unless a run says otherwise.
        category: the only category of procedural objects that it takes, or None for all objects.
    """

    name: str
    hidden: int | None
    look_alike: bool
    before: tuple[int, int]
    after: tuple[int, int]
    level: int = 1
    category: str | None = None

    def __post_init__(self) -> None:
        low, high = HIDDEN_FRAMES
        if self.hidden is not None and not low <= self.hidden <= high:
            raise ConfigError(
                f"suite {self.name}: expected entities hidden for {low} to {high} frames, got {self.hidden}"
            )

    @property
    def tag(self) -> str:
        """What the names of its takes carry, such as ``occlusion60alike``."""
        alike = "alike" if self.look_alike and self.category is None else ""
        return f"{self.name}{'' if self.hidden is None else self.hidden}{alike}"


SUITES = {
    "occlusion": Suite("occlusion", None, False, before=(34, 41), after=(24, 30)),
    "lockers": Suite("lockers", 30, True, before=(24, 24), after=(6, 6), level=4, category="locker_bank"),
}
"""The presets: an entity hidden for 10 to 120 frames while it moves on and stops; and banks of sixteen like doors."""
