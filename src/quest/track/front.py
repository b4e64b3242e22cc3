"""The front of the link that a query is on: how it stands, and the joint that its turning shows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from quest.grounding import Joint, JointPrior
from quest.grounding.hinge import HingeEstimator, Plane

_TURN_PER_FRAME_RAD = 0.05
_MOST_TURN_RAD = 0.35
_CONTRADICTED = 20
_INSISTED = 5
OFF_TURN = 0.1
"""What is farther than this from where a turn brings it, reference units, is not there."""


@dataclass(eq=False)
class Front:
    """What is known of the plane around a query.

    Args:
        sigma: standard deviation of a seen point per coordinate, reference units.
    """

    sigma: float
    _hinge: HingeEstimator = field(init=False)
    _plane: Plane | None = field(default=None, init=False)
    _normal: Float[np.ndarray, "3"] | None = field(default=None, init=False)
    _unseen: float = field(default=0.0, init=False)
    _contradicted: int = field(default=0, init=False)
    _insisted: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._hinge = HingeEstimator(self.sigma)

    @property
    def joint(self) -> Joint | None:
        """The joint about which it was seen turning; None where it was not."""
        return self._hinge.joint

    @property
    def belief(self) -> JointPrior | None:
        """What that says of the joint to one who has more to go by."""
        return self._hinge.belief

    @property
    def in_sight(self) -> bool:
        """Whether it is seen in the newest frame, standing as it can."""
        return self._plane is not None

    def expected(self, place: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"] | None, float]:
        """The normal that it should have now, and the least cosine to it; None before it was seen.

        Args:
            place: where the query was last.
        """
        joint = self._hinge.joint
        if joint is not None:
            return self._hinge.facing(float(joint.locate(place[None])[0])), float(np.cos(_MOST_TURN_RAD))
        return self._normal, float(np.cos(min(_TURN_PER_FRAME_RAD * (3 + self._unseen), _MOST_TURN_RAD)))

    def see(self, plane: Plane | None, *, elapsed: float) -> bool:
        """Take how it stands in the newest frame; None where it is not seen.

        What cannot be the front is not taken for it, unless nothing else has been seen for long: then the joint was
        wrong.

        Args:
            plane: what is seen around the query.
            elapsed: frames since the one before.

        Returns:
            Whether the joint was given up.
        """
        given_up = False
        if plane is not None:
            if self._hinge.agrees(plane):
                self._contradicted = 0
            else:
                plane, self._contradicted = None, self._contradicted + 1
                given_up = self._contradicted > _CONTRADICTED
        if given_up:
            self._give_up()
        self._plane = plane
        self._unseen = self._unseen + elapsed if plane is None else 0.0
        self._normal = self._normal if plane is None else plane.normal
        return given_up

    def given_up_for(self, point: Float[np.ndarray, "3"]) -> bool:
        """Whether the joint is given up because the query is seen, again and again, where no turn brings it.

        Args:
            point: where it is seen and trusted in the newest frame.
        """
        joint = self._hinge.joint
        if joint is None or np.linalg.norm(point - joint.at(joint.locate(point[None]))[0]) < OFF_TURN:
            self._insisted = 0
            return False
        self._insisted += 1
        given_up = self._insisted > _INSISTED
        if given_up:
            self._give_up()
        return given_up

    def _give_up(self) -> None:
        self._hinge, self._normal = HingeEstimator(self.sigma), None
        self._contradicted = self._insisted = 0

    def learn(self, point: Float[np.ndarray, "3"]) -> None:
        """The query is seen at a point, and trusted, in the newest frame."""
        if self._plane is not None and not self._plane.behind:
            self._hinge.add(point, self._plane)

    def turned(self, joint: Joint) -> float | None:
        """Where on a joint the query is by how the front stands in the newest frame; None where that is not known."""
        own = self._hinge.joint
        if own is None or self._plane is None:
            return None
        turned = self._hinge.turned(self._plane.normal)
        return float(joint.locate(own.rest[None])[0] + np.sign(joint.axis @ own.axis) * turned)
