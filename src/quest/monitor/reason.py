"""Why an alarm was raised, in words that someone who holds the camera understands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from quest.monitor.signals import SIGNALS

MOST: Final = 2
"""Signals that are named."""

_WORTH: Final = 0.35
"""A signal is named if it adds at least this share of what the first one adds."""

_LEAST: Final = 0.2
"""A signal that adds less than this to the log odds explains nothing."""


@dataclass(frozen=True)
class _Wording:
    """How a signal is called when it is off its normal level."""

    low: str | None
    """Where it is below; None where that is no sign of a loss."""
    high: str | None
    """Where it is above."""


_WORDINGS: Final = {
    "anchor_cosine": _Wording("looks unlike its anchor (cosine {:.2f})", None),
    "embedding_cosine": _Wording("is described unlike at its start (cosine {:.2f})", None),
    "right_logit": _Wording("the network doubts the identity (log odds {:.1f})", None),
    "visible_logit": _Wording("hardly seen (log odds {:.1f})", None),
    "peak_log_p": _Wording("attention is not sharp (log of the best cell {:.1f})", None),
    "margin": _Wording("something else matches nearly as well (margin {:.1f})", None),
    "disagreement": _Wording(None, "its anchor matches best {:.2f} away"),
    "joint_residual": _Wording(None, "distance to joint {:.1f} sigma"),
    "depth_gap": _Wording("what is seen lies {:.2f} before its place", "what is seen lies {:.2f} behind its place"),
    "step": _Wording(None, "leapt by {:.2f}"),
    "spread": _Wording(None, "place uncertain by {:.2f}"),
    "held": _Wording(None, "held on its joint without being seen"),
    "travel": _Wording(None, "has gone {:.2f}"),
    "closing": _Wording("has come close to another query (log of the distances' ratio {:.1f})", None),
    "lead": _Wording("the query close by is surer of its identity (log odds {:.1f})", None),
}


def reason(
    shares: Float64[np.ndarray, " S"],
    values: Float64[np.ndarray, " S"],
    levels: Float64[np.ndarray, " S"],
    off: Float64[np.ndarray, " S"],
    *,
    lost_p: float,
) -> str:
    """Why a query's identity is probably lost: "distance to joint 4.1 sigma for 6 frames".

    Args:
        shares: how much each signal adds to the log odds of a loss.
        values: the signals, in their own units.
        levels: the query's normal level of each.
        off: frames in a row that each has been off: far from its level and from what is usual.
        lost_p: probability of a loss, said where no signal stands out.
    """
    order = np.argsort(-shares, kind="stable")
    least = max(_WORTH * shares[order[0]], _LEAST)
    named = [int(s) for s in order[:MOST] if shares[s] >= least]
    if not named:
        return f"no signal stands out; lost with probability {lost_p:.2f}"
    return "; ".join(_clause(s, float(values[s]), float(levels[s]), int(off[s])) for s in named)


def _clause(signal: int, value: float, level: float, frames: int) -> str:
    name = SIGNALS[signal]
    wording = _WORDINGS[name]
    text = wording.low if value < (0.0 if name == "depth_gap" else level) else wording.high  # a gap has a sign
    if text is None:
        text = f"{name.replace('_', ' ')} {{:.2f}}, at first {level:.2f}"
    shown = text.format(abs(value) if name == "depth_gap" else value)
    return f"{shown} for {frames} frame{'s' if frames > 1 else ''}" if frames else shown
