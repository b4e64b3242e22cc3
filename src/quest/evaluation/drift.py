"""How well drift is detected: scores of frames, and alarms of streams. ``docs/metrics.md`` has the definitions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import beta

from quest.evaluation.bootstrap import LEVEL
from quest.evaluation.stream_record import StreamRecord, duration_s, runs

DEADLINE_FRAMES = 30
"""A loss is missed if no alarm comes within this many frames of its first, or before it ends if that is later."""

LASTING_S = 0.5
"""A loss that does not last so long, or whose stream ends sooner, is not judged: nobody could have said much yet."""

BINS = 15
"""Of the calibration error, equally wide."""


@dataclass(frozen=True)
class Loss:
    """The first lasting loss of a query in a stream, or its first where none lasts."""

    query: int
    first: int
    """The first frame in which the query is lost at all."""
    start: int
    deadline: int
    """The frame after the last one in which an alarm still counts."""
    lasts: bool
    """Whether it lasts for :data:`LASTING_S`; others are not judged."""


def losses(record: StreamRecord) -> list[Loss]:
    """One loss of each query that is ever lost; later ones depend on whether the first alarm was cleared."""
    found = []
    for k in range(record.band.shape[1]):
        spans = runs(record.lost[:, k])
        lasting = [span for span in spans if duration_s(record.stamp_s, *span) >= LASTING_S]
        for start, end in (lasting or spans)[:1]:
            deadline = min(max(start + DEADLINE_FRAMES, end), len(record))
            found.append(Loss(k, spans[0][0], start, deadline, lasts=bool(lasting)))
    return found


def delay_of(loss: Loss, above: Bool[np.ndarray, " T"]) -> float:
    """Frames from the start of a loss to the first frame, at or after it, that alarms; infinite if it is missed."""
    frames = np.flatnonzero(above[loss.start : loss.deadline])
    return float(frames[0]) if len(frames) else math.inf


def auroc(score: Float[np.ndarray, " M"], lost: Bool[np.ndarray, " M"]) -> float:
    """Area under the ROC curve: how often a lost frame scores higher than another one, ties counting half.

    Args:
        score: per frame and query; the larger, the more it speaks for a loss.
        lost: truth.

    Returns:
        NaN if there are only lost frames, or none.
    """
    return ranked_auroc(np.unique(score, return_inverse=True)[1], lost, np.ones(len(score)))


def ranked_auroc(rank: Int[np.ndarray, " M"], lost: Bool[np.ndarray, " M"], weight: Float[np.ndarray, " M"]) -> float:
    """:func:`auroc` of weighted frames whose scores have been ranked before, which resampling needs again and again."""
    bad = np.bincount(rank, weights=weight * lost)
    good = np.bincount(rank, weights=weight * ~lost)
    pairs = bad.sum() * good.sum()
    return float((bad * (np.cumsum(good) - 0.5 * good)).sum() / pairs) if pairs > 0 else math.nan


def augrc(area: float, share: float) -> float:
    """Area under the generalised risk-coverage curve: mean share of all frames that are accepted and lost.

    Frames are accepted in the order of their scores, the least suspicious first.
    ``area`` is the AUROC, ``share`` that of lost frames.

    Reference: Traub et al., Overcoming common flaws in the evaluation of selective classification systems, NeurIPS
    2024, equation 6.
    """
    return (1.0 - area) * share * (1.0 - share) + 0.5 * share**2


def calibration_error(
    p: Float[np.ndarray, " M"], lost: Bool[np.ndarray, " M"], weight: Float[np.ndarray, " M"] | None = None
) -> float:
    """Expected calibration error: mean over frames of | mean P(lost) - share lost | in the frame's bin of P(lost).

    Reference: Guo et al., On calibration of modern neural networks, ICML 2017, equation 3.
    """
    weight = np.ones(len(p)) if weight is None else weight
    index = np.minimum((p * BINS).astype(int), BINS - 1)
    said = np.bincount(index, weights=weight * p, minlength=BINS)
    true = np.bincount(index, weights=weight * lost, minlength=BINS)
    return float(np.abs(said - true).sum() / weight.sum())


def clopper_pearson(hits: int, trials: int) -> tuple[float, float]:
    """Exact 95 % interval of a share.

    Reference: Clopper and Pearson, Biometrika 26, 1934.
    """
    tail = (1.0 - LEVEL) / 2.0
    low = float(beta.ppf(tail, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1.0 - tail, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def quantile(value: Float[np.ndarray, " M"], share: float, weight: Float[np.ndarray, " M"] | None = None) -> float:
    """The least value that at least this share of the weight does not exceed; infinite values take part.

    Returns:
        NaN without any weight.
    """
    weight = np.ones(len(value)) if weight is None else weight
    if not weight.sum() > 0:
        return math.nan
    order = np.argsort(value, kind="stable")
    below = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(below, share * below[-1] * (1.0 - 1e-12))])
