"""Finding that goes on: the finder looks again at later frames, and looks vote for what is not followed yet.

A candidate holds the log odds that it is there. A look adds the log-likelihood ratio of what the finder says at its
place, less what the look before said already: errors of successive looks are an autoregressive process of first order,
whose correlation falls as the descriptor of the place changes. The same picture again tells nothing new.

Reference: Poor, An introduction to signal detection and estimation, 1994, section III.B (coherent detection in
dependent noise).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logit

from quest.errors import ConfigError
from quest.filter import step as filtering
from quest.filter.step import FilterState
from quest.filter.view import in_image
from quest.model.found import Found

EVERY_S = 0.5
"""Time between looks, seconds of the stream's clock."""
PRIOR = float(logit(0.069))
"""That what the finder names at all is there. This and what follows is fitted by ``benchmarks/fit_looks.py``."""
OVERLOOKED = float(np.log(0.087))
"""Log-likelihood ratio of naming nothing: the share of what is there that is not named with any score."""
FORGOTTEN = PRIOR + OVERLOOKED
"""Log odds below which a candidate is forgotten: those of a place of which the finder said nothing once."""
CHANGE = 0.066
"""Fall of the cosine of a place's descriptors with which the correlation of looks falls to 1 / e."""


@dataclass(frozen=True)
class Candidates:
    """C things that may be there and are not followed, in the frame of a look."""

    uv_px: Float[np.ndarray, "C 2"]
    log_odds: Float[np.ndarray, " C"]
    """That it is there."""
    evidence: Float[np.ndarray, " C"]
    """Log-likelihood ratio of what the last look said of it."""
    repeats: Float[np.ndarray, " C"]
    """Correlation of the errors of that look and of the next one."""

    @classmethod
    def none(cls) -> Candidates:
        """Before the first look."""
        return cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))

    def only(self, rows: Int[np.ndarray, " M"]) -> Candidates:
        """Some of them."""
        return Candidates(*(value[rows] for value in vars(self).values()))

    def carried(self, old: FilterState, new: FilterState, warp: Float[np.ndarray, "3 3"]) -> Candidates:
        """Those that are in view in a later frame; ``warp`` is the homography to it."""
        uv_px = filtering.carry(old, new, warp, self.uv_px)
        looks = [p.describe(p.from_camera(uv)) for p, uv in ((old.picture, self.uv_px), (new.picture, uv_px))]
        cosine = (looks[0] * looks[1]).sum(axis=1)
        repeats = self.repeats * np.exp(np.minimum(cosine.astype(np.float64) - 1, 0) / CHANGE)
        there = Candidates(uv_px, self.log_odds, self.evidence, repeats)
        return there.only(np.flatnonzero(in_image(new.picture.from_camera(uv_px), new.picture.size)))

    def after(self, found: Found, same: Bool[np.ndarray, "N C"]) -> Candidates:
        """What was found and is not followed, in its order, then the candidates that none of it may be."""
        each = np.arange(len(self.uv_px))
        was = np.full(len(found), len(each))  # what is found for the first time goes on from what the last row says
        for i, row in enumerate(same):
            free = np.flatnonzero(row & ~np.isin(each, was))
            was[i] = free[self.log_odds[free].argmax()] if len(free) else len(each)
        missed = np.setdiff1d(each, was)
        log_odds, said, repeats = (
            np.append(values, first)[np.concatenate([was, missed])]
            for values, first in ((self.log_odds, PRIOR), (self.evidence, 0.0), (self.repeats, 0.0))
        )
        says = np.maximum(found.logit - PRIOR, OVERLOOKED)
        evidence = np.concatenate([says, np.full(len(missed), OVERLOOKED)])
        return Candidates(
            np.concatenate([found.uv_px, self.uv_px[missed]]),
            log_odds + (evidence - repeats * said) / (1 + repeats),
            evidence,
            np.ones(len(evidence)),
        )


@dataclass
class Finding:
    """What the looks of a stream have told."""

    every_s: float
    """Time between looks, seconds."""
    behind: bool
    """Whether looks are made in the background."""
    looked_s: float | None = None
    """Time of the last frame of which a look was taken in."""
    frame: FilterState | None = None
    """After the frame of the newest look."""
    warp: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Homography of the picture since then."""
    candidates: Candidates = field(default_factory=Candidates.none)
    """In that frame."""

    @classmethod
    def of(cls, online: bool | float | int, *, behind: bool) -> Finding | None:
        """As :meth:`quest.track.Tracker.stream` is told; None where finding does not go on.

        Raises:
            ConfigError: it is to look every so many seconds, and they are not more than 0.
        """
        if online is False:
            return None
        if not 0 < online < np.inf:
            raise ConfigError(f"online: expected True, or seconds between looks above 0, got {online}")
        return cls(EVERY_S if online is True else float(online), behind)

    def due(self, now_s: float) -> bool:
        """Whether it is time for a look, by the stream's clock."""
        return self.looked_s is None or now_s - self.looked_s >= self.every_s

    def begin(self, state: FilterState) -> None:
        """A look at the newest frame begins."""
        if self.frame is not None:
            self.candidates = self.candidates.carried(self.frame, state, self.warp)
        self.frame, self.warp = state, np.eye(3)


class Looker:
    """Makes one look at a time: ``behind`` the stream in a thread, which ends with the looker, or at once."""

    def __init__(self, *, behind: bool) -> None:
        self._pool = ThreadPoolExecutor(1, "quest-looker") if behind else None
        self._under_way: Future[Found] | None = None

    @property
    def idle(self) -> bool:
        """Whether no look is under way or waits to be taken."""
        return self._under_way is None

    def begin(self, look: Callable[[], Found]) -> None:
        """Begin a look."""
        if self._pool is not None:
            self._under_way = self._pool.submit(look)
        else:
            found, self._under_way = look(), Future()
            self._under_way.set_result(found)

    def take(self) -> Found | None:
        """The result of a look, once; None as long as there is none. An error in it is raised here."""
        if self._under_way is None or not self._under_way.done():
            return None
        look, self._under_way = self._under_way, None
        return look.result()
