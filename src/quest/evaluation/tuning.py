"""Fit the finder's scores, so that 0.7 is right in 70 of 100, and choose the threshold of discovery.

Both on labelled pictures and on simulated takes of validation objects, each of which counts the same however many
answers it has. Scores become probabilities by a slope and a shift of their log odds (Platt, *Probabilistic outputs for
support vector machines*, 1999): those of handles and knobs by both, those of doors and drawers by the pictures. At the
threshold the least of their precisions and recalls is greatest: what is overlooked and what is wrong weigh the same,
and no kind of picture pays for the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.special import expit

from quest.errors import ConfigError
from quest.evaluation.real.measures import score_picture
from quest.evaluation.real.run import discover
from quest.evaluation.real.sets import Picture
from quest.evaluation.selection import Chosen
from quest.model.finder import PANELS
from quest.track import Tracker
from quest.track.settings import TrackerConfig
from quest.types import GRIPS, LABELS, Take

_NEAR = 16 / 640
"""An answer in a take is right at its entity's outline, or this close to it, in widths of the picture."""


@dataclass(frozen=True)
class Answers:
    """What was found somewhere."""

    logit: Float[np.ndarray, " A"]
    """Of each answer, as the network says it."""
    right: Bool[np.ndarray, " A"]
    """Which of them are right, and the best of their entity."""
    present: int
    """How many entities there are."""


@dataclass(frozen=True)
class Tuned:
    """What came of it."""

    config: TrackerConfig
    """With the slopes, shifts and threshold."""
    of: tuple[str, ...]
    """``pictures`` and ``takes``, those that there are."""
    precision: tuple[float, ...]
    """Of discovery in each."""
    recall: tuple[float, ...]


def tune(tracker: Tracker, pictures: Sequence[Picture], takes: Chosen) -> Tuned:
    """Fit scores and threshold.

    Pictures did not teach; takes, of which the first frames are used, are of validation objects.

    Raises:
        ConfigError: there is nothing to choose by, nothing was found, or a take is not of a validation object.
    """
    parts = [item for _, chosen in takes for item in chosen.items()]
    wrong = [name for name, part in parts if part != "validation"]
    if wrong:
        raise ConfigError(f"tuning: expected takes of validation objects only, got {wrong[:3]}")
    config = replace(tracker.config, gain=1.0, bias=0.0, panel_gain=1.0, panel_bias=0.0)
    plain = Tracker(tracker.network, config, device=tracker.device)
    scored = [score_picture(picture, discover(plain, picture.read())) for picture in pictures]
    grips = {"pictures": _joined([Answers(s.score, s.first, len(s.found)) for s in scored])} if scored else {}
    grips |= {"takes": _in_takes(plain, takes, GRIPS)} if parts else {}
    if not any(answers.right.any() for answers in grips.values()):
        raise ConfigError(
            "tuning: nothing was found rightly in the pictures and takes given; train first, or give more"
        )
    gain, bias = _fit(list(grips.values()))
    config = replace(tracker.config, gain=gain, bias=bias)
    boxes = [s.boxes[kind] for s in scored for kind in PANELS if kind in s.boxes]
    panels = _joined([Answers(b.score, b.first, b.labelled) for b in boxes]) if scored else None
    if panels is not None and panels.right.any():
        panel_gain, panel_bias = _fit([panels])
        config = replace(config, panel_gain=panel_gain, panel_bias=panel_bias)
    found = {name: replace(a, logit=gain * a.logit + bias) for name, a in grips.items()}
    if parts:
        found["takes"] = _in_takes(Tracker(tracker.network, config, device=tracker.device), takes, LABELS)
    threshold = _best_threshold(list(found.values()))
    rates = [_rates(answers, np.array([threshold])) for answers in found.values()]
    precision, recall = zip(*((float(p[0]), float(r[0])) for p, r in rates), strict=True)
    return Tuned(replace(config, threshold=float(expit(threshold))), tuple(found), precision, recall)


def _joined(answers: Sequence[Answers]) -> Answers:
    """Those of several pictures."""
    logit, right = (np.concatenate([getattr(a, name) for a in answers]) for name in ("logit", "right"))
    return Answers(logit, right, sum(a.present for a in answers))


def _in_takes(tracker: Tracker, takes: Chosen, labels: Sequence[str]) -> Answers:
    """What of some labels was found in first frames."""
    logits: list[float] = []
    right: list[bool] = []
    present = 0
    for store, name in ((store, name) for store, chosen in takes for name in chosen):
        take = store.read(name, frames=slice(0, 1))
        for view in range(len(take.views)):
            clip = take.views[view].clip
            found = tracker.find(clip.rgb[0])
            found = found.select(np.isin(found.labels, labels))
            hits, seen = _match(take, view, found.uv_px, labels)
            logits, right, present = logits + found.logit.tolist(), right + hits, present + seen
    return Answers(np.array(logits), np.array(right, bool), present)


def _match(take: Take, view: int, uv_px: Float[np.ndarray, "A 2"], labels: Sequence[str]) -> tuple[list[bool], int]:
    """Which answers, best first, are right in a take's first frame, and how many entities of the labels are seen."""
    truth = take.views[view]
    entities = [int(e) for e in take.tracked if truth.visible[0, e] and take.info.entities[int(e)].label in labels]
    height, width = truth.entity_id.shape[1:]
    gap = np.linalg.norm(uv_px[:, None] - truth.uv_px[0, entities], axis=-1)
    column, row = np.clip(uv_px.astype(int), 0, (width - 1, height - 1)).T
    on = truth.entity_id[0, row, column][:, None] == 1 + np.array(entities, int)
    gap = np.where(on | (gap < _NEAR * width), gap, np.inf)
    hits = []
    for k in range(len(gap)):
        e = int(gap[k].argmin()) if entities else -1
        hits.append(e >= 0 and bool(np.isfinite(gap[k, e])))
        if hits[-1]:
            gap[:, e] = np.inf
    return hits, len(entities)


def _fit(sets: Sequence[Answers]) -> tuple[float, float]:
    """Slope and shift of least cross-entropy in the mean over sets."""

    def loss(parameters: Float[np.ndarray, "2"]) -> float:
        total = 0.0
        for answers in sets:
            logit = parameters[0] * answers.logit + parameters[1]
            total += float(np.logaddexp(0, np.where(answers.right, -logit, logit)).mean()) if len(logit) else 0.0
        return total

    gain, bias = minimize(loss, np.array([1.0, 0.0]), method="BFGS").x
    return float(gain), float(bias)


def _best_threshold(sets: Sequence[Answers]) -> float:
    """Log odds where the least of all precisions and recalls is greatest."""
    logits = np.unique(np.concatenate([answers.logit for answers in sets]))[::-1]
    rates = np.array([_rates(answers, logits) for answers in sets])
    best = int(rates.min(axis=(0, 1)).argmax())
    return float(logits[best] if best + 1 == len(logits) else (logits[best] + logits[best + 1]) / 2)


def _rates(
    answers: Answers, thresholds: Float[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Precision and recall if what is not below a threshold counts; thresholds fall."""
    order = np.argsort(-answers.logit, kind="stable")
    right = np.concatenate([[0], np.cumsum(answers.right[order])])
    taken = np.searchsorted(-answers.logit[order], -thresholds, side="right")
    return right[taken] / np.maximum(taken, 1), right[taken] / max(answers.present, 1)
