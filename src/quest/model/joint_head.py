"""What the network believes of the joint that a query hangs on: kind, axis and place of the axis, each with its spread.

Doors and drawers show how they will open before anything moves.

References: Jiang et al., OPD: Single-view 3D Openable Part Detection, ECCV 2022, for the parameters; Kendall and Gal,
What Uncertainties Do We Need in Bayesian Deep Learning, NeurIPS 2017, section 3.1, for learning the spreads.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

_LOG_SPREAD = (-4.0, 1.0)


@dataclass(frozen=True)
class JointBelief:
    """Joints of queries, in the reference frame."""

    revolute_logit: Float[Tensor, "B T K"]
    """Above zero where the joint turns rather than slides."""
    slide_axis: Float[Tensor, "B T K 3"]
    """Unit direction of sliding, of either sign."""
    turn_axis: Float[Tensor, "B T K 3"]
    """Unit direction of the axis of turning, of either sign."""
    foot: Float[Tensor, "B T K 3"]
    """From the entity to the nearest point of the axis of turning."""
    log_spread: Float[Tensor, "B T K 3"]
    """Logarithms of the spreads of the sine of the angles to ``slide_axis`` and ``turn_axis`` and of the length of the
    error of ``foot``."""


class JointHead(nn.Module):
    """An MLP on the queries after the decoder."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 13))

    def forward(self, x: Float[Tensor, "B T K D"]) -> JointBelief:
        """The belief at every frame."""
        kind, slide, turn, foot, spread = self.mlp(x).float().split((1, 3, 3, 3, 3), dim=-1)
        return JointBelief(
            revolute_logit=kind.squeeze(-1),
            slide_axis=F.normalize(slide, dim=-1),
            turn_axis=F.normalize(turn, dim=-1),
            foot=foot,
            log_spread=spread.clamp(*_LOG_SPREAD),
        )
