"""What a stream answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from quest.grounding import Joint
from quest.monitor import Alarm, Signals
from quest.types import State


@dataclass(frozen=True)
class StreamState:
    """Answers for one frame; K grows when queries bind and shrinks when they are retired."""

    names: tuple[str, ...]
    """Name per query."""
    labels: tuple[str | None, ...]
    """Label per query, or None."""
    uv_px: Float32[np.ndarray, "K 2"]
    """Pixel in the source frame."""
    point_world: Float32[np.ndarray, "K 3"]
    """World point in metres, NaN where it cannot be lifted."""
    confidence: Float32[np.ndarray, " K"]
    """The network's own belief that the identity is right."""
    visible: Bool[np.ndarray, " K"]
    """Whether the entity is seen."""
    state: tuple[State, ...]
    """:class:`~quest.types.State` per query."""
    stamp_s: float
    """The frame's time."""
    has_depth: bool
    """Whether the frame brought any depth."""
    query: tuple[int, ...]
    """The number of the query that each row answers; discovered slots count up."""
    joint: tuple[Joint | None, ...]
    """The joint that explains each track so far, in the world, metres; None before the first seen point and without
    depth."""
    q: Float32[np.ndarray, " K"]
    """Where on its joint each query is, radians or metres; NaN without a joint, on one that does not move, and where
    the point is unknown. Of a query that was asked for by a pixel, it is that of the network's own point, which may lie
    beside the pixel."""
    lost_p: Float32[np.ndarray, " K"]
    """Calibrated probability that the identity is lost; NaN where nothing is watched."""
    alarm: tuple[Alarm | None, ...]
    """The open alarm of each query, or None."""
    signals: Signals
    """What the monitor judged by."""
    flags: tuple[str, ...] = ()
    """Degradations of this frame in words, such as missing depth; a late or duplicate frame repeats the answer
    before."""

    def __repr__(self) -> str:
        lines = [
            f"StreamState({self.stamp_s:.3f} s, {len(self.query)} {'query' if len(self.query) == 1 else 'queries'})"
        ]
        for k, name in enumerate(self.names):
            x, y = self.uv_px[k]
            lost = f", P(lost) {self.lost_p[k]:.2f}" if np.isfinite(self.lost_p[k]) else ""
            alarm = "" if self.alarm[k] is None else ", ALARM"
            lines.append(f"  {name}: {self.state[k]} at ({x:.1f}, {y:.1f}) px{lost}{alarm}")
        return "\n".join(lines + [f"  note: {flag}" for flag in self.flags])
