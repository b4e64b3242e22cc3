"""Queries find their entities: points directly, labels and slots among what discovery sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from quest.errors import InputError
from quest.geometry.letterbox import Letterbox
from quest.model.decoder import Anchor
from quest.model.discovery import Peaks, find_candidates
from quest.model.network import UNKNOWN_INTENT, UNKNOWN_LABEL, QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.track.following import Following, as_rows
from quest.track.grounded import Ground
from quest.track.settings import TrackerConfig
from quest.types import INTENTS, LABELS, Query

PATIENCE = 8
"""Frames in which a label or slot looks for its entity."""


@dataclass(frozen=True)
class Waiting:
    """A query that has not found its entity."""

    number: int
    """Its number."""
    query: Query
    """What was asked."""
    since: int
    """The frame from which it looks."""


@dataclass
class BindingState:
    """What queries of a stream are bound to, and which are not."""

    anchor: Anchor | None = None
    """What the bound queries are bound to, in the order of binding; None before the first."""
    waiting: list[Waiting] = field(default_factory=list)
    """Queries that have not found their entity."""
    discover: bool = False
    """Whether everything in the next frame is to be discovered."""
    numbered: int = 0
    """How many numbers have been given."""


class Binding:
    """Binds the queries of one stream.

    Args:
        network: the network.
        config: settings of tracking.
        letterbox: between the source image and the network's input.
        queries: what to follow; None discovers entities in the first frame.

    Attributes:
        state: what queries are bound to, and which are not.

    Raises:
        InputError: a point query lies outside the image, or asks for an intent of a network that knows none.
    """

    def __init__(
        self, network: QuestNetwork, config: TrackerConfig, letterbox: Letterbox, queries: Sequence[Query] | None
    ) -> None:
        self.state = BindingState(discover=queries is None)
        self._network = network
        self._config = config
        self._letterbox = letterbox
        if isinstance(queries, Query | str):
            raise InputError(f"queries: expected a list of them, got {queries!r}")
        for query in queries or ():
            self.ask(query, frame=0)

    def ask(self, query: Query, *, frame: int, following: Sequence[Following] = ()) -> int:
        """Ask for one more entity from a frame on; returns the query's number.

        Args:
            query: what to follow.
            frame: from which on.
            following: queries that have found theirs.

        Raises:
            InputError: a point query lies outside the image or in a frame that has passed, a query asks for an intent
                of a network that knows none, has the name of another one, or is none.
        """
        if not isinstance(query, Query):
            raise InputError(f"queries: expected Query.point(…), Query.semantic(…) or Query.slot(), got {query!r}")
        if query.name and query.name in self.names(following).values():
            raise InputError(f"query {query.name!r}: another query is called so already; choose another name")
        network = self._network.config
        if query.intent is not None and not network.intents:
            raise InputError(
                f"query {query.name or query.kind!r}: these weights cannot tell what to {query.intent}; leave the "
                "intent away or use weights of the default preset"
            )
        camera = self._letterbox.source
        if query.uv_px is not None:
            x, y = query.uv_px
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

    def names(self, following: Sequence[Following]) -> dict[int, str]:
        """Names by number of all queries that are followed or wait; empty where a name is not made up yet."""
        return {w.number: w.query.name for w in self.state.waiting} | {f.query: f.name for f in following}

    def find(self, query: int | str, following: Sequence[Following]) -> int:
        """The number of a query, by its number or name.

        Raises:
            InputError: no query of that number or name is followed or waits.
        """
        names = self.names(following)
        found = [number for number, name in names.items() if query in (number, name) and query != ""]
        if not found:
            raise InputError(f"query {query!r}: no such number or name; there are {names}")
        return found[0]

    def bind(
        self,
        frame: int,
        observed: Observation,
        frames: FrameBatch,
        following: Sequence[Following],
    ) -> list[Following]:
        """Queries that find their entity in this frame.

        Args:
            frame: its index.
            observed: the frame as observed (T = 1).
            frames: the frame.
            following: queries that have found theirs.
        """
        found = self._bind_slots(frame, observed, frames, following)
        due = [w for w in self.state.waiting if w.query.kind == "point" and w.since <= frame]
        if due:
            label = [LABELS.index(w.query.label) if w.query.label else UNKNOWN_LABEL for w in due]
            intent = [INTENTS.index(w.query.intent) if w.query.intent else UNKNOWN_INTENT for w in due]
            begun = [self._begin(w, w.query.name or f"point {w.number}", w.query.label) for w in due]
            self._join(observed, frames, begun, self._canvas(due), torch.tensor(label), torch.tensor(intent))
            for query in begun:
                query.asked_px = query.bound_px
            found += begun
        return found

    def wait(self) -> None:
        """A frame is ignored: labels and slots look one frame longer."""
        self.state.waiting = [
            w if w.query.kind == "point" else replace(w, since=w.since + 1) for w in self.state.waiting
        ]

    def looking(self, frame: int) -> bool:
        """Whether anything may still bind in a frame or after it."""
        return self.state.discover or any(
            w.query.kind == "point" or frame < w.since + PATIENCE for w in self.state.waiting
        )

    def keep(self, rows: Sequence[int]) -> None:
        """Drop the anchors of all rows but these."""
        if self.state.anchor is not None:
            index = torch.tensor(list(rows), dtype=torch.long, device=self.state.anchor.content.device)
            self.state.anchor = self.state.anchor.select(index) if len(index) else None

    def _next_number(self) -> int:
        self.state.numbered += 1
        return self.state.numbered - 1

    def _begin(self, waiting: Waiting, name: str, label: str | None, *, intent: str | None = None) -> Following:
        self.state.waiting = [w for w in self.state.waiting if w is not waiting]
        # Of what nobody asked for to lift by, the network only thinks so.
        ground = Ground(self._config, fixed=waiting.query.intent == "lift")
        return Following(waiting.number, name, label, ground, waiting.query.intent or intent)

    def _canvas(self, due: Sequence[Waiting]) -> Float[Tensor, "K 2"]:
        uv_px = np.array([w.query.uv_px for w in due], np.float32)
        return torch.from_numpy(self._letterbox.to_canvas(uv_px) / self._network.config.encoder.image_size)

    def _bind_slots(
        self, frame: int, observed: Observation, frames: FrameBatch, following: Sequence[Following]
    ) -> list[Following]:
        looking = [w for w in self.state.waiting if w.query.kind != "point" and w.since <= frame < w.since + PATIENCE]
        if not (looking or self.state.discover):
            return []
        config = self._config
        candidates = find_candidates(self._network, frames, observed, radius_cells=config.slot_radius_cells)
        peaks, clash = candidates.peaks, candidates.clash.tolist()
        existence = (config.slot_gain * (peaks.logit + config.slot_bias)).sigmoid().tolist()
        label, intent = [LABELS[int(n)] for n in peaks.label], _intents(peaks)
        near = self._near(peaks.uv, frames, following)
        found: list[Following] = []
        chosen: list[int] = []
        if self.state.discover:
            apart = candidates.apart()[: self._network.config.slots]
            chosen = [i for i in apart if existence[i] > config.slot_threshold and not any(near[i])]
            for i in chosen:
                number = self._next_number()
                # What is followed at the same place is the same thing under another label, or a part of it.
                others = [f"{label[j]} {f.query}" for f, j in zip(found, chosen, strict=False) if clash[i][j]]
                notes = ["lift"] * (intent[i] == "lift") + [f"or {other}" for other in others[:1]]
                name = " ".join([f"{label[i]} {number}", *(f"({note})" for note in notes)])
                found.append(self._begin(Waiting(number, Query.slot(), frame), name, label[i], intent=intent[i]))
            self.state.discover = False
        for waiting in looking:
            query = waiting.query
            fits = [
                i
                for i in candidates.apart(_asked_for(query, label, intent))
                if i not in chosen
                and not any(clash[i][j] for j in chosen if query.label in (None, label[j]))
                and not any(close and _same(query, f) for close, f in zip(near[i], following, strict=True))
            ]
            if fits and existence[fits[0]] > config.prompt_threshold:
                chosen.append(fits[0])
                name = query.name or f"{label[fits[0]]} {waiting.number}"
                found.append(self._begin(waiting, name, label[fits[0]], intent=intent[fits[0]]))
        if chosen:
            self._join(observed, frames, found, peaks.uv[chosen], peaks.label[chosen], peaks.intent[chosen])
        return found

    def _near(self, uv: Float[Tensor, "K 2"], frames: FrameBatch, following: Sequence[Following]) -> list[list[bool]]:
        """For every peak, which queries follow what is seen there."""
        size = self._network.config.encoder.image_size
        at = torch.from_numpy(as_rows(f.place for f in following)).to(frames.depth_m)
        gap_px = torch.cdist(uv * size, frames.from_reference(at[None, None])[0, 0])
        return (gap_px < self._config.slot_radius_cells * self._network.config.cell_px).tolist()

    def _join(
        self,
        observed: Observation,
        frames: FrameBatch,
        begun: Sequence[Following],
        uv: Tensor,
        label: Tensor,
        intent: Tensor,
    ) -> None:
        """Bind more queries; the anchors of the others stay as they are."""
        uv, label, intent = (values[None].to(frames.depth_m.device) for values in (uv, label, intent))
        uv_px = uv * self._network.config.encoder.image_size
        for query, bound_px in zip(begun, uv_px[0], strict=True):
            query.bound_px = bound_px
        point = frames.near_point_at(uv_px[:, None]).squeeze(1)
        valid = torch.ones_like(label, dtype=torch.bool)
        anchor = self._network.bind(observed, uv, point, label, valid, intent)
        self.state.anchor = anchor if self.state.anchor is None else self.state.anchor.join(anchor)

    def bind_again(self, observed: Observation, frames: FrameBatch, following: Sequence[Following]) -> None:
        """Bind what was seen in the frame before anew where it was, as the reference frame is another.

        Anchors that were made without depth do not match frames with it. What was hidden keeps its anchor, and is
        searched for everywhere.

        Args:
            observed: the frame as observed (T = 1).
            frames: the frame.
            following: the queries, in the order of the anchors.
        """
        rows = [k for k, f in enumerate(following) if f.answer is not None and f.answer.visible]
        if self.state.anchor is None or not rows:
            return
        again = [following[k] for k in rows]
        uv_px = np.stack([f.answer.uv_px for f in again if f.answer is not None])
        uv = torch.from_numpy(self._letterbox.to_canvas(uv_px) / self._network.config.encoder.image_size)
        label = [LABELS.index(f.label) if f.label else UNKNOWN_LABEL for f in again]
        intent = [INTENTS.index(f.intent) if f.intent else UNKNOWN_INTENT for f in again]
        self._join(observed, frames, again, uv, torch.tensor(label), torch.tensor(intent))
        order = [len(following) + rows.index(k) if k in rows else k for k in range(len(following))]
        self.state.anchor = self.state.anchor.select(torch.tensor(order, device=self.state.anchor.content.device))
        for query in again:
            query.asked_px = None if query.mark_px is None else query.bound_px


def _asked_for(query: Query, label: Sequence[str], intent: Sequence[str | None]) -> list[int]:
    """The peaks that a prompt may mean."""
    return [i for i in range(len(label)) if query.label in (None, label[i]) and query.intent in (None, intent[i])]


def _same(query: Query, following: Following) -> bool:
    """Whether what another query follows, at the place of a prompt's peak, may be what the prompt means."""
    if query.label is not None and following.label not in (None, query.label):
        return False
    return query.intent in (None, following.intent or "open")


def _intents(peaks: Peaks) -> list[str | None]:
    """What each peak is for; None where the network does not tell."""
    return [None if n == UNKNOWN_INTENT else INTENTS[n] for n in peaks.intent.tolist()]
