"""From answers on real recordings to numbers with intervals; ``docs/metrics.md`` defines the measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from quest.data.boxed_pictures import in_boxes
from quest.evaluation.bootstrap import Pool, Value
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

    @property
    def state(self) -> np.ndarray:
        """As the labels say."""
        return self.labels.state[self.labels.scored]

    @property
    def seen(self) -> Bool[np.ndarray, " S"]:
        """Where the label is visible."""
        return self.state == "visible"

    @property
    def near(self) -> Bool[np.ndarray, " S"]:
        """Where it is, and the answer is near."""
        return self.error_px <= NEAR_PX

    @property
    def moves(self) -> Bool[np.ndarray, " S"]:
        """Where the track is on a part that is moved."""
        return self.labels.moves[self.labels.track[self.labels.scored]]

    @property
    def worst_px(self) -> Float[np.ndarray, " K"]:
        """Largest error of every track with a visible label."""
        track = self.labels.track[self.labels.scored]
        return np.array([self.error_px[self.seen & (track == k)].max() for k in np.unique(track[self.seen])])


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
    pool = Pool(clips, resamples=resamples, seed=seed)
    known = [np.isfinite(c.answers.lost_p) & (c.near | (c.error_px > far_px) | ~c.seen) for c in clips]
    lost_p = np.concatenate([c.answers.lost_p[k] for c, k in zip(clips, known, strict=True)])
    wrong = np.concatenate([~c.near[k] for c, k in zip(clips, known, strict=True)])
    rank, owner = np.unique(lost_p, return_inverse=True)[1], np.repeat(pool.owner, [k.sum() for k in known])

    def share(what: Callable[[ScoredClip], np.ndarray], of: Callable[[ScoredClip], np.ndarray]) -> Value | None:
        return pool.mean(lambda c: (what(c) & of(c)).sum(), lambda c: of(c).sum())

    return {
        "median_px": pool.median(lambda c: c.error_px[c.seen]),
        "within_16": share(lambda c: c.near, lambda c: c.seen),
        "moved_median_px": pool.median(lambda c: c.error_px[c.seen & c.moves]),
        "moved_within_16": share(lambda c: c.near, lambda c: c.seen & c.moves),
        "never_beyond_50": pool.mean(lambda c: (c.worst_px <= BEYOND_PX).sum(), lambda c: len(c.worst_px)),
        "identity_errors": share(lambda c: c.mixed, lambda c: c.seen),
        "hidden_called_visible": share(lambda c: c.answers.visible, lambda c: ~c.seen),
        "occluded_called_visible": share(lambda c: c.answers.visible, lambda c: c.state == "occluded"),
        "out_called_visible": share(lambda c: c.answers.visible, lambda c: c.state == "out"),
        "lost_p_near": pool.median(lambda c: c.answers.lost_p[c.near]),
        "lost_p_far": pool.median(lambda c: c.answers.lost_p[c.error_px > far_px]),
        "lost_p_hidden": pool.median(lambda c: c.answers.lost_p[~c.seen]),
        "lost_auroc": pool.statistic(
            lambda times: ranked_auroc(rank, wrong, times[owner].astype(float)), count=len(lost_p)
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

    ``found`` is as of :func:`quest.evaluation.real.run.discover`.
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
    pool = Pool(pictures, resamples=resamples, seed=seed)
    handles, answers = np.array([len(p.found) for p in pictures]), np.array([len(p.right) for p in pictures])
    hits = np.array([int((p.right & ~p.again).sum()) + int(p.found.sum()) for p in pictures])

    def f1(times: np.ndarray) -> float:
        """Second answers at a handle are wrong."""
        both = times @ answers + times @ handles
        return float(times @ hits / both) if both else np.nan

    def average_precision(boxes: Sequence[Boxes], count: int) -> Value | None:
        """Area under the precision-recall curve of all candidates, made to fall."""
        score, first = (np.concatenate([getattr(b, name) for b in boxes]) for name in ("score", "first"))
        own, labelled = np.repeat(pool.owner, [len(b.score) for b in boxes]), np.array([b.labelled for b in boxes])
        order = np.argsort(-score, kind="stable")
        first, own = first[order], own[order]

        def area(times: np.ndarray) -> float:
            present, weight = times @ labelled, times[own]
            if not present:
                return np.nan
            hits, answers = np.cumsum(weight * first), np.cumsum(weight)
            precision = np.maximum.accumulate((hits / np.maximum(answers, 1))[::-1])[::-1]
            return float(np.sum(np.diff(hits, prepend=0) * precision) / present)

        return pool.statistic(area, count=count)

    candidates = [Boxes(p.score, p.first, len(p.found)) for p in pictures]
    measures: dict[str, Value | None] = {
        "recall": pool.mean(lambda p: p.found.sum(), lambda p: len(p.found)),
        "precision": pool.mean(lambda p: p.right.sum(), lambda p: len(p.right)),
        "f1": pool.statistic(f1, count=int(handles.sum())),
        "ap": average_precision(candidates, sum(len(p.score) for p in pictures)),
    }
    for low, high in pairwise(SIZES_PX):
        name = f"recall_{low}_to_{high}_px" if np.isfinite(high) else f"recall_above_{low}_px"
        sized = [(p.size_px >= low) & (p.size_px < high) for p in pictures]
        found = np.array([(p.found & own).sum() for p, own in zip(pictures, sized, strict=True)], float)
        measures[name] = pool.ratio(Sums(found, np.array([own.sum() for own in sized], float)))
    for kind in dict.fromkeys(kind for picture in pictures for kind in picture.boxes):
        boxes = [picture.boxes[kind] for picture in pictures]
        measures[f"ap50_{kind}"] = average_precision(boxes, sum(b.labelled for b in boxes))
    return measures
