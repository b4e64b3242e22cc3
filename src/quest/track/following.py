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
    """What was known of a query while nothing spoke against it.

    Attributes:
        ground: a copy of its joint.
        place: where it was, reference frame.
    """

    ground: Ground
    place: Float[np.ndarray, "3"]


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
    """One query that has found its entity; everything in the reference frame of the stream.

    Attributes:
        query: its number.
        name: what to call it.
        label: its label, if known.
        intent: what it is taken hold of for, if known.
        slot: index of its learned query, for networks that have them.
        ground: its joint.
        belief: over the cells of the newest frame (K = 1).
        place: where it was at the newest frame.
        home: where it was first.
        held: whether that is where its joint holds it, unseen.
        buried: whether it was hidden behind something that came before it, and has not been seen since.
        refused: frames in a row in which it was said to be seen off its joint, and was held instead.
        born: the query's embedding in its first frame.
        safe: copies from before, the older one first.
        since_safe: frames since the last copy.
        doubted: whether it was seen in a wrong place when an alarm was raised, so that it is held and searched.
        good: frames in a row, with an alarm open, in which what is seen matches the anchor.
        answer: what was said of it in the newest frame.
        bound_px: the pixel of the network's input at which it was bound, until it is matched for the first time.
        asked_px: the user's pixel in the network's input, until the first answer.
        mark: from where it was first to the point under the user's pixel, reference frame; None if there was none.
        mark_px: the same in pixels of the network's input, for what has no place; None if there was none.
    """

    query: int
    name: str
    label: str | None
    slot: int | None
    ground: Ground
    intent: str | None = None
    belief: Belief | None = None
    place: Float[np.ndarray, "3"] | None = None
    home: Float[np.ndarray, "3"] | None = None
    held: bool = False
    buried: bool = False
    refused: int = 0
    born: Float[Tensor, " D"] | None = None
    safe: deque[Safe] = field(default_factory=lambda: deque(maxlen=2))
    since_safe: int = 0
    doubted: bool = False
    good: int = 0
    answer: Answer | None = None
    bound_px: Float[Tensor, "2"] | None = None
    asked_px: Float[Tensor, "2"] | None = None
    mark: Float[np.ndarray, "3"] | None = None
    mark_px: Float[np.ndarray, "2"] | None = None

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
