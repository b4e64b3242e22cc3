"""Fit the monitor to recorded streams of validation objects.

Objects are parted in two. The streams of one part, with and without losses, make the tracker's log odds right and
choose the statistic; the loss-free streams of the other part, one per object, give the maxima that thresholds are made
of. So no threshold rests on streams that anything was fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from quest.errors import ConfigError
from quest.evaluation.detectors import choose, fit_part, loss_free_maxima
from quest.evaluation.drift import auroc, calibration_error
from quest.evaluation.stream_record import StreamRecord, by_unit
from quest.monitor import Calibration, probability
from quest.monitor.calibration import Unit, adjusted
from quest.monitor.statistic import Cusum
from quest.track.settings import REVISION

STATISTICS = (
    Cusum(0.0, keep=0.0),
    *(Cusum(drift, keep) for keep, drift in product((0.5, 0.85, 1.0), (-3.0, -1.0, 0.0, 1.0, 2.0))),
)
"""What is tried; without keeping anything the statistic is the log odds of the frame itself, of which a drift would
change nothing but when an alarm ends."""

FOLDS = 4
"""Parts of the objects for cross-validation."""

_SLOPES = (0.05, 5.0)
_SHIFTS = (-20.0, 20.0)
_DECIMALS = 4
"""Of slope and shift, which are written as they are used."""


@dataclass(frozen=True)
class Fitted:
    """What came of it."""

    calibration: Calibration
    """To be written into the file of calibrations."""
    objects: int
    streams: int
    frames: int
    """(frame, query) pairs of these that are right or lost."""
    lost_frames: int
    auroc: float
    """Per frame."""
    ece: float
    """Per frame, cross-validated over objects."""
    delay: float
    """Mean delay of the chosen statistic on these streams, frames."""


def fit_calibration(
    records: Sequence[StreamRecord], *, block_frames: int | None = None, unit: Unit = "object"
) -> Fitted:
    """Fit slope and shift, statistic and maxima.

    Args:
        records: streams of validation objects, all with depth or all of colours alone.
        block_frames: length of the streams that thresholds rest on; shorter ones are left out, longer ones cut. That
            of the shortest stream by default.
        unit: what promises are to be about.

    Raises:
        ConfigError: a stream is not of a validation object, they are not alike, or they do not suffice.
    """
    records = by_unit(records, unit)
    wrong = [r.take for r in records if r.part != "validation"]
    if wrong or not records:
        raise ConfigError(f"calibration: expected streams of validation objects only, got {wrong[:3] or 'none'}")
    if len({r.inputs for r in records}) > 1:
        raise ConfigError("calibration: expected streams with depth or of colours alone, got both; fit each apart")
    block_frames = min(len(r) for r in records) if block_frames is None else block_frames
    fit, rest = fit_part(records)
    objects = sorted({r.object_id for r in fit})
    if len(objects) < FOLDS or all(r.loss_free for r in fit):
        raise ConfigError(
            f"calibration: expected at least {FOLDS} objects to fit on and a loss among them, got {len(objects)} "
            "objects; record more takes"
        )
    log_odds = np.concatenate([r.log_odds[r.judged] for r in fit]).astype(np.float64)
    lost = np.concatenate([r.lost[r.judged] for r in fit])
    owner = np.repeat([objects.index(r.object_id) for r in fit], [int(r.judged.sum()) for r in fit])
    slope, shift = (round(value, _DECIMALS) for value in _platt(log_odds, lost))
    evidence, others = ([adjusted(r.log_odds, slope=slope, shift=shift) for r in part] for part in (fit, rest))
    statistic, delays = choose(STATISTICS, evidence, fit, block_frames=block_frames)
    maxima = loss_free_maxima(statistic, rest, others, block_frames=block_frames)
    same = " of the same objects" if unit == "take" else ""
    about = (
        f"fitted on {len(fit)} streams of {len(objects)} {unit}s ({lost.mean():.1%} of frames lost); thresholds "
        f"from {len(maxima)} loss-free streams of as many other {unit}s{same}, {block_frames} frames each"
    )
    return Fitted(
        calibration=Calibration(slope, shift, statistic, maxima, block_frames, about, REVISION, unit),
        objects=len(objects),
        streams=len(fit),
        frames=len(lost),
        lost_frames=int(lost.sum()),
        auroc=auroc(log_odds, lost),
        ece=calibration_error(_held_out(log_odds, lost, owner), lost),
        delay=min(delays),
    )


def _platt(log_odds: Float[np.ndarray, " N"], lost: Bool[np.ndarray, " N"]) -> tuple[float, float]:
    """Slope and shift that make log odds right.

    Reference: Platt, Probabilistic outputs for support vector machines, 1999.
    """

    def loss(at: np.ndarray) -> tuple[float, np.ndarray]:
        logit = at[0] * log_odds + at[1]
        wrong = probability(logit) - lost
        gradient = np.array([(wrong * log_odds).mean(), wrong.mean()])
        return float((np.logaddexp(0.0, logit) - lost * logit).mean()), gradient

    found = minimize(loss, np.array([1.0, 0.0]), jac=True, method="L-BFGS-B", bounds=[_SLOPES, _SHIFTS])
    return float(found.x[0]), float(found.x[1])


def _held_out(
    log_odds: Float[np.ndarray, " N"], lost: Bool[np.ndarray, " N"], owner: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """P(lost) of every frame, with slope and shift from the objects of the other folds."""
    fold = np.random.default_rng(0).permutation(int(owner.max()) + 1)[owner] % FOLDS
    found = np.empty(len(lost))
    for own in (fold == i for i in range(FOLDS)):
        slope, shift = _platt(log_odds[~own], lost[~own])
        found[own] = probability(adjusted(log_odds[own], slope=slope, shift=shift))
    return found
