"""Streams of log odds as the filter might give them: slow noise, occlusions that are no loss, and losses."""

from __future__ import annotations

from typing import Any

import numpy as np

from quest.evaluation.stream_record import LOST, RIGHT, UNCLEAR, StreamRecord
from quest.monitor import Inputs

FRAMES_PER_S = 30.0
_LONGEST = 20


def make_stream(
    seed: int,
    *,
    frames: int = 60,
    queries: int = 4,
    losses: float = 0.4,
    part: str = "validation",
    inputs: Inputs = "depth",
) -> StreamRecord:
    """A stream of an object of its own.

    Args:
        seed: of everything; the object is called after it.
        frames: length.
        queries: how many.
        losses: probability that one of the queries is lost at some time.
        part: part of the object split.
        inputs: what the frames are said to bring.
    """
    rng, noise = np.random.default_rng(seed).spawn(2)  # what happens does not depend on how it looks
    level = -3.5 + 0.7 * noise.normal(size=queries)
    log_odds, state = np.empty((frames, queries)), noise.normal(size=queries)
    for t in range(frames):
        state = 0.8 * state + 0.6 * noise.normal(size=queries)
        log_odds[t] = level + state
    band = np.full((frames, queries), RIGHT, np.int8)
    for k in range(queries):
        for _ in range(rng.poisson(0.006 * (frames + _LONGEST))):  # as many in every part of the stream
            start = int(rng.integers(-_LONGEST, frames))
            hidden = slice(max(start, 0), max(start + int(rng.integers(5, _LONGEST)), 0))
            log_odds[hidden, k] += rng.uniform(0.5, 3.0)
            band[hidden, k] = UNCLEAR if rng.random() < 0.3 else RIGHT
    if rng.random() < losses:
        k, start = int(rng.integers(queries)), int(rng.integers(8, frames - 3))
        band[start:, k] = LOST
        # It comes over a few frames, and it may look much like the entity itself.
        grown = np.minimum(np.arange(1, frames - start + 1) / rng.uniform(1, 10), 1.0)
        log_odds[start:, k] += rng.uniform(1.0, 8.0) * grown
    return StreamRecord(
        take=f"take-{seed}",
        view=0,
        object_id=f"object-{seed}",
        source="procedural",
        part=part,
        level=1,
        inputs=inputs,
        stamp_s=np.arange(frames) / FRAMES_PER_S,
        log_odds=log_odds.astype(np.float32),
        readings=np.full((frames, queries, 1), np.nan, np.float32),
        band=band,
        asked=np.zeros(queries, np.int64),
        moved=np.ones(queries, bool),
    )


def make_streams(count: int, *, first: int = 0, **options: Any) -> list[StreamRecord]:
    """Streams of different objects; see :func:`make_stream`."""
    return [make_stream(seed, **options) for seed in range(first, first + count)]
