"""Choose the threshold of discovery on validation objects.

It is the one with the best F2 in the first frame, in which recall counts twice as much as precision (a false entity
costs one more track, a missed one is not followed at all), in the mean over the sources of the objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from quest.errors import ConfigError
from quest.evaluation.selection import Chosen
from quest.geometry import transform
from quest.model.discovery import Peaks, match_peaks
from quest.track import Tracker
from quest.types import LABELS, Take

_BETA = 2.0


@dataclass(frozen=True)
class Tuned:
    """What came of it."""

    slot_bias: float
    """Bias of the affordance logit."""
    precision: float
    """Of discovery with it."""
    recall: float
    """Of discovery with it."""


def discovery_bias(tracker: Tracker, takes: Chosen) -> Tuned:
    """Bias of the affordance logit at which discovery in the first frame has its best F2; its precision and recall.

    A slot counts as right if an unclaimed visible entity of its label lies within 0.1 of it in 3D. Where none is, no
    threshold is best, and the bias stays what it is. F2, precision and recall are means over the sources of the objects
    (PartNet-Mobility, procedural, your own), each of which counts the same however many takes it has.

    Args:
        tracker: with the network, and the bias to start from.
        takes: stores with takes of validation objects.

    Raises:
        ConfigError: a take is not of a validation object, or there are none.
    """
    parts = [item for _, chosen in takes for item in chosen.items()]
    wrong = [name for name, part in parts if part != "validation"]
    if wrong or not parts:
        raise ConfigError(f"tuning: expected takes of validation objects only, got {wrong[:3] or 'none'}")
    seen: dict[str, _Found] = {}
    for store, name in ((store, name) for store, chosen in takes for name in chosen):
        take = store.read(name, frames=slice(0, 1))
        found = seen.setdefault(take.info.source, _Found())
        for view in range(len(take.views)):
            clip = take.views[view].clip
            found.add(tracker.candidates(clip.camera, clip.frame(0)), take, view)
    sources = [found for found in seen.values() if found.present]
    if not any(any(found.hits) for found in sources):
        return Tuned(tracker.config.slot_bias, 0.0, 0.0)
    logits = np.unique([logit for found in sources for logit in found.logits])[::-1]
    rates = np.array([found.at(logits) for found in sources])
    precision, recall = rates.mean(axis=0)
    best = int(np.mean([_f_beta(*each) for each in rates], axis=0).argmax())
    threshold = logits[best] if best + 1 == len(logits) else (logits[best] + logits[best + 1]) / 2
    return Tuned(-float(threshold), float(precision[best]), float(recall[best]))


@dataclass
class _Found:
    """What was found in the first frames of takes of one source."""

    logits: list[float] = field(default_factory=list)
    """Of all candidates."""
    hits: list[bool] = field(default_factory=list)
    """Which of them are right."""
    present: int = 0
    """How many entities are seen."""

    def add(self, peaks: Peaks, take: Take, view: int) -> None:
        """Candidates of one view."""
        hits, present = _match(take, view, peaks)
        self.logits += peaks.logit.tolist()
        self.hits += hits
        self.present += present

    def at(self, thresholds: Float[np.ndarray, " N"]) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Precision and recall if what is not below a threshold counts; thresholds fall."""
        order = np.argsort(-np.array(self.logits))
        right = np.concatenate([[0], np.cumsum(np.array(self.hits, int)[order])])
        taken = np.searchsorted(-np.array(self.logits)[order], -thresholds, side="right")
        return right[taken] / np.maximum(taken, 1), right[taken] / self.present


def _f_beta(precision: Float[np.ndarray, " N"], recall: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    total = _BETA**2 * precision + recall
    return np.divide((1 + _BETA**2) * precision * recall, total, out=np.zeros_like(total), where=total > 0)


def _match(take: Take, view: int, peaks: Peaks) -> tuple[list[bool], int]:
    """Which candidates of a view's first frame are right, and how many entities are seen in it."""
    truth = take.views[view]
    entities = [int(e) for e in take.tracked if truth.visible[0, e]]
    point_m = transform(torch.from_numpy(truth.clip.cam_from_world[0]).float(), torch.from_numpy(take.point_world[0]))
    found = match_peaks(
        peaks.point_m.cpu(),
        peaks.label.cpu(),
        point_m[entities],
        torch.tensor([LABELS.index(take.info.entities[e].label) for e in entities], dtype=torch.long),
        half_diagonal_m=take.info.half_diagonal_m,
    )
    return (found >= 0).tolist(), len(entities)
