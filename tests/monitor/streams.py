"""Streams of signals as a tracker might make them: slow noise, occlusions that are no loss, and losses."""

from __future__ import annotations

from typing import Any

import numpy as np

from quest.evaluation.stream_record import StreamRecord
from quest.monitor import SIGNALS

NORMAL = {
    "anchor_cosine": (0.85, 0.05),
    "embedding_cosine": (0.92, 0.03),
    "right_logit": (3.0, 1.0),
    "visible_logit": (3.0, 1.0),
    "peak_log_p": (-2.0, 0.5),
    "margin": (4.0, 1.0),
    "disagreement": (0.02, 0.02),
    "joint_residual": (1.0, 0.5),
    "depth_gap": (0.0, 0.01),
    "step": (0.01, 0.008),
    "spread": (0.03, 0.01),
    "held": (0.0, 0.0),
    "travel": (0.2, 0.05),
    "closing": (-0.2, 0.1),
    "lead": (0.0, 1.0),
}
"""Mean and spread of every signal while all is well."""

OCCLUDED = {"anchor_cosine": -0.2, "visible_logit": -5.0, "peak_log_p": -1.0, "margin": -2.0, "spread": 0.05}
LOST = {
    "anchor_cosine": -0.25,
    "embedding_cosine": -0.1,
    "right_logit": -2.5,
    "margin": -2.0,
    "disagreement": 0.15,
    "joint_residual": 3.0,
    "closing": -0.5,
    "lead": -1.5,
}
"""What an occlusion and a loss add."""


def make_stream(
    seed: int, *, frames: int = 60, queries: int = 4, losses: float = 0.4, part: str = "validation"
) -> StreamRecord:
    """A stream of an object of its own.

    Args:
        seed: of everything; the object is called after it.
        frames: length.
        queries: how many.
        losses: probability that one of the queries is lost at some time.
        part: part of the object split.
    """
    rng, noise = np.random.default_rng(seed).spawn(2)  # what happens does not depend on how many signals there are
    mean, spread = np.array(list(NORMAL.values())).T
    level = mean + 0.7 * spread * noise.normal(size=(queries, len(SIGNALS)))
    values = np.empty((frames, queries, len(SIGNALS)))
    state = noise.normal(size=(queries, len(SIGNALS)))
    for t in range(frames):
        state = 0.8 * state + 0.6 * noise.normal(size=state.shape)
        values[t] = level + spread * state
    spikes = rng.random((frames, queries)) < 0.02
    for name, size in (("step", 0.15), ("disagreement", 0.15), ("joint_residual", 3.0)):
        values[spikes, SIGNALS.index(name)] += size * rng.random(int(spikes.sum()))
    for k in range(queries):
        if rng.random() < 0.3:
            start, length = rng.integers(5, max(frames - 15, 6)), rng.integers(5, 20)
            _add(values[start : start + length, k], OCCLUDED, rng.uniform(0.5, 1.2))
            values[start : start + length, k, SIGNALS.index("held")] = 1.0
            values[start : start + length, k, SIGNALS.index("depth_gap")] = np.nan
    lost = np.zeros((frames, queries), bool)
    if rng.random() < losses:
        k, start = int(rng.integers(queries)), int(rng.integers(8, frames - 3))
        lost[start:, k] = True
        # It comes over a few frames, and it may look much like the entity itself.
        grown = np.minimum(np.arange(1, frames - start + 1) / rng.uniform(1, 10), 1.0)
        for name, change in LOST.items():
            values[start:, k, SIGNALS.index(name)] += rng.uniform(0.0, 1.2) * change * grown
    signals = values.astype(np.float32)
    right = signals[..., SIGNALS.index("right_logit")].astype(np.float64)
    return StreamRecord(
        take=f"take-{seed}",
        view=0,
        object_id=f"object-{seed}",
        source="procedural",
        part=part,
        level=1,
        signals=signals,
        lost=lost,
        asked=np.zeros(queries, np.int64),
        moved=np.ones(queries, bool),
        confidence=(1.0 / (1.0 + np.exp(-right))).astype(np.float32),
    )


def make_streams(count: int, *, first: int = 0, **options: Any) -> list[StreamRecord]:
    """Streams of different objects; see :func:`make_stream`."""
    return [make_stream(seed, **options) for seed in range(first, first + count)]


def _add(values: np.ndarray, changes: dict[str, float], strength: float) -> None:
    for name, change in changes.items():
        values[:, SIGNALS.index(name)] += strength * change
