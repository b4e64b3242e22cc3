"""What its joint says of where a query can be: before it moves by the network's belief, afterwards by its own track.

Everything here is in the reference frame of the stream (see :mod:`quest.model.observation`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Float

from quest.grounding import Joint, JointEstimator, JointKind, JointPrior, joint_from_prior
from quest.model.joint_head import JointBelief
from quest.track.settings import TrackerConfig

_SAMPLES = 97
_SLIDE_REACH = 1.2
_TURN_REACH_RAD = 2.4
_LOG_FREE_SPACE = -4.0
_UNTOLD = -6.0


@dataclass(frozen=True)
class BeliefRow:
    """What the network believes of one query's joint in one frame (see :class:`~quest.model.joint_head.JointBelief`).

    Attributes:
        revolute_logit: above zero where the joint turns rather than slides.
        slide_axis: unit direction of sliding.
        turn_axis: unit direction of the axis of turning.
        foot: from the entity to the nearest point of the axis of turning.
        spread: scales of the Laplace-like errors of the two directions and of ``foot``.
    """

    revolute_logit: float
    slide_axis: Float[np.ndarray, "3"]
    turn_axis: Float[np.ndarray, "3"]
    foot: Float[np.ndarray, "3"]
    spread: Float[np.ndarray, "3"]


def joint_rows(belief: JointBelief) -> list[BeliefRow]:
    """The beliefs of all queries in the newest frame of the first batch element."""
    newest = [getattr(belief, f.name)[0, -1].cpu().double().numpy() for f in fields(belief)]
    logit, slide, turn, foot, log_spread = newest
    return [BeliefRow(float(logit[k]), slide[k], turn[k], foot[k], np.exp(log_spread[k])) for k in range(len(logit))]


@dataclass
class _Expectation:
    """The network's beliefs so far, joined."""

    rows: int = 0
    logit: float = 0.0
    slide: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    turn: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    foot: np.ndarray = field(default_factory=lambda: np.zeros(3))
    information: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def add(self, row: BeliefRow, point: np.ndarray) -> None:
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


@dataclass(frozen=True)
class Curve:
    """Where a joint can bring a query.

    Attributes:
        log_weight: logarithm of the probability of this joint.
        joint: the joint.
        q: samples of its coordinate.
        point: the curve there.
        spread: standard deviation of the curve there.
    """

    log_weight: float
    joint: Joint
    q: Float[np.ndarray, " M"]
    point: Float[np.ndarray, "M 3"]
    spread: Float[np.ndarray, " M"]


class Ground:
    """The joint of one query and where along it the query may be.

    Args:
        config: settings of tracking.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._expectation = _Expectation()
        self._estimator = JointEstimator(config.point_sigma)
        self._curves: tuple[Curve, ...] = ()
        self._along: np.ndarray | None = None

    @property
    def joint(self) -> Joint | None:
        """The joint that the track so far shows; None before the first point."""
        return self._estimator.joint

    @property
    def still(self) -> bool:
        """Whether the query has not been seen to move."""
        return self.joint is None or self.joint.kind is JointKind.STATIC

    def see(self, point: Float[np.ndarray, "3"], row: BeliefRow) -> None:
        """Learn from a frame in which the query is seen and trusted."""
        self._expectation.add(row, point)
        self._estimator.prior = prior = self._expectation.prior()
        self._estimator.add(point)
        self._curves = self._make_curves(prior)
        self._along = None

    def favour(self, point: Float[np.ndarray, "C 3"]) -> Float[np.ndarray, " C"]:
        """How well points agree with the joint: log weights, at most 0, at least ``off_joint``."""
        floor = self._config.off_joint
        if not self._curves:
            return np.zeros(len(point))
        total = np.full(len(point), floor)
        for curve in self._curves:
            # Squares by a matrix product: this runs for every cell, query and frame.
            square = np.square(point).sum(1)[:, None] - 2 * point @ curve.point.T + np.square(curve.point).sum(1)
            variance = np.square(curve.spread) + self._config.joint_sigma**2
            best = (-0.5 * square / variance).max(axis=1) + curve.log_weight
            total = np.logaddexp(total, np.where(np.isnan(best), -np.inf, best))
        return np.minimum(total, 0.0)

    def settle(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point that is seen, drawn towards the joint as far as the joint is known better than the point."""
        if not self._curves:
            return point
        curve = max(self._curves, key=lambda c: c.log_weight)
        q = curve.joint.locate(point[None])
        on, spread = curve.joint.at(q)[0], float(curve.joint.spread(q)[0])
        sigma = self._config.point_sigma
        share = spread**2 / (spread**2 + sigma**2)
        # What is too far from the joint is not on it.
        doubt = 1 - np.exp(-0.5 * np.square(np.linalg.norm(point - on) / np.hypot(spread, 2 * sigma)))
        return on + max(share, doubt) * (point - on)

    def hide(
        self,
        before: Float[np.ndarray, "3"],
        point: Float[np.ndarray, "3"],
        seen: float,
        evidence: Callable[[np.ndarray], np.ndarray],
        free: Callable[[np.ndarray], np.ndarray],
    ) -> Float[np.ndarray, "3"]:
        """Where a query is that is probably hidden: the mean along its joint.

        Args:
            before: where it was last.
            point: where it would be if it were seen after all; NaN if unknown.
            seen: probability of that.
            evidence: log score of the frame for points (M x 3), NaN outside the image.
            free: whether one looks through points.
        """
        if not self._curves:
            return before
        curve = max(self._curves, key=lambda c: c.log_weight)
        sigma = self._config.along_sigma * (2 if curve.joint.kind is JointKind.REVOLUTE else 1)
        if self._along is None:
            at = float(curve.joint.locate(before[None])[0])
            self._along = _normalised(-0.5 * np.square((curve.q - at) / sigma))
        prior = self._along @ _rows_normalised(-0.5 * np.square((curve.q[:, None] - curve.q[None]) / sigma))
        score = self._config.hidden_trust * np.nan_to_num(evidence(curve.point), nan=_UNTOLD)
        # Where one looks through the place, the query would be seen.
        score = score + np.where(free(curve.point), _LOG_FREE_SPACE, 0.0)
        likelihood = (1 - seen) * _normalised(score)
        if np.isfinite(point).all():
            gap = np.linalg.norm(curve.point - point, axis=1) / np.hypot(curve.spread, 2 * self._config.point_sigma)
            likelihood += seen * np.exp(-0.5 * gap.min() ** 2) * _normalised(-0.5 * np.square(gap))
        posterior = prior * (likelihood + 1e-9)
        self._along = posterior / posterior.sum()
        return curve.joint.at(np.array([self._along @ curve.q]))[0]

    def _make_curves(self, prior: JointPrior) -> tuple[Curve, ...]:
        joint = self._estimator.joint
        assert joint is not None  # a point was added
        if joint.kind is not JointKind.STATIC:
            return (_curve(joint, 0.0),)
        weights = {JointKind.REVOLUTE: prior.revolute_probability, JointKind.PRISMATIC: 1 - prior.revolute_probability}
        return tuple(
            _curve(joint_from_prior(prior, joint.rest, kind=k, rest_sigma=self._config.point_sigma), float(np.log(w)))
            for k, w in weights.items()
        )


def _curve(joint: Joint, log_weight: float) -> Curve:
    if joint.kind is JointKind.REVOLUTE:
        q = np.linspace(-_TURN_REACH_RAD, _TURN_REACH_RAD, _SAMPLES)
    else:
        q = np.linspace(min(joint.lower, 0.0) - _SLIDE_REACH, max(joint.upper, 0.0) + _SLIDE_REACH, _SAMPLES)
    return Curve(log_weight, joint, q, joint.at(q), joint.spread(q))


def _principal(scatter: np.ndarray) -> tuple[np.ndarray, float]:
    """Main direction of a sum of outer products, and the sine of the typical angle to it."""
    value, vector = np.linalg.eigh(scatter)
    return vector[:, -1], float(np.sqrt(max(0.0, 1 - value[-1] / value.sum())))


def _normalised(log_p: np.ndarray) -> np.ndarray:
    p = np.exp(log_p - log_p.max())
    return p / p.sum()


def _rows_normalised(log_p: np.ndarray) -> np.ndarray:
    p = np.exp(log_p)
    return p / p.sum(axis=1, keepdims=True)
