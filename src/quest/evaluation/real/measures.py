"""From answers on real recordings to numbers with intervals; ``docs/metrics.md`` defines the measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from quest.data.boxed_pictures import in_boxes
from quest.evaluation.bootstrap import Value, draw_objects, mean_value, median_value, statistic_value
from quest.evaluation.drift import ranked_auroc
from quest.evaluation.metrics import Sums
from quest.evaluation.real.sets import Labels, Picture
from quest.model.finder import PANELS
from quest.model.found import shared

NEAR_PX = 16.0
BEYOND_PX = 50.0
Measures = Mapping[str, Value | None]

_SAME_BOX = 0.5

SIZES_PX = (0, 16, 32, 64, np.inf)
"""Handles are told apart by their longer side in a picture 640 pixels wide."""


@dataclass(frozen=True)
class Answers:
    """What a tracker says at the scored labels of one clip; NaN where it says nothing."""

    uv_px: Float[np.ndarray, "S 2"]
    visible: Bool[np.ndarray, " S"]
    lost_p: Float[np.ndarray, " S"]


@dataclass(frozen=True)
class ScoredClip:
    """One tracker's answers in one clip, compared with the scored labels."""

    labels: Labels
    answers: Answers
    error_px: Float[np.ndarray, " S"]
    """Distance from the label where it is visible, the image's diagonal without an answer; else NaN."""
    mixed: Bool[np.ndarray, " S"]
    """Whether the answer is not near, and nearer to another labelled entity than to its own."""


def score_clip(labels: Labels, answers: Answers, *, diagonal_px: float) -> ScoredClip:
    """Compare answers at the scored labels of a clip with these; a missing answer is off by the image's diagonal."""
    scored, seen = labels.scored, labels.state == "visible"
    error_px, mixed = np.full(len(scored), np.nan), np.zeros(len(scored), bool)
    for row, i in enumerate(scored):
        if seen[i]:
            gap = np.nan_to_num(np.linalg.norm(labels.uv_px - answers.uv_px[row], axis=-1), nan=diagonal_px)
            others = seen & (labels.frame == labels.frame[i]) & (labels.track != labels.track[i])
            error_px[row] = gap[i]
            mixed[row] = gap[i] > NEAR_PX and gap[others].min(initial=np.inf) < gap[i]
    return ScoredClip(labels, answers, error_px, mixed)


def track_measures(clips: Sequence[ScoredClip], *, far_px: float, resamples: int, seed: int) -> Measures:
    """Measures of one tracker over clips, with intervals over these; beyond ``far_px`` an answer is far off."""
    draws = draw_objects(len(clips), resamples=resamples, generator=np.random.default_rng(seed))
    clip = np.repeat(np.arange(len(clips)), [len(c.error_px) for c in clips])
    error_px, mixed = (np.concatenate([getattr(c, name) for c in clips]) for name in ("error_px", "mixed"))
    called, lost_p = (np.concatenate([getattr(c.answers, name) for c in clips]) for name in ("visible", "lost_p"))
    track = np.concatenate([c.labels.track[c.labels.scored] for c in clips])
    state = np.concatenate([c.labels.state[c.labels.scored] for c in clips])
    moves = np.concatenate([c.labels.moves[c.labels.track[c.labels.scored]] for c in clips])
    seen = state == "visible"
    near, far = seen & (error_px <= NEAR_PX), seen & (error_px > far_px)

    def share(what: np.ndarray, of: np.ndarray) -> Value | None:
        return mean_value(Sums((what & of).astype(float), of.astype(float)), clip, draws)

    def median(values: np.ndarray, of: np.ndarray) -> Value | None:
        return median_value(values[of], clip[of], draws)

    known = np.isfinite(lost_p) & (near | far | ~seen)
    rank, wrong, owner = np.unique(lost_p[known], return_inverse=True)[1], ~near[known], clip[known]
    tracks = np.unique(np.stack([clip, track], axis=1)[seen], axis=0)
    worst = [error_px[seen & (clip == c) & (track == k)].max() for c, k in tracks]
    never = Sums((np.array(worst) <= BEYOND_PX).astype(float), np.ones(len(worst)))
    return {
        "median_px": median(error_px, seen),
        "within_16": share(near, seen),
        "moved_median_px": median(error_px, seen & moves),
        "moved_within_16": share(near, seen & moves),
        "never_beyond_50": mean_value(never, tracks[:, 0], draws),
        "identity_errors": share(mixed, seen),
        "hidden_called_visible": share(called, ~seen),
        "occluded_called_visible": share(called, state == "occluded"),
        "out_called_visible": share(called, state == "out"),
        "lost_p_near": median(lost_p, near),
        "lost_p_far": median(lost_p, far),
        "lost_p_hidden": median(lost_p, ~seen),
        "lost_auroc": statistic_value(
            lambda times: ranked_auroc(rank, wrong, times[owner].astype(float)), draws, count=int(known.sum())
        ),
    }


@dataclass(frozen=True)
class ScoredPicture:
    """What a tracker found unasked in one picture."""

    right: Bool[np.ndarray, " A"]
    """Which of its answers are right."""
    again: Bool[np.ndarray, " A"]
    """Which of these are at a handle that a better answer has already."""
    found: Bool[np.ndarray, " H"]
    """Which handles have an answer."""
    size_px: Float[np.ndarray, " H"]
    """Of each handle, see :data:`SIZES_PX`."""
    score: Float[np.ndarray, " C"]
    """Of each candidate that answers are chosen from."""
    first: Bool[np.ndarray, " C"]
    """Which candidates are right, and the best one of their handle."""
    boxes: Mapping[str, Boxes]
    """Handles and panels by their boxes, of those kinds that are labelled in boxes; and panels without a handle."""


@dataclass(frozen=True)
class Boxes:
    """Boxes of one kind in one picture."""

    score: Float[np.ndarray, " C"]
    """Of each box that was found."""
    first: Bool[np.ndarray, " C"]
    """Which of them share at least half of their union with a labelled one that no better one has."""
    labelled: int
    """How many are labelled."""


def score_picture(picture: Picture, found: Mapping[str, np.ndarray]) -> ScoredPicture:
    """Compare what was found with the labels of a picture.

    Args:
        picture: with its handles.
        found: see :func:`quest.evaluation.real.run.discover`.
    """
    uv_px, score = found["uv_px"], found["score"]
    right, again, _ = _assign(picture, uv_px)
    followed = score > found["least"]
    got = _assign(picture, uv_px[followed])[2]
    counted = np.isfinite(right)
    boxes = {}
    if not picture.bars:
        boxes["handle"] = match_boxes(found["box_px"], score, picture.boxes)
        for k, kind in enumerate(PANELS):
            own = found["panel_kind"] == k
            true = picture.panels.get(kind, np.zeros((0, 4)))
            boxes[kind] = match_boxes(found["panel_px"][own], found["panel_score"][own], true)
        panels = np.concatenate([np.zeros((0, 4)), *picture.panels.values()])
        middles = (picture.boxes[:, :2] + picture.boxes[:, 2:]) / 2
        bare = np.array([not in_boxes(box[None], middles).any() for box in panels], bool)
        boxes["bare"] = match_boxes(found["bare_px"], found["bare_score"], panels[bare])
    return ScoredPicture(
        right[followed & counted] == 1,
        again[followed & counted],
        got,
        picture.sizes_px()[picture.wanted],
        score[counted],
        (right[counted] == 1) & ~again[counted],
        boxes,
    )


def match_boxes(
    box_px: Float[np.ndarray, "C 4"], score: Float[np.ndarray, " C"], true_px: Float[np.ndarray, "H 4"]
) -> Boxes:
    """Give each box, best first, the labelled one that it shares most with, if that is at least half of their union."""
    free, first = np.ones(len(true_px), bool), np.zeros(len(box_px), bool)
    for i in np.argsort(-score, kind="stable"):
        share = np.where(free, shared(box_px[i], true_px), 0.0)
        if share.max(initial=0.0) >= _SAME_BOX:
            first[i] = True
            free[share.argmax()] = False
    return Boxes(score, first, len(true_px))


def _assign(picture: Picture, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give each answer, best first, its handle; one that is near several takes one that has no answer yet.

    Returns:
        Of each answer whether it is right (1), wrong (0), or at a handle that does not count (NaN), and whether its
        handle has an answer already; of each handle that counts whether it has one.
    """
    right, again = np.zeros(len(uv_px)), np.zeros(len(uv_px), bool)
    taken = np.zeros(len(picture.boxes), bool)
    for i, gap in enumerate(picture.closeness(uv_px)):
        if np.isfinite(gap).any():
            k = min(np.flatnonzero(np.isfinite(gap)), key=lambda k: (taken[k], gap[k]))
            right[i], again[i] = 1.0 if picture.wanted[k] else np.nan, taken[k]
            taken[k] = True
    return right, again, taken[picture.wanted]


def discovery_measures(pictures: Sequence[ScoredPicture], *, resamples: int, seed: int) -> Measures:
    """Measures of what was found in pictures, with intervals over these."""
    draws = draw_objects(len(pictures), resamples=resamples, generator=np.random.default_rng(seed))

    def pooled(name: str) -> tuple[np.ndarray, np.ndarray]:
        """Values of all pictures, and of which picture each is."""
        values = [getattr(picture, name) for picture in pictures]
        return np.concatenate(values), np.repeat(np.arange(len(values)), [len(v) for v in values])

    def share(what: np.ndarray, owner: np.ndarray, of: np.ndarray | None = None) -> Value | None:
        counted = np.ones(len(what), bool) if of is None else of
        return mean_value(Sums((what & counted).astype(float), counted.astype(float)), owner, draws)

    (right, own), (again, _), (found, home) = pooled("right"), pooled("again"), pooled("found")
    (score, candidate), (first, _), (size_px, _) = pooled("score"), pooled("first"), pooled("size_px")

    def f1(times: np.ndarray) -> float:
        """Second answers at a handle are wrong."""
        both = times[own].sum() + times[home].sum()
        hits = (times[own] * (right & ~again)).sum() + (times[home] * found).sum()
        return float(hits / both) if both else np.nan

    measures: dict[str, Value | None] = {
        "recall": share(found, home),
        "precision": share(right, own),
        "f1": statistic_value(f1, draws, count=len(found)),
        "ap": statistic_value(_average_precision(score, first, candidate, home), draws, count=len(score)),
    }
    for low, high in pairwise(SIZES_PX):
        name = f"recall_{low}_to_{high}_px" if np.isfinite(high) else f"recall_above_{low}_px"
        measures[name] = share(found, home, (size_px >= low) & (size_px < high))
    for kind in dict.fromkeys(kind for picture in pictures for kind in picture.boxes):
        boxes = [picture.boxes[kind] for picture in pictures]
        home = np.repeat(np.arange(len(boxes)), [b.labelled for b in boxes])
        own = np.repeat(np.arange(len(boxes)), [len(b.score) for b in boxes])
        area = _average_precision(
            np.concatenate([b.score for b in boxes]), np.concatenate([b.first for b in boxes]), own, home
        )
        measures[f"ap50_{kind}"] = statistic_value(area, draws, count=len(home))
    return measures


def _average_precision(
    score: np.ndarray, first: np.ndarray, own: np.ndarray, home: np.ndarray
) -> Callable[[np.ndarray], float]:
    """Area under the precision-recall curve of all candidates, made to fall, by how often pictures are drawn."""
    order = np.argsort(-score, kind="stable")
    first, own = first[order], own[order]

    def area(times: np.ndarray) -> float:
        handles, weight = times[home].sum(), times[own]
        if not handles:
            return np.nan
        hits, answers = np.cumsum(weight * first), np.cumsum(weight)
        precision = np.maximum.accumulate((hits / np.maximum(answers, 1))[::-1])[::-1]
        return float(np.sum(np.diff(hits, prepend=0) * precision) / handles)

    return area
