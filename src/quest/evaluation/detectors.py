"""The monitor and the rules that it is compared with, each calibrated by the same rule on the same streams.

Every detector collects evidence with a statistic and alarms where that exceeds a conformal threshold. The monitor's
evidence is calibrated log odds of a loss; that of the others is the tracker's own probability of one, uncalibrated.
Recorded streams are played many at once; the monitor itself does the same frame by frame.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float64

from quest.errors import ConfigError
from quest.evaluation.drift import DEADLINE_FRAMES, delay_of, losses
from quest.evaluation.stream_record import StreamRecord
from quest.monitor import Calibration, probability
from quest.monitor.conformal import Budget, Threshold, threshold
from quest.monitor.statistic import Cusum, Latest, PageHinkley, Statistic


def replay_statistic(
    statistic: Statistic,
    evidence: Sequence[Float64[np.ndarray, "_ _"]],
    records: Sequence[StreamRecord],
    *,
    block_frames: int,
) -> list[Float64[np.ndarray, "_ _"]]:
    """The statistic in every frame and query; minus infinity before a query was asked.

    It starts from nothing at the beginning of every block, and stays as it is where the evidence is NaN.
    """
    by_length: dict[int, list[int]] = defaultdict(list)
    for i, record in enumerate(records):
        by_length[len(record)].append(i)
    found: list[np.ndarray] = [np.empty(0)] * len(records)
    for batch in by_length.values():
        joined = np.concatenate([evidence[i] for i in batch], axis=1)
        watched = np.concatenate([records[i].watched for i in batch], axis=1)
        cuts = np.cumsum([records[i].band.shape[1] for i in batch])[:-1]
        path = np.full(joined.shape, -np.inf)
        state = np.zeros((joined.shape[1], statistic.size))
        for t, active in enumerate(watched & ~np.isnan(joined)):
            if t % block_frames == 0:
                state[:] = 0.0
            elif t:
                path[t] = path[t - 1]
            state[active], path[t, active] = statistic.update(state[active], joined[t, active])
        for i, own in zip(batch, np.split(path, cuts, axis=1), strict=True):
            found[i] = own
    return found


AnyStatistic = TypeVar("AnyStatistic", bound=Statistic)

FIT_PERCENT = 40
"""Share of the objects whose streams anything is fitted to; those of the others give the thresholds."""

_JUDGED_AT = (0.05, 0.1)

_CUSUM_DRIFTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
_PAGE_HINKLEY_DELTAS = (0.0, 0.005, 0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Detector:
    """Something that raises alarms."""

    name: str
    statistic: Statistic
    maxima: Float64[np.ndarray, " n"]
    """Of the statistic in loss-free calibration streams; ascending."""
    block_frames: int
    """Length of these streams."""
    calibration: Calibration | None = None
    """The monitor's; None for the rules on the tracker's own probability."""
    probabilistic: bool = False
    """Whether the score of a frame is meant as a probability."""

    def limits(self, frames: int, budget: Budget) -> list[Threshold]:
        """The threshold in each frame of a stream."""
        parts = [
            budget.part(block=b + 1, restart=0, block_frames=self.block_frames)
            for b in range(-(-frames // self.block_frames))
        ]
        blocks = [threshold(self.maxima, part) for part in parts]
        return [blocks[t // self.block_frames] for t in range(frames)]


@dataclass(frozen=True)
class Played:
    """A detector's answers to streams."""

    score: list[np.ndarray]
    """Per stream, frame and query; the larger, the more it speaks for a loss in this frame."""
    path: list[np.ndarray]
    """The statistic; minus infinity before a query was asked."""


def play(detector: Detector, records: Sequence[StreamRecord]) -> Played:
    """A detector's answers to recorded streams."""
    if detector.calibration is None:
        evidence = [doubt(record) for record in records]
    else:
        evidence = [detector.calibration.logit(record.log_odds) for record in records]
    path = replay_statistic(detector.statistic, evidence, records, block_frames=detector.block_frames)
    score = path if detector.calibration is None else [probability(value) for value in evidence]
    return Played(score, path)


def doubt(record: StreamRecord) -> Float64[np.ndarray, "T K"]:
    """The tracker's own probability of a loss; NaN where it has none."""
    return probability(record.log_odds)


def our_monitor(calibration: Calibration) -> Detector:
    """The monitor with a calibration."""
    return Detector(
        "monitor",
        calibration.statistic,
        calibration.maxima,
        calibration.block_frames,
        calibration=calibration,
        probabilistic=True,
    )


def rivals(records: Sequence[StreamRecord], *, block_frames: int) -> tuple[Detector, ...]:
    """CUSUM, Page-Hinkley and a threshold on the tracker's own probability, at their best settings.

    Settings are chosen, as the monitor's are, on the streams that it is fitted on; thresholds come from the others.

    Raises:
        ConfigError: the streams do not suffice.
    """
    fit, rest = fit_part(records)
    evidence = [doubt(record) for record in fit]
    cusum = choose([Cusum(drift) for drift in _CUSUM_DRIFTS], evidence, fit, block_frames=block_frames)
    hinkley = choose([PageHinkley(d) for d in _PAGE_HINKLEY_DELTAS], evidence, fit, block_frames=block_frames)
    plain = {"cusum": cusum[0], "page-hinkley": hinkley[0], "threshold": Latest()}
    found = []
    for name, statistic in plain.items():
        maxima = loss_free_maxima(statistic, rest, [doubt(r) for r in rest], block_frames=block_frames)
        found.append(Detector(name, statistic, maxima, block_frames, probabilistic=name == "threshold"))
    return tuple(found)


def fit_part(records: Sequence[StreamRecord]) -> tuple[list[StreamRecord], list[StreamRecord]]:
    """Streams that are fitted to, and those that give thresholds; no object is in both.

    An object's part follows from its name alone, so that it does not depend on which others there are.
    """
    fit = [r for r in records if _number(f"object {r.object_id}") % 100 < FIT_PERCENT]
    rest = [r for r in records if _number(f"object {r.object_id}") % 100 >= FIT_PERCENT]
    return fit, rest


def one_per_object(records: Sequence[StreamRecord]) -> list[int]:
    """Indices of one stream per object, drawn without looking at what happens in it."""
    chosen: dict[str, int] = {}
    for i, record in enumerate(records):
        other = chosen.get(record.object_id)
        if other is None or _lot(record) < _lot(records[other]):
            chosen[record.object_id] = i
    return sorted(chosen.values())


def one_part(record: StreamRecord, parts: int) -> int:
    """One of so many parts of a stream, drawn without looking at what happens in it."""
    return _number(f"part {record.take} {record.view}") % parts


def loss_free_maxima(
    statistic: Statistic,
    records: Sequence[StreamRecord],
    evidence: Sequence[Float64[np.ndarray, "_ _"]],
    *,
    block_frames: int,
) -> Float64[np.ndarray, " n"]:
    """Largest value of the statistic in the first block of one stream per object, where nothing is lost; ascending.

    Raises:
        ConfigError: no stream is left.
    """
    long = [i for i, record in enumerate(records) if len(record) >= block_frames]
    drawn = [long[i] for i in one_per_object([records[i] for i in long])]
    free = [i for i in drawn if not records[i].lost[:block_frames].any()]
    if not free:
        raise ConfigError(
            f"monitor: expected loss-free streams of at least {block_frames} frames to take thresholds from, found "
            f"none among {len(records)}; record more takes"
        )
    streams = [records[i] for i in free]
    path = replay_statistic(statistic, [evidence[i] for i in free], streams, block_frames=block_frames)
    return np.sort([value[:block_frames].max() for value in path])


def choose(
    candidates: Sequence[AnyStatistic],
    evidence: Sequence[Float64[np.ndarray, "_ _"]],
    records: Sequence[StreamRecord],
    *,
    block_frames: int,
) -> tuple[AnyStatistic, list[float]]:
    """The statistic that finds losses soonest at equal false alarms.

    The judge is the mean delay, a missed loss counting as :data:`~quest.evaluation.drift.DEADLINE_FRAMES`, at
    thresholds from the loss-free ones of the same streams. Ties go to the first.

    Returns:
        The statistic, and the mean delay of every candidate in frames.

    Raises:
        ConfigError: the streams have no loss or none without.
    """
    free = [i for i, record in enumerate(records) if record.loss_free]
    events = [(i, loss) for i, record in enumerate(records) for loss in losses(record) if loss.lasts]
    if not free or not events:
        raise ConfigError(
            f"monitor: expected streams with losses and streams without to fit on, got {len(events)} losses and "
            f"{len(free)} loss-free streams; record more takes"
        )
    delays = []
    for candidate in candidates:
        path = replay_statistic(candidate, evidence, records, block_frames=block_frames)
        maxima = np.sort([path[i].max() for i in free])
        found = []
        for alpha in _JUDGED_AT:
            limit = maxima[min(int(np.ceil(round((len(maxima) + 1) * (1.0 - alpha), 9))), len(maxima)) - 1]
            for i, loss in events:
                found.append(min(delay_of(loss, path[i][:, loss.query] > limit), DEADLINE_FRAMES))
        delays.append(float(np.mean(found)))
    return candidates[int(np.argmin(delays))], delays


def _number(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def _lot(record: StreamRecord) -> int:
    return _number(f"stream {record.take} {record.view}")
