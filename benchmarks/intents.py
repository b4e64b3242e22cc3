"""Measure whether what opens a thing and what lifts it are told apart and followed, both asked for by the same label.

    quest generate --out TAKES --objects procedural:laptop-112000,...
    python benchmarks/intents.py --takes TAKES --split test --out benchmarks/results/intents/intents.json

Judged are views in which exactly one entity of a label opens and exactly one lifts, such as the rims of a laptop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float, Int
from rich import box
from rich.console import Console
from rich.table import Table

import quest
from quest.data.cut import cut_clip
from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.bootstrap import Value, draw_objects, mean_value
from quest.evaluation.metrics import GATE, Sums, distance, identity
from quest.evaluation.protocols import ClipTracker, first_visible
from quest.evaluation.report import provenance, shown, write_report
from quest.evaluation.selection import select_takes
from quest.geometry import invert, transform
from quest.types import INTENTS, Query, Take, View

STABLE = 0.95
"""A track is stable if it is nearest to its own entity, and within the gate, in so many of the frames."""


MEASURED = (
    "both",
    "kept",
    *(f"{intent}_{what}" for what in ("ape", "acc", "bound", "kept") for intent in ("open", "lift")),
)
"""What a row says of its answers."""


@dataclass(frozen=True)
class IntentAnswer:
    """What a tracker made of both intents in one view.

    Attributes:
        take: name of the take.
        view: index of the view.
        object_id: the object.
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        label: label that both entities have.
        begin: frame of the take in which the stream began.
        open_ape: mean 3D distance to the entity to open by, normalised units; a frame without an answer counts 1.
        lift_ape: the same to the entity to lift by.
        open_acc: share of frames in which the answer is nearest to its own entity and within 0.1.
        lift_acc: the same to lift by.
        open_bound: 3D distance of the first answer to the entity to open by; 1 if there is none.
        lift_bound: the same to lift by.
        open_kept: share of frames in which the answer is within 0.1 of the spot of the entity's own link on which the
            first answer was. It says whether the right link is followed, wherever on it the track began.
        lift_kept: the same to lift by.
    """

    take: str
    view: int
    object_id: str
    part: str
    source: str
    label: str
    begin: int
    open_ape: float
    lift_ape: float
    open_acc: float
    lift_acc: float
    open_bound: float
    lift_bound: float
    open_kept: float
    lift_kept: float

    @property
    def both(self) -> bool:
        """Whether the answers are two distinct, stable tracks of the entities themselves."""
        return min(self.open_acc, self.lift_acc) >= STABLE

    @property
    def kept(self) -> bool:
        """Whether they are two distinct, stable tracks on the entities' links."""
        return min(self.open_kept, self.lift_kept) >= STABLE


@dataclass(frozen=True)
class IntentRow:
    """Answers for one kind of objects, with intervals over objects.

    Attributes:
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        objects: how many.
        takes: how many.
        views: how many were judged.
        both: share of views with two distinct, stable tracks of the entities themselves.
        kept: share of views with two distinct, stable tracks on the entities' links.
        open_ape: mean 3D distance of what opens, normalised units.
        lift_ape: of what lifts.
        open_acc: share of frames in which what opens is followed.
        lift_acc: what lifts.
        open_bound: mean 3D distance of the first answer to the entity to open by.
        lift_bound: to the one to lift by.
        open_kept: share of frames in which the spot of its link is followed on which the first answer was.
        lift_kept: what lifts.
    """

    part: str
    source: str
    objects: int
    takes: int
    views: int
    both: Value | None
    kept: Value | None
    open_ape: Value | None
    lift_ape: Value | None
    open_acc: Value | None
    lift_acc: Value | None
    open_bound: Value | None
    lift_bound: Value | None
    open_kept: Value | None
    lift_kept: Value | None


def intent_pairs(take: Take, view: int) -> list[tuple[str, int, int]]:
    """Labels of which one entity is there to open by and one to lift by, both seen in the first frames.

    Returns:
        The label, and both entities' indices.
    """
    seen, _ = first_visible(take.views[view].visible, take.tracked)
    found = []
    entities = take.info.entities
    for label in sorted({entities[e].label for e in seen}):
        by = {intent: [int(e) for e in seen if (entities[e].label, entities[e].intent) == (label, intent)]
              for intent in INTENTS}  # fmt: skip
        if len(by["open"]) == len(by["lift"]) == 1:
            found.append((label, by["open"][0], by["lift"][0]))
    return found


def judge_intents(
    tracker: ClipTracker, take: Take, view: int, *, part: str, apart_px: float = 0.0
) -> list[IntentAnswer]:
    """Ask for what opens and for what lifts in one stream, and judge both tracks.

    Args:
        tracker: weights that know intents.
        take: with ground truth.
        view: index of the view.
        part: part of the object split.
        apart_px: the stream begins with the first frame in which both are seen this far apart, pixels of the video;
            where there is none, the view is left out.

    Raises:
        InputError: the weights know no intents.
    """
    answers = []
    info, clip = take.info, take.views[view].clip
    for label, opens, lifts in intent_pairs(take, view):
        pair = np.array([opens, lifts])
        begin = _first_apart(take.views[view], pair, apart_px)
        if begin is None:
            continue
        queries = [Query.semantic(label, intent=intent, name=intent) for intent in INTENTS]
        tracks = tracker.track(cut_clip(clip, slice(begin, None)), queries)
        gap, right = _score(take, tracks.point_world, pair, begin)
        (open_first, open_kept), (lift_first, lift_kept) = (
            _kept(take, tracks.point_world[:, i], int(entity), begin) for i, entity in enumerate(pair)
        )
        answers.append(
            IntentAnswer(
                take=info.name,
                view=view,
                object_id=info.object_id,
                part=part,
                source=info.source,
                label=label,
                begin=begin,
                open_ape=float(gap[:, 0].mean()),
                lift_ape=float(gap[:, 1].mean()),
                open_acc=float(right[:, 0].mean()),
                lift_acc=float(right[:, 1].mean()),
                open_bound=float(gap[open_first, 0]),
                lift_bound=float(gap[lift_first, 1]),
                open_kept=open_kept,
                lift_kept=lift_kept,
            )
        )
    return answers


def _first_apart(view: View, pair: Int[np.ndarray, " 2"], apart_px: float) -> int | None:
    gap_px = np.linalg.norm(np.diff(view.uv_px[:, pair], axis=1)[:, 0], axis=-1)
    frames = np.flatnonzero((gap_px >= apart_px) & view.visible[:, pair].all(axis=1)) if apart_px > 0 else np.zeros(1)
    return int(frames[0]) if len(frames) else None


def _score(
    take: Take, point_world: Float[np.ndarray, "T 2 3"], entities: Int[np.ndarray, " 2"], begin: int
) -> tuple[np.ndarray, np.ndarray]:
    half, true = take.info.half_diagonal_m, take.point_world[begin:]
    gap = distance(point_world, true[:, entities], half_diagonal_m=half)
    rank = np.searchsorted(take.tracked, entities)
    nearest = identity(point_world, true[:, take.tracked], rank, half_diagonal_m=half)
    return gap, nearest == rank


def _kept(take: Take, point_world: Float[np.ndarray, "T 3"], entity: int, begin: int) -> tuple[int, float]:
    """Frame of the first answer (0 if there is none), and the share of frames on that spot of the entity's link."""
    known = np.flatnonzero(np.isfinite(point_world).all(axis=-1))
    if not len(known):
        return 0, 0.0
    first = int(known[0])
    world_from_link = torch.from_numpy(take.link_pose[begin:, take.info.entities[entity].link]).double()
    spot = transform(invert(world_from_link[first]), torch.from_numpy(point_world[first]).double())
    carried = transform(world_from_link, spot).numpy()
    gap = distance(point_world.astype(np.float64), carried, half_diagonal_m=take.info.half_diagonal_m)
    return first, float((gap <= GATE).mean())


def intent_rows(answers: Sequence[IntentAnswer], *, resamples: int = 1000, seed: int = 0) -> tuple[IntentRow, ...]:
    """One row per part and source."""
    rows = []
    for part, source in sorted({(a.part, a.source) for a in answers}):
        chosen = [a for a in answers if (a.part, a.source) == (part, source)]
        objects, owner = np.unique([a.object_id for a in chosen], return_inverse=True)
        draws = draw_objects(len(objects), resamples=resamples, generator=np.random.default_rng(seed))

        def value(name: str, chosen=chosen, owner=owner, draws=draws) -> Value | None:
            numbers = np.array([float(getattr(a, name)) for a in chosen])
            return mean_value(Sums(numbers, np.ones(len(numbers))), owner, draws)

        measured = {name: value(name) for name in MEASURED}
        rows.append(IntentRow(part, source, len(objects), len({a.take for a in chosen}), len(chosen), **measured))
    return tuple(rows)


@dataclass(frozen=True)
class Intents:
    """Shares of views in which both intents give distinct, stable tracks."""

    takes: tuple[str, ...]
    """Folders of take stores."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation",)
    """Parts of the object split."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    apart_px: float = 0.0
    """Begin each stream with the first frame in which both are seen this far apart; 0 begins with the take."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Track, print, write."""
        console, tracker = Console(width=150, highlight=False), quest.load(self.weights)
        answers: list[IntentAnswer] = []
        hashes: list[tuple[str, str]] = []
        for store in map(TakeStore, self.takes):
            for name, part in select_takes(store.infos(), split=self.split).items():
                if name in {known for known, _ in hashes}:
                    raise ConfigError(f"--takes: expected different names in all stores, {name!r} comes twice")
                take, before = store.read(name), len(answers)
                for view in range(len(take.views)):
                    answers += judge_intents(tracker, take, view, part=part, apart_px=self.apart_px)
                if len(answers) > before:
                    hashes.append((name, store.data_hash(name)))
                    console.print(f"{name}: {len(answers)} views so far")
        rows = intent_rows(answers, resamples=self.resamples, seed=self.seed)
        if self.out is not None:
            about = {"weights": self.weights, "weights_hash": tracker.weights_hash, "data_hash": combined_hash(hashes)}
            about |= {
                "apart_px": self.apart_px,
                "resamples": self.resamples,
                "seed": self.seed,
                "rows": [asdict(row) for row in rows],
            }
            write_report(provenance() | about | {"answers": [asdict(a) for a in answers]}, self.out)
        console.print(_table(rows))
        return 0


def _table(rows: tuple[IntentRow, ...]) -> Table:
    table = Table(title="open and lift", box=box.SIMPLE_HEAD, caption="95 % bootstrap over objects; APE: 3D distance")
    for heading in (
        "objects",
        "objects/takes/views",
        "both stable %",
        "both on their link %",
        "APE open",
        "APE lift",
        "Acc open %",
        "Acc lift %",
        "bound open",
        "bound lift",
    ):
        table.add_column(heading)
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            f"{row.objects}/{row.takes}/{row.views}",
            shown(row.both, decimals=0, factor=100),
            shown(row.kept, decimals=0, factor=100),
            shown(row.open_ape),
            shown(row.lift_ape),
            shown(row.open_acc, decimals=0, factor=100),
            shown(row.lift_acc, decimals=0, factor=100),
            shown(row.open_bound),
            shown(row.lift_bound),
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Intents).run())
