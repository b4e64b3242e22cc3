"""From signals to the probability that a query's identity is lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from quest.errors import WeightsError
from quest.monitor import memory as memories
from quest.monitor.signals import SIGNALS

LOGIT_LIMIT = 8.0
"""Log odds are kept within this: no single frame is surer than 0.99966."""


@dataclass(frozen=True)
class Calibrator:
    """A small network on remembered signals; several of one shape, fitted to different objects, are averaged.

    Signals are squashed, ``arcsinh((x - center) / scale)``: linear about the middle, logarithmic far out. The log odds
    of a member are ``f . direct + tanh(f . inner + inner_bias) . outer + bias`` of the features f of
    :mod:`quest.monitor.memory`; without hidden units (H = 0) that is a logistic regression.
    """

    center: Float64[np.ndarray, " S"]
    """Median of each signal."""
    scale: Float64[np.ndarray, " S"]
    """Spread of each signal."""
    direct: Float64[np.ndarray, "M F"]
    """Weights from features to log odds, per member."""
    inner: Float64[np.ndarray, "M F H"]
    """Weights from features to hidden units."""
    inner_bias: Float64[np.ndarray, "M H"]
    """Of the hidden units."""
    outer: Float64[np.ndarray, "M H"]
    """Weights from hidden units to log odds."""
    bias: Float64[np.ndarray, " M"]
    """Of the log odds."""

    def __post_init__(self) -> None:
        members, _, hidden = self.inner.shape
        expected = {
            "center": (len(SIGNALS),),
            "scale": (len(SIGNALS),),
            "direct": (members, memories.FEATURES),
            "inner": (members, memories.FEATURES, hidden),
            "inner_bias": (members, hidden),
            "outer": (members, hidden),
            "bias": (members,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise WeightsError(
                    f"monitor: expected finite {name} of shape {shape}, got {value.shape}; calibrate again"
                )
        if not members or not (self.scale > 0).all():
            raise WeightsError("monitor: expected at least one member and positive scales; calibrate again")

    def squash(self, values: Float64[np.ndarray, "N S"]) -> Float64[np.ndarray, "N S"]:
        """Signals on one footing; NaN stays NaN, and so does what is infinite."""
        return np.arcsinh((np.where(np.isfinite(values), values, np.nan) - self.center) / self.scale)

    def unsquash(self, squashed: Float64[np.ndarray, " S"]) -> Float64[np.ndarray, " S"]:
        """Signals in their own units again."""
        return self.center + self.scale * np.sinh(squashed)

    def step(
        self, memory: Float64[np.ndarray, "N R S"], values: Float64[np.ndarray, "N S"]
    ) -> tuple[Float64[np.ndarray, "N R S"], Float64[np.ndarray, "N F"]]:
        """Take in one frame of N queries.

        Args:
            memory: from the frame before, or :func:`quest.monitor.memory.start`.
            values: signals; NaN where unknown.

        Returns:
            The memory and the features of this frame.
        """
        squashed = self.squash(values)
        memory = memories.remember(memory, squashed)
        return memory, memories.features(memory, squashed)

    def logit(self, features: Float64[np.ndarray, "N F"]) -> Float64[np.ndarray, " N"]:
        """Log odds that the identity is lost, within plus and minus :data:`LOGIT_LIMIT`."""
        hidden = np.tanh(np.matmul(features, self.inner) + self.inner_bias[:, None])
        members = features @ self.direct.T + np.matmul(hidden, self.outer[:, :, None])[..., 0].T + self.bias
        return np.clip(members.mean(axis=1), -LOGIT_LIMIT, LOGIT_LIMIT)

    def shares(
        self, features: Float64[np.ndarray, " F"], memory: Float64[np.ndarray, "R S"]
    ) -> Float64[np.ndarray, " S"]:
        """How much each signal of one query adds to the log odds by not being at its normal level."""
        normal = memories.with_normal(features, memory)
        both = self.logit(np.concatenate([features[None], normal]))
        return both[0] - both[1:]


def probability(logit: Float64[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Probability of log odds."""
    return 1.0 / (1.0 + np.exp(-logit))
