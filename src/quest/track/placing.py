"""From what the network sees to where queries are: drawn to their joints where seen, held on them where not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from quest.model.config import NetworkConfig
from quest.model.decoder import Prediction
from quest.model.observation import FrameBatch
from quest.track.evidence import FrameEvidence
from quest.track.expectation import BeliefRow
from quest.track.following import Following
from quest.track.settings import TrackerConfig

LOST_BELOW = 0.3
"""Probability of the right identity below which a query is lost and its joint learns nothing."""

_LEAP = 0.12
_COVERED = 0.5
_AFTER_ALL = 0.2
_OFF_JOINT_SIGMAS = 4.0
_INSISTING = 10
_LONG_INSISTING = 30
_OFF_TURN_SIGMAS = 2.5
_SURE = 0.8
"""How sure the network must be, of seen and right alike, to take a query off the turn of a front in sight ..."""
_RATHER_SURE = 0.5
"""... and of one that is not in sight."""


@dataclass(frozen=True)
class Placed:
    """Where K queries are in a frame, reference frame."""

    point: Float[np.ndarray, "K 3"]
    """The answers; NaN where nothing is known."""
    judged: Float[np.ndarray, "K 3"]
    """The places that are to be judged: the answers, but what the search sees where an identity is in doubt."""
    seen: Float[np.ndarray, " K"]
    """Probability that each is seen."""
    held: Bool[np.ndarray, " K"]
    """Whether the answer is held without being seen."""
    trusted: Bool[np.ndarray, " K"]
    """Whether the answer was seen and taken for right."""
    residual: Float[np.ndarray, " K"]
    """Distance of the candidate to the joint's curve in standard deviations, NaN where unknown."""
    room: Float[np.ndarray, " K"]
    """How far what is seen at the judged place lies behind it; NaN until queries of a link have shared."""


class Placer:
    """Places the queries of one frame.

    Args:
        following: the queries, which learn from being placed.
        prediction: the network's answers for the frame (B = T = 1).
        frames: the frame.
        network: its configuration.
        picture_px: edges of the image on its input (see :class:`~quest.geometry.letterbox.Letterbox`).
        config: settings of tracking.
        elapsed: frames since the one before.
        now: time of the frame, in frames.
    """

    def __init__(
        self,
        following: Sequence[Following],
        prediction: Prediction,
        frames: FrameBatch,
        *,
        network: NetworkConfig,
        picture_px: tuple[float, float, float, float],
        config: TrackerConfig,
        elapsed: float,
        now: float,
    ) -> None:
        self._following = following
        self._config = config
        self._elapsed = elapsed
        self._now = now
        log_p = prediction.logits[0, 0].log_softmax(dim=-1)
        self._evidence = [FrameEvidence(frames, log_p[k], network, picture_px) for k in range(len(following))]
        self._seen = as_array(prediction.visible_logit[0, 0].sigmoid())
        self._right = as_array(prediction.right_logit[0, 0].sigmoid())

    def place(self, candidate: Float[np.ndarray, "K 3"], joints: Sequence[BeliefRow]) -> Placed:
        """Answers, grounded in joints unless the settings say otherwise.

        Args:
            candidate: lifted points of the frame alone.
            joints: the network's beliefs on joints.
        """
        k = len(self._following)
        point, judged = candidate.copy(), candidate.copy()
        residual, seen, held = np.full(k, np.nan), self._seen.copy(), np.zeros(k, bool)
        for i, query in enumerate(self._following):
            own = candidate[i]
            residual[i] = query.ground.residual(own)
            if query.doubted:
                point[i] = self._hold(i, own, 0.0)  # what seems to be seen says nothing
                continue
            if self._config.ground:
                seen[i] = self._seen_at(i, own, residual[i])
            held[i] = query.place is not None and seen[i] < self._config.hold_below
            if held[i]:
                point[i] = self._hold(i, own, seen[i])
            elif np.isfinite(own).all():
                point[i], query.buried = self._see(i, own, joints[i]), False
            judged[i] = point[i]
        doubted = np.array([query.doubted for query in self._following], bool)
        trusted = ~held & ~doubted & (self._right >= LOST_BELOW)
        return Placed(point, judged, seen, held, trusted, residual, np.full(k, np.nan))

    def room(self, judged: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, " K"]:
        """How far what is seen at each query's judged place lies behind it, reference units."""
        return np.array([e.room(p[None])[0] for e, p in zip(self._evidence, judged, strict=True)]).reshape(len(judged))

    def _see(self, i: int, own: np.ndarray, joint: BeliefRow) -> np.ndarray:
        query = self._following[i]
        if not self._config.ground:
            return own
        if self._right[i] >= LOST_BELOW:
            query.ground.see(own, joint, now=self._now)
        return query.ground.settle(own)

    def _hold(self, i: int, own: np.ndarray, seen: float) -> np.ndarray:
        query = self._following[i]
        if query.place is None:
            return own
        if not self._config.ground:
            return query.place
        return query.ground.hide(query.place, own, seen, self._evidence[i], buried=query.buried, elapsed=self._elapsed)

    def _seen_at(self, i: int, own: np.ndarray, residual: float) -> float:
        """How probably a query is seen where the network sees it, given what is before the places its joint allows.

        Where something came before them and the answer leapt away, it leapt onto what came or onto a look-alike: the
        entity is behind it. What was so buried and is said to be seen again must lie on its joint, unless the network
        insists; where it is seen just where the joint holds it, and nothing is before that any more, it is seen.
        """
        query, seen = self._following[i], float(self._seen[i])
        if query.place is None:
            return seen
        leapt = not np.linalg.norm(own - query.place) < _LEAP
        looked = leapt or query.buried
        covered = looked and query.ground.covered(query.place, self._evidence[i], self._elapsed) > _COVERED
        query.buried |= covered and leapt
        front = query.ground.front
        off_turn = front.joint is not None and residual > _OFF_TURN_SIGMAS
        sure = min(seen, self._right[i]) >= (_SURE if front.in_sight else _RATHER_SURE)
        if off_turn and not query.buried and not sure and query.refused < _LONG_INSISTING:
            query.refused += 1
            return min(seen, _AFTER_ALL)
        if not looked:
            query.refused = 0
            return seen
        on_joint = residual < _OFF_JOINT_SIGMAS
        if not leapt:
            query.refused = 0
            return seen if covered or not on_joint else max(seen, self._config.hold_below)
        refuse = query.buried and not on_joint and query.refused < _INSISTING
        query.refused = query.refused + 1 if refuse and not covered else 0
        return min(seen, _AFTER_ALL) if covered or refuse else seen


def as_array(point: Tensor) -> np.ndarray:
    """A tensor as float64 on the CPU."""
    return point.detach().cpu().to(torch.float64).numpy()
