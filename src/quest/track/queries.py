"""What is asked for, and how it finds its entity: points directly, labels and slots among what the finder sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from quest.errors import InputError
from quest.model.found import APART_PX, Found
from quest.text import choose, understand
from quest.track.settings import TrackerConfig
from quest.types import LABELS, Camera, Query

PATIENCE_S = 0.25
"""For how long a label or slot looks for its entity, seconds."""


@dataclass(frozen=True)
class Waiting:
    """A query that has not found its entity."""

    number: int
    """Its number."""
    query: Query
    """What was asked."""
    frame: int
    """The frame from which it looks."""
    until_s: float | None = None
    """The time up to which a label or slot looks, by the stream's clock; None before it began, and of points."""


@dataclass(frozen=True)
class Following:
    """A query that has found its entity."""

    number: int
    """Its number."""
    name: str
    """What to call it."""
    label: str | None
    """Its label, if known."""
    intent: str | None
    """What it is taken hold of for, if known."""


@dataclass
class QueriesState:
    """The queries of a stream."""

    following: list[Following] = field(default_factory=list)
    """Those that are followed, in the order of the filter's."""
    waiting: list[Waiting] = field(default_factory=list)
    """Those that have not found their entity."""
    discover: bool = False
    """Whether everything in the next frame is to be discovered."""
    numbered: int = 0
    """How many numbers have been given."""

    @property
    def names(self) -> dict[int, str]:
        """By number, of all of them; empty where a name is not made up yet."""
        return {w.number: w.query.name for w in self.waiting} | {f.number: f.name for f in self.following}


class StreamQueries:
    """Asks, renames and retires the queries of one stream, which are its ``state``, and binds them to entities.

    Without queries everything in the first frame is discovered.
    """

    def __init__(self, config: TrackerConfig, camera: Camera, queries: Sequence[Query] | None) -> None:
        self.state = QueriesState(discover=queries is None)
        self._config = config
        self._camera = camera
        if isinstance(queries, Query | str):
            raise InputError(f"queries: expected a list of them, got {queries!r}")
        for query in queries or ():
            self.ask(query, frame=0)

    def ask(self, query: Query, *, frame: int) -> int:
        """Ask for one more entity from a frame on; returns the query's number.

        Raises:
            InputError: a point query lies outside the image or in a frame that has passed, a text is not understood or
                means more than one thing, a query has the name of another one, or is none.
            MissingExtraError: a text has a word that needs the extra ``text``.
        """
        if not isinstance(query, Query):
            raise InputError(
                f"queries: expected Query.point(…), Query.semantic(…), Query.text(…) or Query.slot(), got {query!r}"
            )
        if query.words is not None:
            meaning = understand(query.words)
            if not meaning.single or not set(meaning.thing.nouns) <= set(LABELS):
                raise InputError(f"text {query.words!r}: expected one thing to follow, and no hinge, got: {meaning}")
        if query.name and query.name in self.state.names.values():
            raise InputError(f"query {query.name!r}: another query is called so already; choose another name")
        if query.uv_px is not None:
            (x, y), camera = query.uv_px, self._camera
            if not (0 <= x <= camera.width and 0 <= y <= camera.height):
                raise InputError(
                    f"query {query.name!r}: expected a pixel within {camera.width} x {camera.height}, "
                    f"got ({x:.1f}, {y:.1f})"
                )
            if query.frame < frame:
                raise InputError(
                    f"query {query.name!r}: frame {query.frame} has passed; the next frame is number {frame}"
                )
        self.state.waiting.append(Waiting(self._next_number(), query, max(frame, query.frame)))
        return self.state.numbered - 1

    def find(self, query: int | str) -> int:
        """The number of a query, by its number or name.

        Raises:
            InputError: no query of that number or name is followed or waits.
        """
        names = self.state.names
        found = [number for number, name in names.items() if query in (number, name) and query != ""]
        if not found:
            raise InputError(f"query {query!r}: no such number or name; there are {names}")
        return found[0]

    def rename(self, number: int, name: str) -> None:
        """Call a query by another name.

        Raises:
            InputError: another query has that name.
        """
        state = self.state
        if name in {other for k, other in state.names.items() if k != number}:
            raise InputError(f"query {number}: another query is called {name!r} already; choose another name")
        state.following = [replace(f, name=name) if f.number == number else f for f in state.following]
        state.waiting = [
            replace(w, query=replace(w.query, name=name)) if w.number == number else w for w in state.waiting
        ]

    def row(self, number: int) -> int | None:
        """Which of those that are followed a query is; None of one that waits."""
        return next((i for i, f in enumerate(self.state.following) if f.number == number), None)

    def begin(self, number: int) -> int:
        """A query has found its entity, or has found it already; returns its row among those that are followed."""
        for waiting in [w for w in self.state.waiting if w.number == number]:
            self.state.following.append(self._bound(waiting))
        row = self.row(number)
        assert row is not None, "a query is followed or waits"
        return row

    def retire(self, number: int) -> list[int]:
        """Follow a query no longer; returns the rows of the others among those that were followed."""
        state = self.state
        rows = [i for i, f in enumerate(state.following) if f.number != number]
        state.following = [state.following[i] for i in rows]
        state.waiting = [w for w in state.waiting if w.number != number]
        return rows

    def looking(self, now_s: float) -> bool:
        """Whether a query may still find its entity at a time or after it."""
        return self.state.discover or any(w.until_s is None or w.until_s > now_s for w in self.state.waiting)

    def bind(
        self, frame: int, now_s: float, at_px: Float[np.ndarray, "K 2"], see: Callable[[], Found]
    ) -> Float[np.ndarray, "M 2"]:
        """Queries that find their entity in this frame join those that are followed, at ``at_px``.

        ``see`` gives what the finder sees in it, and is asked only where a query looks for an entity.

        Returns:
            Pixels of the new ones.
        """
        state = self.state
        state.waiting = [
            replace(w, until_s=now_s + PATIENCE_S)
            if w.until_s is None and w.frame <= frame and w.query.kind != "point"
            else w
            for w in state.waiting
        ]
        looking = [w for w in state.waiting if w.until_s is not None and w.until_s > now_s]
        found, pixels = self._among(looking, at_px, see()) if looking or state.discover else ([], [])
        for waiting in [w for w in state.waiting if w.query.kind == "point" and w.frame <= frame]:
            found.append(self._bound(waiting))
            pixels.append(np.array(waiting.query.uv_px, np.float64))
        state.following += found
        return np.array(pixels, np.float64).reshape(-1, 2)

    def discover(self, found: Found, at_px: Float[np.ndarray, "K 2"]) -> list[int]:
        """What is found, best first, joins those that are followed, at ``at_px``, but for what one follows already.

        Returns:
            Which of the found ones join.
        """
        rows: list[int] = []
        for i in range(len(found)):
            one, followed_px = found.select([i]), np.concatenate([at_px, found.uv_px[rows]])
            if len(self.state.following) < self._config.most and not self.near(one, followed_px).any():
                rows.append(i)
                self.state.following.append(self._discovered(one))
        return rows

    def _discovered(self, one: Found) -> Following:
        """A query of what was found, with a name of its own."""
        number, label = self._next_number(), LABELS[int(one.label_p[0, : len(LABELS)].argmax())]
        intent = "lift" if one.lift_p[0] > 0.5 else "open"
        return Following(number, f"{label} {number}" + " (lift)" * (intent == "lift"), label, intent)

    def _next_number(self) -> int:
        self.state.numbered += 1
        return self.state.numbered - 1

    def _bound(self, waiting: Waiting, label: str | None = None, intent: str | None = None) -> Following:
        """A query with the label and intent of what it found; without them its place is told."""
        query, number = waiting.query, waiting.number
        self.state.waiting = [w for w in self.state.waiting if w is not waiting]
        return Following(
            number, query.name or f"{label or 'point'} {number}", query.label or label, query.intent or intent
        )

    def _among(
        self, looking: Sequence[Waiting], at_px: Float[np.ndarray, "K 2"], found: Found
    ) -> tuple[list[Following], list[np.ndarray]]:
        """Discovered entities, labels and slots, and their pixels."""
        config, following = self._config, self.state.following
        label_p = found.label_p[:, : len(LABELS)]
        exists = found.p * label_p.sum(axis=1)
        likeliest = [LABELS[int(i)] for i in label_p.argmax(axis=1)]
        intent = ["lift" if p > 0.5 else "open" for p in found.lift_p]
        near = self.near(found, at_px)
        begun: list[Following] = []
        chosen: list[int] = []
        if self.state.discover:
            chosen = [i for i in range(len(found)) if exists[i] > config.threshold and not near[i].any()]
            chosen = chosen[: config.most]
            begun += [self._discovered(found.select([i])) for i in chosen]
            self.state.discover = False
        for waiting in looking:
            query = waiting.query
            fits = exists.copy() if query.label is None else exists * label_p[:, LABELS.index(query.label)]
            if query.intent is not None:
                fits *= found.lift_p if query.intent == "lift" else 1 - found.lift_p
            taken = near & np.array([_same(query, f) for f in following], bool)
            fits[taken.any(axis=1)] = 0
            fits[chosen] = 0
            if query.words is not None:  # a text means what it says, whatever else is followed there
                least, least_of_any = config.threshold, config.prompt_threshold
                fits[:] = 0
                fits[choose(found, query.words, least=least, least_of_any=least_of_any).rows] = 1
            best = int(fits.argmax()) if len(fits) else -1
            if best >= 0 and fits[best] > config.prompt_threshold:
                chosen.append(best)
                begun.append(self._bound(waiting, query.label or likeliest[best], intent[best]))
        return begun, list(found.uv_px[chosen])

    def near(self, found: Found, at_px: Float[np.ndarray, "K 2"]) -> Bool[np.ndarray, "N K"]:
        """Which places are of what was found: they are in its box, or close to it."""
        apart_px = APART_PX * max(self._camera.width, self._camera.height) / self._config.size_px
        low, high = found.box_px[:, None, :2], found.box_px[:, None, 2:]
        inside = ((at_px >= low) & (at_px <= high)).all(axis=-1)
        return inside | (np.linalg.norm(found.uv_px[:, None] - at_px, axis=-1) < apart_px)


def _same(query: Query, following: Following) -> bool:
    """Whether what another query follows, at the same place, may be what a query means."""
    if query.label is not None and following.label not in (None, query.label):
        return False
    return query.intent in (None, following.intent or "open")
