"""What a stream remembers of a query that has found its entity."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32
from torch import Tensor

from quest.track.belief import Belief
from quest.track.grounded import Ground
from quest.track.settings import TrackerConfig
from quest.types import State

_SAFE_EVERY = 10


@dataclass(frozen=True)
class Safe:
    """What was known of a query while nothing spoke against it."""

    ground: Ground
    """A copy of its joint."""
    place: Float[np.ndarray, "3"]
    """Where it was, reference frame."""


@dataclass(frozen=True)
class Answer:
    """What is said of a query in a frame (see :class:`~quest.track.StreamState`)."""

    uv_px: Float32[np.ndarray, "2"]
    point_world: Float32[np.ndarray, "3"]
    confidence: float
    visible: bool
    state: State
    lost_p: float
    signals: Float32[np.ndarray, " S"]


@dataclass
class Following:
    """One query that has found its entity; everything in the reference frame of the stream."""

    query: int
    """Its number."""
    name: str
    """What to call it."""
    label: str | None
    """Its label, if known."""
    ground: Ground
    """Its joint."""
    intent: str | None = None
    """What it is taken hold of for, if known."""
    belief: Belief | None = None
    """Over the cells of the newest frame (K = 1)."""
    place: Float[np.ndarray, "3"] | None = None
    """Where it was at the newest frame."""
    home: Float[np.ndarray, "3"] | None = None
    """Where it was first."""
    held: bool = False
    """Whether that is where its joint holds it, unseen."""
    buried: bool = False
    """Whether it was hidden behind something that came before it, and has not been seen since."""
    refused: int = 0
    """Frames in a row in which it was said to be seen off its joint, and was held instead."""
    born: Float[Tensor, " D"] | None = None
    """The query's embedding in its first frame."""
    safe: deque[Safe] = field(default_factory=lambda: deque(maxlen=2))
    """Copies from before, the older one first."""
    since_safe: int = 0
    """Frames since the last copy."""
    doubted: bool = False
    """Whether it was seen in a wrong place when an alarm was raised, so that it is held and searched."""
    good: int = 0
    """Frames in a row, with an alarm open, in which what is seen matches the anchor."""
    answer: Answer | None = None
    """What was said of it in the newest frame."""
    bound_px: Float[Tensor, "2"] | None = None
    """The pixel of the network's input at which it was bound, until it is matched for the first time."""
    asked_px: Float[Tensor, "2"] | None = None
    """The user's pixel in the network's input, until the first answer."""
    mark: Float[np.ndarray, "3"] | None = None
    """From where it was first to the point under the user's pixel, reference frame; None if there was none."""
    mark_px: Float[np.ndarray, "2"] | None = None
    """The same in pixels of the network's input, for what has no place; None if there was none."""

    def forget_places(self, config: TrackerConfig) -> None:
        """Begin anew in another reference frame."""
        self.ground = Ground(config, fixed=self.ground.fixed)
        self.belief, self.place, self.home, self.mark, self.born, self.held = None, None, None, None, None, False
        self.safe.clear()
        self.since_safe = self.refused = 0
        self.buried = False

    def move(self, place: Float[np.ndarray, "3"], *, held: bool, embedding: Float[Tensor, " D"]) -> None:
        """Be somewhere else in the next frame; a place that is not known changes nothing."""
        if np.isfinite(place).all():
            self.place = place
            self.home = place if self.home is None else self.home
        self.held = held
        if self.born is None:
            self.born = embedding.float().clone()

    def keep(self) -> None:
        """Keep a copy of what is known, now and then: nothing speaks against it."""
        self.since_safe += 1
        if self.place is not None and (self.since_safe >= _SAFE_EVERY or not self.safe):
            self.safe.append(Safe(deepcopy(self.ground), self.place.copy()))
            self.since_safe = 0

    def doubt(self) -> None:
        """Go back to what was known before things went wrong, and search everywhere."""
        self.doubted, self.good, self.belief = True, 0, None
        self.buried, self.refused = False, 0
        if self.safe:
            self.ground, self.place = deepcopy(self.safe[0].ground), self.safe[0].place.copy()
            self.held = True

    def trust(self, place: Float[np.ndarray, "3"]) -> None:
        """The search has found the entity; without depth its place is not known and stays what it was."""
        self.doubted, self.good, self.since_safe = False, 0, 0
        self.buried, self.refused = False, 0
        self.place, self.held = place if np.isfinite(place).all() else self.place, False


def as_rows(places: Iterable[Float[np.ndarray, "3"] | None]) -> Float[np.ndarray, "K 3"]:
    """Places of queries as one array; NaN where one is not known."""
    unknown = np.full(3, np.nan)
    return np.array([unknown if place is None else place for place in places]).reshape(-1, 3)
