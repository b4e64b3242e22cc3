"""What the network believes of the joint of a query, joined over frames."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Float

from quest.grounding import JointPrior
from quest.model.joint_head import JointBelief


@dataclass(frozen=True)
class BeliefRow:
    """The network's belief about one query's joint in one frame (see :class:`~quest.model.joint_head.JointBelief`)."""

    revolute_logit: float
    """Above zero where the joint turns rather than slides."""
    slide_axis: Float[np.ndarray, "3"]
    """Unit direction of sliding."""
    turn_axis: Float[np.ndarray, "3"]
    """Unit direction of the axis of turning."""
    foot: Float[np.ndarray, "3"]
    """From the entity to the nearest point of the axis of turning."""
    spread: Float[np.ndarray, "3"]
    """Scales of the Laplace-like errors of the two directions and of ``foot``."""


def joint_rows(belief: JointBelief) -> list[BeliefRow]:
    """The beliefs of all queries in the newest frame of the first batch element."""
    newest = [getattr(belief, f.name)[0, -1].cpu().double().numpy() for f in fields(belief)]
    logit, slide, turn, foot, log_spread = newest
    return [BeliefRow(float(logit[k]), slide[k], turn[k], foot[k], np.exp(log_spread[k])) for k in range(len(logit))]


@dataclass
class Expectation:
    """The network's beliefs so far, joined."""

    rows: int = 0
    logit: float = 0.0
    slide: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    turn: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    foot: np.ndarray = field(default_factory=lambda: np.zeros(3))
    information: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def add(self, row: BeliefRow, point: np.ndarray) -> None:
        """Take the belief of one more frame, in which the query was at a point."""
        weight = 1 / np.square(row.spread)
        self.rows += 1
        self.logit += row.revolute_logit
        self.slide += weight[0] * np.outer(row.slide_axis, row.slide_axis)
        self.turn += weight[1] * np.outer(row.turn_axis, row.turn_axis)
        self.foot += weight[2] * (point + row.foot)
        self.information += weight

    def prior(self) -> JointPrior:
        """The beliefs as one; errors of neighbouring frames are alike, so that many are worth no more than one."""
        (slide, slide_scatter), (turn, turn_scatter) = _principal(self.slide), _principal(self.turn)
        spread = np.sqrt(self.rows / self.information)
        # Standard deviation per coordinate of a density exp(-e / b) in two and in three dimensions.
        return JointPrior(
            revolute_probability=float(np.clip(1 / (1 + np.exp(-self.logit / self.rows)), 0.01, 0.99)),
            prismatic_axis=slide,
            prismatic_axis_sigma_rad=float(np.hypot(3**0.5 * spread[0], slide_scatter)),
            revolute_axis=turn,
            revolute_axis_sigma_rad=float(np.hypot(3**0.5 * spread[1], turn_scatter)),
            origin=self.foot / self.information[2],
            origin_sigma=float(2 * spread[2]),
        )


def _principal(scatter: np.ndarray) -> tuple[np.ndarray, float]:
    """Main direction of a sum of outer products, and the sine of the typical angle to it."""
    value, vector = np.linalg.eigh(scatter)
    return vector[:, -1], float(np.sqrt(max(0.0, 1 - value[-1] / value.sum())))
