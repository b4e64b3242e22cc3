"""Fit the monitor to recorded streams of validation objects.

Objects are parted in two. The streams of one part, with and without losses, fit the calibrator and choose the
statistic; the loss-free streams of the other part, one per object, give the maxima that thresholds are made of. So no
threshold rests on streams that anything was fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float32
from scipy.optimize import minimize
from torch import Tensor

from quest.errors import ConfigError
from quest.evaluation.detectors import choose, fit_part, loss_free_maxima, replay_features, replay_logits
from quest.evaluation.drift import auroc, calibration_error
from quest.evaluation.stream_record import StreamRecord, by_unit
from quest.monitor import SIGNALS, Calibration
from quest.monitor import memory as memories
from quest.monitor.calibration import Unit, rounded
from quest.monitor.calibrator import LOGIT_LIMIT, Calibrator, probability
from quest.monitor.statistic import Cusum
from quest.track.settings import REVISION

STATISTICS = tuple(Cusum(drift, keep) for keep, drift in product((0.0, 0.5, 0.85, 1.0), (-3.0, -1.0, 0.0, 1.0, 2.0)))
"""What is tried; without keeping anything the statistic is the log odds of the frame itself."""


@dataclass(frozen=True)
class FitConfig:
    """How the calibrator is fitted."""

    folds: int = 4
    """Parts of the objects for cross-validation, and members of the calibrator."""
    hidden: tuple[int, ...] = (0, 24)
    """Numbers of hidden units to try; 0 is a logistic regression."""
    decay: tuple[float, ...] = (1.0, 10.0)
    """Weight decays to try."""
    epochs: int = 15
    """Passes over the frames."""
    rate: float = 0.005
    """Largest learning rate."""
    batch: int = 1024
    """Frames per step."""
    seed: int = 0
    """Of folds, weights and order."""

    def __post_init__(self) -> None:
        if self.folds < 2 or self.epochs < 1 or self.batch < 1 or not self.hidden or not self.decay:
            raise ConfigError(f"calibration: expected at least 2 folds, an epoch and something to try, got {self}")


@dataclass(frozen=True)
class Fitted:
    """What came of it."""

    calibration: Calibration
    """To be stored with the weights."""
    objects: int
    """That the calibrator was fitted on."""
    streams: int
    """Of these."""
    frames: int
    """(frame, query) pairs of these."""
    lost_frames: int
    """Of these."""
    hidden: int
    """Chosen number of hidden units."""
    decay: float
    """Chosen weight decay."""
    auroc: float
    """Per frame, cross-validated over objects."""
    ece: float
    """Per frame, cross-validated over objects."""
    delay: float
    """Mean delay of the chosen statistic on these streams, frames."""


@dataclass(frozen=True)
class _Frames:
    """Frames to fit on."""

    x: Float32[np.ndarray, "N F"]
    """Features."""
    lost: Bool[np.ndarray, " N"]
    """Truth."""
    fold: np.ndarray
    """Of the frame's object."""


def fit_calibration(
    records: Sequence[StreamRecord],
    *,
    config: FitConfig | None = None,
    block_frames: int | None = None,
    unit: Unit = "object",
) -> Fitted:
    """Fit calibrator, statistic and maxima.

    Args:
        records: streams of validation objects.
        config: how to fit.
        block_frames: length of the streams that thresholds rest on; shorter ones are left out, longer ones cut. That
            of the shortest stream by default.
        unit: what promises are to be about.

    Raises:
        ConfigError: a stream is not of a validation object, or they do not suffice.
    """
    config = FitConfig() if config is None else config
    records = by_unit(records, unit)
    wrong = [r.take for r in records if r.part != "validation"]
    if wrong or not records:
        raise ConfigError(f"calibration: expected streams of validation objects only, got {wrong[:3] or 'none'}")
    block_frames = min(len(r) for r in records) if block_frames is None else block_frames
    fit, rest = fit_part(records)
    objects = sorted({r.object_id for r in fit})
    if len(objects) < config.folds or not any(r.lost[r.watched].any() for r in fit):
        raise ConfigError(
            f"calibration: expected at least {config.folds} objects to fit on and a loss among them, got "
            f"{len(objects)} objects; record more takes"
        )
    blank = _blank(fit)
    features = replay_features(blank, fit)
    order = np.random.default_rng(config.seed).permutation(len(objects)) % config.folds
    fold = np.array([order[objects.index(r.object_id)] for r in fit])
    frames = _Frames(
        np.concatenate([x[r.watched] for x, r in zip(features, fit, strict=True)]),
        np.concatenate([r.lost[r.watched] for r in fit]),
        np.repeat(fold, [int(r.watched.sum()) for r in fit]),
    )
    members, hidden, decay = _best_members(frames, config)
    held_out = np.empty(len(frames.lost))
    for i, member in enumerate(members):
        held_out[frames.fold == i] = _calibrator(blank, [member]).logit(frames.x[frames.fold == i].astype(np.float64))
    slope, shift = _platt(held_out, frames.lost)
    calibrator = rounded(_calibrator(blank, [_scaled(m, slope, shift) for m in members]))
    logit = np.clip(slope * held_out + shift, -LOGIT_LIMIT, LOGIT_LIMIT)
    statistic, delay = _statistic(logit, fit, block_frames)
    maxima = loss_free_maxima(
        statistic, rest, replay_logits(calibrator, replay_features(calibrator, rest)), block_frames=block_frames
    )
    same = " of the same objects" if unit == "take" else ""
    about = (
        f"fitted on {len(fit)} streams of {len(objects)} {unit}s ({frames.lost.mean():.1%} of frames lost); thresholds "
        f"from {len(maxima)} loss-free streams of as many other {unit}s{same}, {block_frames} frames each"
    )
    return Fitted(
        calibration=Calibration(calibrator, statistic, maxima, block_frames, about, REVISION, unit),
        objects=len(objects),
        streams=len(fit),
        frames=len(frames.lost),
        lost_frames=int(frames.lost.sum()),
        hidden=hidden,
        decay=decay,
        auroc=auroc(logit, frames.lost),
        ece=calibration_error(probability(_corrected(held_out, frames)), frames.lost),
        delay=delay,
    )


def _statistic(logit: np.ndarray, fit: Sequence[StreamRecord], block_frames: int) -> tuple[Cusum, float]:
    """The statistic that finds the losses of these streams soonest, on log odds that come from other objects."""
    ends = np.cumsum([int(r.watched.sum()) for r in fit])
    evidence = [np.zeros(r.lost.shape) for r in fit]
    for own, values, r in zip(evidence, np.split(logit, ends[:-1]), fit, strict=True):
        own[r.watched] = values
    statistic, delays = choose(STATISTICS, evidence, fit, block_frames=block_frames)
    return statistic, min(delays)


def _blank(records: Sequence[StreamRecord]) -> Calibrator:
    """A calibrator that only knows what is usual of the signals."""
    values = np.concatenate([r.signals[r.watched] for r in records]).astype(np.float64)
    values[~np.isfinite(values)] = np.nan
    center, scale = np.zeros(len(SIGNALS)), np.ones(len(SIGNALS))
    for s in range(len(SIGNALS)):
        known = values[~np.isnan(values[:, s]), s]
        if not len(known):
            continue
        low, center[s], high = np.quantile(known, (0.25, 0.5, 0.75))
        spread = (high - low) / 1.349  # of a normal distribution: its standard deviation
        scale[s] = next((float(v) for v in (spread, known.std()) if v > 1e-6), 1.0)
    return Calibrator(
        center=center,
        scale=scale,
        direct=np.zeros((1, memories.FEATURES)),
        inner=np.zeros((1, memories.FEATURES, 0)),
        inner_bias=np.zeros((1, 0)),
        outer=np.zeros((1, 0)),
        bias=np.zeros(1),
    )


_Member = dict[str, np.ndarray]


def _best_members(frames: _Frames, config: FitConfig) -> tuple[list[_Member], int, float]:
    """One member per fold, fitted to the other folds, with the settings of the least cross-validated loss."""
    best: tuple[float, list[_Member], int, float] | None = None
    for hidden, decay in product(config.hidden, config.decay):
        members, loss = [], 0.0
        for fold in range(config.folds):
            out = frames.fold == fold
            member = _train(frames.x[~out], frames.lost[~out], hidden, decay, config)
            logit = _forward({k: torch.from_numpy(v) for k, v in member.items()}, torch.from_numpy(frames.x[out]))
            target = torch.from_numpy(frames.lost[out]).float()
            loss += float(torch.nn.functional.binary_cross_entropy_with_logits(logit, target, reduction="sum"))
            members.append(member)
        if best is None or loss < best[0]:
            best = (loss, members, hidden, decay)
    assert best is not None
    return best[1:]


def _train(
    x: Float32[np.ndarray, "N F"], lost: Bool[np.ndarray, " N"], hidden: int, decay: float, config: FitConfig
) -> _Member:
    """Fit one member by the mean log loss: frames keep their natural frequency, so that probabilities come out."""
    generator = torch.Generator().manual_seed(config.seed)
    features, target = torch.from_numpy(x), torch.from_numpy(lost).float()
    share = float(target.mean().clamp(1e-4, 1.0 - 1e-4))
    weights = {
        "direct": torch.zeros(x.shape[1]),
        "inner": torch.randn(x.shape[1], hidden, generator=generator) / x.shape[1] ** 0.5,
        "inner_bias": torch.zeros(hidden),
        "outer": torch.zeros(hidden),
        "bias": torch.tensor(share).logit(),
    }
    for value in weights.values():
        value.requires_grad_()
    decayed = [{"params": [v for k, v in weights.items() if "bias" not in k], "weight_decay": decay}]
    optimiser = torch.optim.AdamW(
        [*decayed, {"params": [v for k, v in weights.items() if "bias" in k], "weight_decay": 0.0}], lr=config.rate
    )
    steps = config.epochs * -(-len(x) // config.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(config.epochs):
        for index in torch.randperm(len(x), generator=generator).split(config.batch):
            optimiser.zero_grad()
            logit = _forward(weights, features[index])
            torch.nn.functional.binary_cross_entropy_with_logits(logit, target[index]).backward()
            optimiser.step()
            schedule.step()
    return {name: value.detach().numpy() for name, value in weights.items()}


def _forward(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    hidden = torch.tanh(x @ weights["inner"] + weights["inner_bias"])
    return x @ weights["direct"] + hidden @ weights["outer"] + weights["bias"]


def _platt(logit: np.ndarray, lost: np.ndarray) -> tuple[float, float]:
    """Slope and shift of the log odds that make held-out probabilities right.

    Reference: Platt, Probabilistic outputs for support vector machines, 1999.
    """

    def loss(at: np.ndarray) -> tuple[float, np.ndarray]:
        odds = at[0] * logit + at[1]
        wrong = probability(odds) - lost
        return float((np.logaddexp(0.0, odds) - lost * odds).mean()), np.array([(wrong * logit).mean(), wrong.mean()])

    found = minimize(loss, np.array([1.0, 0.0]), jac=True, method="L-BFGS-B", bounds=[(0.1, 3.0), (None, None)])
    return float(found.x[0]), float(found.x[1])


def _corrected(held_out: np.ndarray, frames: _Frames) -> np.ndarray:
    """Log odds whose slope and shift come from the other folds too."""
    odds = np.empty_like(held_out)
    for i in np.unique(frames.fold):
        own = frames.fold == i
        slope, shift = _platt(held_out[~own], frames.lost[~own])
        odds[own] = slope * held_out[own] + shift
    return np.clip(odds, -LOGIT_LIMIT, LOGIT_LIMIT)


def _scaled(member: _Member, slope: float, shift: float) -> _Member:
    after = {name: slope * member[name] for name in ("direct", "outer")}
    return member | after | {"bias": slope * member["bias"] + shift}


def _calibrator(blank: Calibrator, members: Sequence[_Member]) -> Calibrator:
    return Calibrator(
        center=blank.center,
        scale=blank.scale,
        **{name: np.stack([np.asarray(m[name], np.float64) for m in members]) for name in members[0]},
    )
