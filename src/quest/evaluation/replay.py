"""Recorded streams through the parts of the monitor, many at once: what the monitor itself does frame by frame."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float32, Float64

from quest.evaluation.stream_record import StreamRecord
from quest.monitor import memory as memories
from quest.monitor.calibrator import Calibrator
from quest.monitor.statistic import Statistic


def replay_features(calibrator: Calibrator, records: Sequence[StreamRecord]) -> list[Float32[np.ndarray, "_ _ F"]]:
    """Features of every frame and query; zero before a query was asked.

    Args:
        calibrator: squashes the signals; its weights do not matter.
        records: the streams.
    """
    found = [np.zeros((*r.lost.shape, memories.FEATURES), np.float32) for r in records]
    for batch in _batches(records):
        signals = np.concatenate([records[i].signals for i in batch], axis=1).astype(np.float64)
        watched = np.concatenate([records[i].watched for i in batch], axis=1)
        cuts = np.cumsum([records[i].lost.shape[1] for i in batch])[:-1]
        memory = memories.start(signals.shape[1])
        for t, active in enumerate(watched):
            memory[active], values = calibrator.step(memory[active], signals[t, active])
            row = np.zeros((len(active), memories.FEATURES))
            row[active] = values
            for i, own in zip(batch, np.split(row, cuts), strict=True):
                found[i][t] = own
    return found


def replay_logits(calibrator: Calibrator, features: Sequence[Float32[np.ndarray, "_ _ F"]]) -> list[np.ndarray]:
    """Log odds of a loss in every frame and query, T by K.

    Args:
        calibrator: the one whose squashing made the features.
        features: from :func:`replay_features`.
    """
    return [calibrator.logit(x.reshape(-1, x.shape[-1]).astype(np.float64)).reshape(x.shape[:2]) for x in features]


def replay_statistic(
    statistic: Statistic,
    evidence: Sequence[Float64[np.ndarray, "_ _"]],
    records: Sequence[StreamRecord],
    *,
    block_frames: int,
) -> list[Float64[np.ndarray, "_ _"]]:
    """The statistic in every frame and query; minus infinity before a query was asked.

    Args:
        statistic: collects the evidence; it starts from nothing at the beginning of every block.
        evidence: per stream.
        records: the streams.
        block_frames: length of a block.
    """
    found: list[np.ndarray] = [np.empty(0)] * len(records)
    for batch in _batches(records):
        joined = np.concatenate([evidence[i] for i in batch], axis=1)
        watched = np.concatenate([records[i].watched for i in batch], axis=1)
        cuts = np.cumsum([records[i].lost.shape[1] for i in batch])[:-1]
        path = np.full(joined.shape, -np.inf)
        state = np.zeros((joined.shape[1], statistic.size))
        for t, active in enumerate(watched):
            if t % block_frames == 0:
                state[:] = 0.0
            state[active], path[t, active] = statistic.update(state[active], joined[t, active])
        for i, own in zip(batch, np.split(path, cuts, axis=1), strict=True):
            found[i] = own
    return found


def _batches(records: Sequence[StreamRecord]) -> Iterator[list[int]]:
    """Indices of streams of one length."""
    by_length: dict[int, list[int]] = defaultdict(list)
    for i, record in enumerate(records):
        by_length[len(record)].append(i)
    yield from by_length.values()
