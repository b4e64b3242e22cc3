"""What a stream answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from quest.filter.joints import Joint
from quest.monitor import Alarm
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
    """Probability that the entity is where the answer says, by the filter, before calibration."""
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
    """The joint that moves each entity, in the world, metres; None where no body carries it, and without depth."""
    q: Float32[np.ndarray, " K"]
    """Where on its joint each query is, radians or metres; NaN without a joint, on one that does not move, and where
    the point is unknown."""
    lost_log_odds: Float32[np.ndarray, " K"]
    """That the identity is lost, by the filter, and with depth by what its readings taught."""
    lost_p: Float32[np.ndarray, " K"]
    """The same as a calibrated probability; NaN where nothing is watched."""
    alarm: tuple[Alarm | None, ...]
    """The open alarm of each query, or None."""
    cam_from_world: Float[np.ndarray, "4 4"] | None = None
    """The camera's pose in the world of the points: the one that was given, or else estimated. None as long as neither
    poses nor depth tell how the camera moves."""
    flags: tuple[str, ...] = ()
    """Degradations of this frame in words, such as missing depth; a late or duplicate frame repeats the answer
    before."""

    def only(self, rows: Sequence[int]) -> StreamState:
        """Some of the queries."""
        of_frame = ("stamp_s", "has_depth", "cam_from_world", "flags")
        each = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in of_frame}
        return replace(
            self,
            **{
                name: value[list(rows)] if isinstance(value, np.ndarray) else tuple(value[row] for row in rows)
                for name, value in each.items()
            },
        )

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
