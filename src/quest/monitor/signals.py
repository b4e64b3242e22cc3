"""What the tracker measures of itself in every frame; the monitor sees nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from quest.errors import InputError

SIGNALS: tuple[str, ...] = (
    "anchor_cosine",  # cosine of what surrounds the answer to what surrounded the anchor, [-1, 1]
    "embedding_cosine",  # cosine of the query's embedding now to that at its binding
    "right_logit",  # network: identity right, log odds
    "visible_logit",  # network: seen, log odds
    "peak_log_p",  # log of the heatmap's best cell (sharpness of attention)
    "margin",  # log-score of the best cell minus that of the best cell away from it (look-alikes)
    "disagreement",  # distance between where the anchor matches best and the answer, reference units
    "joint_residual",  # distance of the unsettled point to its joint's curve, in standard deviations
    "depth_gap",  # how far what is seen at the answer lies behind it (+) or before it (-), reference units
    "step",  # distance that the answer moved since the last frame, reference units
    "spread",  # standard deviation of the belief over cells, reference units
    "held",  # 1 where the answer is held on the joint, else 0
    "travel",  # distance of the answer from where the query was first, reference units
    "closing",  # log of how much nearer another query is than it was at first, of the one that came closest (negative)
    "lead",  # network: log odds that the identity is right, less those of that query
)
"""Names of the signals, in the order of :attr:`Signals.values`."""


@dataclass(frozen=True)
class Signals:
    """Signals of one frame."""

    values: Float32[np.ndarray, "K S"]
    """One row per query, one column per name of :data:`SIGNALS`; NaN where unknown (no depth, just bound)."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(SIGNALS):
            raise InputError(f"signals: expected an array K x {len(SIGNALS)}, got shape {self.values.shape}")

    def __len__(self) -> int:
        return len(self.values)

    def named(self, row: int) -> dict[str, float]:
        """Signals of one query by name.

        Args:
            row: index of the query among those of the frame.
        """
        return {name: float(value) for name, value in zip(SIGNALS, self.values[row], strict=True)}
