"""Whether what opens a thing and what lifts it are told apart and followed, both asked for by the same label.

Judged are views in which exactly one entity of a label opens and exactly one lifts, such as the rims of a laptop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from quest.baselines import ClipTracker
from quest.evaluation.bootstrap import Pool
from quest.evaluation.metrics import GATE, distance, identity
from quest.evaluation.protocols import first_visible
from quest.geometry import invert, transform
from quest.types import INTENTS, Query, Take

STABLE = 0.95
"""A track is stable if it is nearest to its own entity, and within the gate, in so many of the frames."""


@dataclass(frozen=True)
class IntentAnswer:
    """What a tracker made of both intents in one view."""

    take: str
    view: int
    object_id: str
    part: str
    source: str
    label: str
    """That both entities have."""
    open_ape: float
    lift_ape: float
    """Mean 3D distance to the entity, normalised units; a frame without an answer counts 1."""
    open_acc: float
    lift_acc: float
    """Share of frames in which the answer is nearest to its own entity and within 0.1."""
    open_bound: float
    lift_bound: float
    """3D distance of the first answer to the entity; 1 if there is none."""
    open_kept: float
    lift_kept: float
    """Share of frames in which the answer is within 0.1 of the spot of the entity's own link on which the first answer
    was. It says whether the right link is followed, wherever on it the track began."""

    @property
    def both(self) -> bool:
        """Whether the answers are two distinct, stable tracks of the entities themselves."""
        return min(self.open_acc, self.lift_acc) >= STABLE

    @property
    def kept(self) -> bool:
        """Whether they are two distinct, stable tracks on the entities' links."""
        return min(self.open_kept, self.lift_kept) >= STABLE


MEASURED = ("both", "kept", *(f"{intent}_{what}" for what in ("ape", "acc", "bound", "kept") for intent in INTENTS))
"""What a row has the means of, over views, with intervals over objects."""


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


def judge_intents(tracker: ClipTracker, take: Take, view: int, *, part: str) -> list[IntentAnswer]:
    """Ask for what opens and for what lifts in one stream, and judge both tracks from its first frame."""
    answers = []
    info, clip, half, true = take.info, take.views[view].clip, take.info.half_diagonal_m, take.point_world
    for label, opens, lifts in intent_pairs(take, view):
        pair = np.array([opens, lifts])
        queries = [Query.semantic(label, intent=intent, name=intent) for intent in INTENTS]
        point, rank = tracker.track(clip, queries).point_world, np.searchsorted(take.tracked, pair)
        gap = distance(point, true[:, pair], half_diagonal_m=half)
        right = identity(point, true[:, take.tracked], rank, half_diagonal_m=half) == rank
        measured: dict[str, float] = {}
        for i, intent in enumerate(INTENTS):
            first, kept = _kept(take, point[:, i], int(pair[i]))
            values = {"ape": gap[:, i].mean(), "acc": right[:, i].mean(), "bound": gap[first, i], "kept": kept}
            measured |= {f"{intent}_{what}": float(value) for what, value in values.items()}
        answers.append(IntentAnswer(info.name, view, info.object_id, part, info.source, label, **measured))
    return answers


def _kept(take: Take, point_world: Float[np.ndarray, "T 3"], entity: int) -> tuple[int, float]:
    """Frame of the first answer (0 if there is none), and the share of frames on that spot of the entity's link."""
    known = np.flatnonzero(np.isfinite(point_world).all(axis=-1))
    if not len(known):
        return 0, 0.0
    first = int(known[0])
    world_from_link = torch.from_numpy(take.link_pose[:, take.info.entities[entity].link]).double()
    spot = transform(invert(world_from_link[first]), torch.from_numpy(point_world[first]).double())
    carried = transform(world_from_link, spot).numpy()
    gap = distance(point_world.astype(np.float64), carried, half_diagonal_m=take.info.half_diagonal_m)
    return first, float((gap <= GATE).mean())


def intent_rows(answers: Sequence[IntentAnswer], *, resamples: int = 1000, seed: int = 0) -> list[dict[str, Any]]:
    """One row per part and source."""
    rows = []
    for part, source in sorted({(a.part, a.source) for a in answers}):
        chosen = [a for a in answers if (a.part, a.source) == (part, source)]
        pool = Pool(chosen, attrgetter("object_id"), resamples=resamples, seed=seed)
        counts = {"objects": pool.objects, "takes": len({a.take for a in chosen}), "views": len(chosen)}
        rows.append({"part": part, "source": source} | counts | {n: pool.mean(attrgetter(n)) for n in MEASURED})
    return rows
