"""Which queries sit on one link, learned on line: they share one joint, and a seen one tells where a hidden one is.

Two queries are on one link if the motion of each explains the track of the other better than the other's own joint does
(see :func:`quest.grounding.link.evidence`). Handles that are opened one after the other are not joined. Two drawers
that slide side by side at the same time cannot be told from one link, and are joined until one moves alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import connected_components

from quest.errors import InputError
from quest.grounding.joint import Joint, JointKind
from quest.grounding.link import Tracks, evidence, fit_link, way_length

_KEEP_SIGMAS = 4.0
_TRAVEL_SIGMAS = 5.0
_ENOUGH_EVIDENCE = 5.0
_TRUSTED_SIGMAS = 4.0
_REGROUP_FRAMES = 3
_REFIT_FRAMES = 6


@dataclass(eq=False)
class LinkGroups:
    """The links that queries of one stream sit on.

    Memory is bounded: frames in which nothing moved are not kept, and of too many the one that tells least goes.
    Links are told anew with every third frame that is kept; at most one of them is fitted in a frame.

    Args:
        sigma: standard deviation of a point per coordinate.
        capacity: most frames that are kept.
    """

    sigma: float
    capacity: int = field(default=96, kw_only=True)
    _keys: list[int] = field(default_factory=list, init=False)
    _frames: Int[np.ndarray, " M"] = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    _points: Float[np.ndarray, "M K 3"] = field(default_factory=lambda: np.zeros((0, 0, 3)), init=False)
    _label: Int[np.ndarray, " K"] = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    _age: Int[np.ndarray, " K"] = field(default_factory=lambda: np.zeros(0, np.int64), init=False)
    _since: int = field(default=0, init=False)
    _own: dict[int, Joint] = field(default_factory=dict, init=False)
    _shared: dict[int, Joint] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma > 0) or self.capacity < 8:
            raise InputError(
                f"links: expected a positive sigma and a capacity of 8 or more, got {self.sigma}, {self.capacity}"
            )

    def see(self, frame: int, points: Mapping[int, Float[np.ndarray, "3"]], joints: Mapping[int, Joint | None]) -> None:
        """Learn from a frame.

        Args:
            frame: its number, larger than that of any frame before.
            points: the queries that are seen and trusted.
            joints: each query's own joint so far; those without a point are not read.

        Raises:
            InputError: a frame that is not newer, or a point that is not finite.
        """
        if len(self._frames) and frame <= self._frames[-1]:
            raise InputError(f"links: expected a frame after {self._frames[-1]}, got {frame}; see frames in order")
        for k, point in points.items():
            if np.shape(point) != (3,) or not np.isfinite(point).all():
                raise InputError(f"links: expected a finite point of query {k}, got {point}; leave out what is hidden")
            self._column(k)
            joint = joints.get(k)
            if joint is not None:
                self._own[k] = joint
        row = np.full((1, len(self._keys), 3), np.nan)
        for k, point in points.items():
            row[0, self._keys.index(k)] = point
        if self._tells(row[0]):
            self._points = np.concatenate((self._points, row))
            self._frames = np.append(self._frames, frame)
            self._age += 1
            self._since += 1
            if len(self._frames) > self.capacity:
                self._make_room()
        if self._since >= _REGROUP_FRAMES:
            self._since = 0
            self._regroup()
        else:
            self._refit()

    def partners(self, k: int) -> tuple[int, ...]:
        """The other queries on a query's link, as far as is known."""
        if k not in self._keys:
            return ()
        label = self._label[self._keys.index(k)]
        return tuple(other for other, at in zip(self._keys, self._label, strict=True) if at == label and other != k)

    def joint(self, k: int) -> Joint | None:
        """The joint that a query shares with its partners: one axis and one coordinate q; None without partners."""
        return self._shared.get(k)

    def predict(self, k: int, points: Mapping[int, Float[np.ndarray, "3"]]) -> Float[np.ndarray, "3"] | None:
        """Where a query must be by the link's motion, told by its partners that are seen now.

        Args:
            k: the query; a point of its own is not read.
            points: the queries that are seen and trusted in this frame.

        Returns:
            None without a seen partner that is on its joint.
        """
        joint = self._shared.get(k)
        if joint is None:
            return None
        found: list[tuple[float, float]] = []
        for other in self.partners(k):
            theirs, point = self._shared.get(other), points.get(other)
            if theirs is None or point is None:
                continue
            q = theirs.locate(point[None])
            noise = float(np.hypot(self.sigma, theirs.spread(q)[0]))
            if np.linalg.norm(point - theirs.at(q)[0]) < _TRUSTED_SIGMAS * noise:
                lever = theirs.radius if theirs.kind is JointKind.REVOLUTE else 1.0
                found.append((float(q[0]), lever**2))
        if not found:
            return None
        q, weight = np.array(found).T
        if joint.kind is JointKind.REVOLUTE:
            # Angles on both sides of half a turn.
            q = q[0] + np.angle(np.exp(1j * (q - q[0])))
        return joint.at(np.array([weight @ q / weight.sum()]))[0]

    def forget(self, k: int) -> None:
        """Drop a query; nothing happens if it was never seen."""
        if k not in self._keys:
            return
        partners, at = self.partners(k), self._keys.index(k)
        self._keys.pop(at)
        self._points = np.delete(self._points, at, axis=1)
        self._label, self._age = np.delete(self._label, at), np.delete(self._age, at)
        self._own.pop(k, None)
        for gone in (k, *(partners if len(partners) == 1 else ())):
            self._shared.pop(gone, None)

    def _column(self, k: int) -> None:
        if k in self._keys:
            return
        self._keys.append(k)
        self._points = np.concatenate((self._points, np.full((len(self._frames), 1, 3), np.nan)), axis=1)
        self._label = np.append(self._label, self._label.max(initial=-1) + 1)
        self._age = np.append(self._age, 0)

    def _tells(self, row: np.ndarray) -> bool:
        """Whether a query is new or went on since the last frame that was kept."""
        if not len(self._frames):
            return bool(np.isfinite(row).any())
        seen = np.isfinite(row[:, 0])
        never = seen & ~np.isfinite(self._points[:, :, 0]).any(axis=0)
        step = np.linalg.norm(row - self._points[-1], axis=-1)
        # A query that comes back after it was hidden tells something, too.
        return bool(never.any() or (step > _KEEP_SIGMAS * self.sigma).any() or (np.isnan(step) & seen).any())

    def _make_room(self) -> None:
        """Without the frame whose neighbours are nearest to each other; the first and the last stay."""
        step = np.linalg.norm(self._points[2:] - self._points[:-2], axis=-1)
        least = 1 + int(np.nan_to_num(step, nan=0.0).max(axis=1).argmin())
        self._points, self._frames = np.delete(self._points, least, axis=0), np.delete(self._frames, least)

    def _regroup(self) -> None:
        moving = [at for at, k in enumerate(self._keys) if k in self._own and self._moved(self._own[k])]
        linked = np.zeros((len(self._keys), len(self._keys)), bool)
        if len(moving) > 1:
            told = evidence(Tracks(self._points[:, moving], [self._own[self._keys[at]] for at in moving], self.sigma))
            linked[np.ix_(moving, moving)] = np.minimum(told, told.T) > _ENOUGH_EVIDENCE
        label = connected_components(linked, directed=False)[1].astype(np.int64)
        for at, k in enumerate(self._keys):
            if not np.array_equal(label == label[at], self._label == self._label[at]):
                self._age[at] = _REFIT_FRAMES
                self._shared.pop(k, None)
        self._label = label

    def _refit(self) -> None:
        """Fit the link that has waited longest, if it has for long enough."""
        size = np.bincount(self._label, minlength=1)[self._label] if len(self._label) else self._label
        waiting = np.where(size > 1, self._age, -1)
        if not len(waiting) or waiting.max() < _REFIT_FRAMES:
            return
        members = np.flatnonzero(self._label == self._label[waiting.argmax()])
        self._age[members] = 0
        keys = [self._keys[at] for at in members]
        fitted = fit_link(Tracks(self._points[:, members], [self._own[k] for k in keys], self.sigma))
        if fitted is not None:
            self._shared |= dict(zip(keys, fitted, strict=True))

    def _moved(self, joint: Joint) -> bool:
        return joint.kind is not JointKind.STATIC and way_length(joint) > _TRAVEL_SIGMAS * self.sigma
