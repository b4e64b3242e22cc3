"""What a stream answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from quest.types import State


@dataclass(frozen=True)
class StreamState:
    """Answers for one frame; K grows when queries bind.

    Attributes:
        names: name per query.
        labels: label per query, or None.
        uv_px: pixel in the source frame.
        point_world: world point in metres, NaN where it cannot be lifted.
        confidence: probability that the identity is right.
        visible: whether the entity is seen.
        state: :class:`~quest.types.State` per query.
        stamp_s: the frame's time.
        has_depth: whether the frame brought any depth.
        query: which of the queries, in the order in which they were asked, each row answers; discovered slots count up.
    """

    names: tuple[str, ...]
    labels: tuple[str | None, ...]
    uv_px: Float32[np.ndarray, "K 2"]
    point_world: Float32[np.ndarray, "K 3"]
    confidence: Float32[np.ndarray, " K"]
    visible: Bool[np.ndarray, " K"]
    state: tuple[State, ...]
    stamp_s: float
    has_depth: bool
    query: tuple[int, ...]
