"""What its joint says of where a query can be: before it moves by the network's belief, afterwards by its own track.

Everything here is in the reference frame of the stream (see :mod:`quest.model.observation`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from quest.grounding import Joint, JointEstimator, JointKind, JointPrior, joint_from_prior
from quest.grounding.hinge import Plane
from quest.track.evidence import Evidence
from quest.track.expectation import BeliefRow, Expectation
from quest.track.front import OFF_TURN, Front
from quest.track.settings import TrackerConfig

_SAMPLES = 97
_SLIDE_REACH = 1.2
_TURN_REACH_RAD = 2.4
_TURN_MARGIN_RAD = 0.5
_TOLERANCE = 0.06
_LINK_DEPTH = 0.25
_LOG_FREE_SPACE = -4.0
_LOG_MISSED = -2.0
_RECENT = 6
_SLOWING = 0.92
_MOST_CLOSED = 6.0
_STANDING = 8
"""Sights that tell where something fixed stands; nothing moves in the first frames of a stream."""
_OFF_FIXED = -3.0
_TURN_SIGMA_RAD = 0.05
_LEAST_TURN_WEIGHT = -4.0
_SAME_AXIS_RAD = 0.2
_SAME_AXIS = 0.1


@dataclass(frozen=True)
class Curve:
    """Where a joint can bring a query."""

    log_weight: float
    """Logarithm of the probability of this joint."""
    joint: Joint
    """The joint."""
    q: Float[np.ndarray, " M"]
    """Samples of its coordinate."""
    point: Float[np.ndarray, "M 3"]
    """The curve there."""
    spread: Float[np.ndarray, " M"]
    """Standard deviation of the curve there."""


@dataclass(eq=False)
class Ground:
    """The joint of one query and where along it the query may be.

    Args:
        config: settings of tracking.
        fixed: whether it was asked for as something that no joint moves (intent ``lift``). It then stands where it was
            first seen, and only what the image shows plainly takes it away from there.
    """

    config: TrackerConfig
    fixed: bool = field(default=False, kw_only=True)
    front: Front = field(init=False)
    _expectation: Expectation = field(default_factory=Expectation, init=False)
    _estimator: JointEstimator = field(init=False)
    _curves: tuple[Curve, ...] = field(default=(), init=False)
    _recent: deque[tuple[float, Float[np.ndarray, "3"]]] = field(
        default_factory=lambda: deque(maxlen=_RECENT), init=False
    )
    _along: Float[np.ndarray, " M"] | None = field(default=None, init=False)
    _hidden: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.front = Front(self.config.point_sigma)
        self._estimator = JointEstimator(self.config.point_sigma)

    @property
    def joint(self) -> Joint | None:
        """The joint that the track so far shows; None before the first point."""
        turning, own = self.front.joint, self._estimator.joint
        if turning is None:
            return own
        # Sights say more of the radius, the front of the axis: where they agree both count.
        return own if own is not None and _agree(own, turning) else turning

    def face(self, plane: Plane | None, *, elapsed: float) -> None:
        """Take how the front of the link stands in the newest frame (see :meth:`~quest.track.front.Front.see`)."""
        if self.front.see(plane, elapsed=elapsed) and self._estimator.prior is not None:
            self._estimator.believe(self._expectation.prior())
            self._curves = self._make_curves(self._expectation.prior())

    def see(self, point: Float[np.ndarray, "3"], row: BeliefRow, *, now: float) -> None:
        """Learn from a frame in which the query is seen and trusted.

        Args:
            point: where it is.
            row: what the network believes of its joint.
            now: time of the frame, in frames.
        """
        if not (self.fixed and self._expectation.rows >= _STANDING):
            self._expectation.add(row, point)
            if not self.fixed:
                self.front.learn(point)
            if self.front.given_up_for(point):
                self._estimator.believe(self._expectation.prior())
            self._estimator.prior = prior = self.front.belief or self._expectation.prior()
            if self._on_turn(point):
                self._estimator.add(point)
            self._curves = self._make_curves(prior)
        self._recent.append((now, point))
        self._along, self._hidden = None, 0.0

    def favour(self, point: Float[np.ndarray, "C 3"]) -> Float[np.ndarray, " C"]:
        """How well points agree with the joint: log weights, at most 0, at least ``off_joint``."""
        floor = _OFF_FIXED if self.fixed else self.config.off_joint
        if not self._curves:
            return np.zeros(len(point))
        total = np.full(len(point), floor)
        for curve in self._curves:
            # Squares by a matrix product: this runs for every cell, query and frame.
            square = np.square(point).sum(1)[:, None] - 2 * point @ curve.point.T + np.square(curve.point).sum(1)
            variance = np.square(curve.spread) + self.config.joint_sigma**2
            best = (-0.5 * square / variance + self._turned(curve)).max(axis=1) + curve.log_weight
            total = np.logaddexp(total, np.where(np.isnan(best), -np.inf, best))
        return np.minimum(total, 0.0)

    def settle(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point that is seen, drawn towards the joint as far as the joint is known better than the point."""
        if not self._curves:
            return point
        curve = self._best_curve
        q = curve.joint.locate(point[None])
        turned = self.front.turned(curve.joint)
        if turned is not None:
            # How the front stands tells more than where on it something is seen.
            sigma = np.hypot(_TURN_SIGMA_RAD, self.config.point_sigma / max(curve.joint.radius, 1e-6))
            gap = float(np.angle(np.exp(1j * (q[0] - turned))))
            share = _TURN_SIGMA_RAD**2 / sigma**2 if abs(gap) < 3 * sigma else 0.0
            q = np.array([turned + share * gap])
        on, spread = curve.joint.at(q)[0], float(curve.joint.spread(q)[0])
        sigma = self.config.point_sigma
        share = spread**2 / (spread**2 + sigma**2)
        near = np.exp(-0.5 * np.square(np.linalg.norm(point - on) / np.hypot(spread, 2 * sigma)))
        # What is too far from the joint is not on it, unless the front of the link tells that it is.
        return on + (share * near if turned is not None else max(share, 1 - near)) * (point - on)

    def residual(self, point: Float[np.ndarray, "3"]) -> float:
        """Distance of a point to the curve of the joint, in standard deviations of both; NaN before the first sight."""
        if not self._curves or not np.isfinite(point).all():
            return float("nan")
        curve = self._best_curve
        q = curve.joint.locate(point[None])
        gap = np.linalg.norm(point - curve.joint.at(q)[0])
        return float(gap / np.hypot(curve.joint.spread(q)[0], self.config.point_sigma))

    def covered(self, before: Float[np.ndarray, "3"], frame: Evidence, elapsed: float) -> float:
        """Share of the places where a query can be now that lie behind something that is not its own link.

        A part that turns away hides its own handle; what came before it is nearer to the camera than that.

        Args:
            before: where it was last.
            frame: what the newest frame says of places.
            elapsed: frames since then.
        """
        if not self._curves or self.joint is None or self.joint.kind is JointKind.STATIC:
            return float(frame.room(before[None])[0] < -_TOLERANCE)
        return float(self._predicted(before, elapsed) @ self._buried(frame))

    def expected(
        self, before: Float[np.ndarray, "3"], point: Float[np.ndarray, "C 3"], elapsed: float
    ) -> Float[np.ndarray, " C"] | None:
        """How probably a query that was hidden is at each of some points now; None where nothing is known of them.

        Args:
            before: where it was held.
            point: the points, NaN where unknown.
            elapsed: frames since then.
        """
        known = np.isfinite(point).all(axis=1)
        if not self._curves or not known.any():
            return None
        curve = self._best_curve
        sigma = np.hypot(curve.spread, self.config.joint_sigma)
        gap = np.linalg.norm(np.nan_to_num(point)[:, None] - curve.point[None], axis=-1) / sigma
        density = np.where(known, np.exp(-0.5 * np.square(gap)) @ self._predicted(before, elapsed), 0.0)
        return density / density.sum() if density.sum() > 1e-12 else None

    def hide(
        self,
        before: Float[np.ndarray, "3"],
        point: Float[np.ndarray, "3"],
        seen: float,
        frame: Evidence,
        *,
        buried: bool = False,
        elapsed: float = 1.0,
    ) -> Float[np.ndarray, "3"]:
        """Where a query is that is probably hidden: the mean along its joint.

        Args:
            before: where it was last.
            point: where it would be if it were seen after all; NaN if unknown.
            seen: probability of that.
            frame: what the newest frame says of places.
            buried: whether something came before it. Then what the frame shows before it says nothing, and it moves on
                as it moved; else it is its own link that hides it, and the network knows roughly where.
            elapsed: frames since it was there.
        """
        if not self._curves:
            return before
        curve, prior = self._best_curve, self._predicted(before, elapsed, moving=buried)
        score = self.config.hidden_trust * np.nan_to_num(frame.ratio(curve.point))
        if buried:
            # What seems to show it adds nothing: frames are alike, and a look-alike would soon outweigh everything.
            score = np.where(self._buried(frame), 0.0, np.clip(score, _LOG_MISSED, 0.0))
        if not buried:
            score = score + self._turned(curve)
        # Where one looks through the place, the query would be seen.
        tolerance = _TOLERANCE + (curve.spread if buried else 0.0)
        score = np.where(frame.room(curve.point) > tolerance, score + _LOG_FREE_SPACE, score)
        likelihood = (1 - seen) * _normalised(score)
        if np.isfinite(point).all():
            gap = np.linalg.norm(curve.point - point, axis=1) / np.hypot(curve.spread, 2 * self.config.point_sigma)
            likelihood += seen * np.exp(-0.5 * gap.min() ** 2) * _normalised(-0.5 * np.square(gap))
        posterior = prior * (likelihood + 1e-9)
        self._along, self._hidden = posterior / posterior.sum(), self._held_for(before) + elapsed
        return curve.joint.at(np.array([self._along @ curve.q]))[0]

    def _on_turn(self, point: np.ndarray) -> bool:
        """Whether a sight is where the link's turn brings the query, as far as that is known."""
        turning = self.front.joint
        if turning is None or self._estimator.joint is None:
            return True
        turned = self.front.turned(turning)
        q = turning.locate(point[None]) if turned is None else np.array([turned])
        return bool(np.linalg.norm(point - turning.at(q)[0]) < OFF_TURN)

    def _turned(self, curve: Curve) -> np.ndarray | float:
        """How well the samples of a curve agree with how the link's front stands: log weights."""
        turned = self.front.turned(curve.joint)
        if turned is None:
            return 0.0
        gap = np.angle(np.exp(1j * (curve.q - turned)))
        return np.maximum(-0.5 * np.square(gap / _TURN_SIGMA_RAD), _LEAST_TURN_WEIGHT)

    @property
    def _best_curve(self) -> Curve:
        return max(self._curves, key=lambda c: c.log_weight)

    def _buried(self, frame: Evidence) -> np.ndarray:
        """Which samples of the best curve lie behind something that is not the query's own link."""
        curve = self._best_curve
        return frame.room(curve.point) < -(_LINK_DEPTH + curve.spread)

    def _predicted(self, before: np.ndarray, elapsed: float, *, moving: bool = True) -> np.ndarray:
        """Probability of the samples of the best curve, before the frame is looked at.

        Args:
            before: where the query was last.
            elapsed: frames since then.
            moving: whether what moved moves on, slower and slower, and does not close further than it was seen closed.
                What was never seen to move does neither: the sign of a joint that is only believed means nothing.
        """
        curve = self._best_curve
        sigma = self.config.along_sigma * (2 if curve.joint.kind is JointKind.REVOLUTE else 1) * elapsed
        hidden = self._held_for(before)
        if hidden and self._along is not None:
            start = self._along
        else:
            at = float(curve.joint.locate(before[None])[0])
            start = _normalised(-0.5 * np.square((curve.q - at) / sigma))
        moving = moving and self.joint is not None and self.joint.kind is not JointKind.STATIC
        step = self._speed(curve.joint) * _SLOWING**hidden * elapsed if moving else 0.0
        moved = start @ _rows_normalised(-0.5 * np.square((curve.q[:, None] + step - curve.q[None]) / sigma))
        if moving:
            moved = moved * np.exp(-np.clip((curve.joint.lower - curve.q) / sigma - 1, 0.0, _MOST_CLOSED))
        return moved / moved.sum()

    def _speed(self, joint: Joint) -> float:
        """How far along its joint a query moved per frame, over its last few sights."""
        if joint.kind is JointKind.STATIC or len(self._recent) < 2:
            return 0.0
        q = joint.locate(np.stack([point for _, point in self._recent]))
        return float((q[-1] - q[0]) / (self._recent[-1][0] - self._recent[0][0]))

    def _held_for(self, before: Float[np.ndarray, "3"]) -> float:
        """Frames in a row for which a query was held; 0 where it is not where that left it, but was put elsewhere."""
        if self._along is None:
            return 0.0
        curve = self._best_curve
        left = curve.joint.at(np.array([self._along @ curve.q]))[0]
        return self._hidden if np.allclose(before, left, atol=1e-6) else 0.0

    def _make_curves(self, prior: JointPrior) -> tuple[Curve, ...]:
        joint = self.joint
        assert joint is not None  # a point was added
        if joint.kind is not JointKind.STATIC or self.fixed:
            return (_curve(joint, 0.0),)
        weights = {JointKind.REVOLUTE: prior.revolute_probability, JointKind.PRISMATIC: 1 - prior.revolute_probability}
        return tuple(
            _curve(joint_from_prior(prior, joint.rest, kind=k, rest_sigma=self.config.point_sigma), float(np.log(w)))
            for k, w in weights.items()
        )


def _agree(joint: Joint, turning: Joint) -> bool:
    """Whether a joint turns about much the same axis as another."""
    if joint.kind is not JointKind.REVOLUTE or abs(joint.axis @ turning.axis) < np.cos(_SAME_AXIS_RAD):
        return False
    apart = joint.origin - turning.origin
    return bool(np.linalg.norm(apart - (apart @ turning.axis) * turning.axis) < _SAME_AXIS)


def _curve(joint: Joint, log_weight: float) -> Curve:
    if joint.kind is JointKind.REVOLUTE:
        low = min(-_TURN_REACH_RAD, joint.lower - _TURN_MARGIN_RAD)
        high = max(_TURN_REACH_RAD, joint.upper + _TURN_MARGIN_RAD)
        q = np.linspace(max(low, -np.pi), min(high, np.pi), _SAMPLES)
    else:
        q = np.linspace(min(joint.lower, 0.0) - _SLIDE_REACH, max(joint.upper, 0.0) + _SLIDE_REACH, _SAMPLES)
    return Curve(log_weight, joint, q, joint.at(q), joint.spread(q))


def _normalised(log_p: np.ndarray) -> np.ndarray:
    p = np.exp(log_p - log_p.max())
    return p / p.sum()


def _rows_normalised(log_p: np.ndarray) -> np.ndarray:
    p = np.exp(log_p - log_p.max(axis=1, keepdims=True))
    return p / p.sum(axis=1, keepdims=True)
