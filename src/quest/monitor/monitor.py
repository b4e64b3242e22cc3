"""The monitor of one stream: log odds in, probabilities and alarms out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from quest.errors import InputError
from quest.monitor.calibration import Calibration, probability
from quest.monitor.conformal import Budget, Threshold

_KNOWN_THRESHOLDS = 1000


@dataclass(frozen=True)
class Alarm:
    """The identity of a query is probably lost."""

    name: str
    """The query's name."""
    query: int
    """The query's key."""
    frame: int
    """Frame in which the alarm was raised."""
    stamp_s: float
    """Time of that frame, seconds."""
    statistic: float
    """The query's statistic in that frame."""
    threshold: float
    """What it exceeded."""
    alpha: float
    """The share of loss-free streams that may alarm; how the threshold was chosen."""
    reason: str
    """What speaks for a loss, in words."""
    extrapolated: bool = False
    """Whether the threshold lies beyond what the calibration streams can support by themselves and was read off a
    fitted tail."""


@dataclass(frozen=True)
class Verdict:
    """What the monitor makes of one frame; rows in the order of the keys that were asked."""

    lost_p: Float32[np.ndarray, " K"]
    """Calibrated probability that the identity is lost; NaN of queries that rest."""
    statistic: Float32[np.ndarray, " K"]
    """The sequential statistic, which an alarm compares with its threshold."""
    open: tuple[Alarm | None, ...]
    """The alarm of each query that has been raised and not cleared, or None."""
    raised: tuple[Alarm, ...]
    """Alarms raised in this frame."""
    cleared: tuple[Alarm, ...]
    """Alarms that ended in this frame."""


@dataclass
class MonitorState:
    """What the next verdict depends on; rows are queries, in the order of ``name``."""

    statistic: Float64[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0))
    """Of each query."""
    name: dict[int, str] = field(default_factory=dict)
    """By key, of the queries that are being watched."""
    open: dict[int, Alarm] = field(default_factory=dict)
    """Alarms by key."""
    restart: Int64[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Number, over the stream, of each query's last restart; 0 without any."""
    origin: Int64[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """The frame from which each query's blocks count."""
    frames: int = 0
    """That were seen."""
    restarts: int = 0
    """Alarms that ended, and switches to another calibration."""


class Monitor:
    """Watches the queries of one stream.

    On a stream in which no identity is lost, the probability that any query raises any alarm is at most alpha, as far
    as the stream is like the calibration streams; ``docs/monitor.md`` says what that means. An alarm ends when its
    statistic has fallen back to zero.

    Args:
        calibration: for what the frames bring.
        alpha: in (0, 1).
        alpha_frames: alpha is for every so many frames, in a stream without an end; None for the whole stream.

    Raises:
        ConfigError: alpha is no probability, or there are no frames.
    """

    def __init__(self, calibration: Calibration, *, alpha: float, alpha_frames: int | None = None) -> None:
        self.calibration = calibration
        self.budget = Budget(alpha, alpha_frames)
        self._thresholds: dict[tuple[int, int], Threshold] = {}
        self.state = MonitorState()

    def watch(self, key: int, name: str) -> None:
        """Begin to watch a query, by a key unique in the stream; its next frame is its first.

        Raises:
            InputError: the key is being watched already.
        """
        state = self.state
        if key in state.name:
            raise InputError(f"monitor: query {key} is being watched already; forget it first")
        state.name[key] = name
        state.statistic = np.append(state.statistic, 0.0)
        state.restart, state.origin = np.append(state.restart, 0), np.append(state.origin, 0)

    def forget(self, key: int) -> None:
        """Stop watching a query.

        Raises:
            InputError: it is not being watched.
        """
        row = self._find(key)
        for name in ("statistic", "restart", "origin"):
            setattr(self.state, name, np.delete(getattr(self.state, name), row))
        del self.state.name[key]
        self.state.open.pop(key, None)

    def rename(self, key: int, name: str) -> None:
        """Call a query by another name in alarms from now on, in an open one too.

        Raises:
            InputError: it is not being watched.
        """
        self._find(key)
        self.state.name[key] = name
        if key in self.state.open:
            self.state.open[key] = replace(self.state.open[key], name=name)

    def alarm(self, key: int) -> Alarm | None:
        """The open alarm of a query."""
        return self.state.open.get(key)

    def clear(self, key: int) -> None:
        """The identity is right again: the alarm ends, and the statistic starts anew.

        What follows the j-th time spends alpha / 2^j, where alpha is for the whole stream, and its blocks count from
        here. Where alpha is for so many frames, all queries share the blocks of the stream, or there would be more of
        them in so many frames than alpha is divided by.

        Raises:
            InputError: the query is not being watched.
        """
        row = self._find(key)
        if self.state.open.pop(key, None) is not None:
            self._restart(np.array([row]))
        self.state.statistic[row] = 0.0

    def switch(self, calibration: Calibration) -> None:
        """Go on with another calibration, as where depth begins: statistics start anew, open alarms stay.

        It spends of alpha what a cleared alarm does.
        """
        self.calibration = calibration
        self._thresholds.clear()
        if self.state.frames:
            self._restart(np.arange(len(self.state.statistic)))
        self.state.statistic[:] = 0.0

    def step(
        self,
        keys: Sequence[int],
        log_odds: Float[np.ndarray, " K"],
        why: Callable[[int], str],
        *,
        frame: int,
        stamp_s: float,
    ) -> Verdict:
        """Take in one frame.

        What comes after a loss must not make its alarm harder to end: while an alarm is open, the sum goes on from
        no more than its threshold. The alarm ends in the frame in which the statistic is zero again, as if it
        were cleared.

        Args:
            keys: queries that are answered in this frame, in the order of the rows of ``log_odds``. Others that are
                being watched rest: their statistic stays as it is.
            log_odds: the tracker's own, that each query is lost. A query whose log odds are NaN rests too.
            why: gives the reason for the alarm of a row in words; called only where one is raised.
            frame: index of the frame, for alarms.
            stamp_s: its time in seconds, for alarms.

        Raises:
            InputError: a key is not being watched or comes twice, or there are not as many rows as keys.
        """
        if len(keys) != len(log_odds) or len(set(keys)) != len(keys):
            raise InputError(f"monitor: expected log odds of each query, got {len(log_odds)} for keys {list(keys)}")
        state = self.state
        rows = np.array([self._find(key) for key in keys], dtype=np.int64)
        logit = self.calibration.logit(log_odds)
        known = ~np.isnan(logit)
        self._begin_blocks()
        told = state.statistic[rows]
        told[known] = self.calibration.statistic.update(told[known, None], logit[known])[1]
        state.statistic[rows] = told
        raised, over = [], []
        for i in np.flatnonzero(known).tolist():
            key, row, value, limit = keys[i], rows[i], float(told[i]), self._limit(rows[i])
            alarm = state.open.get(key)
            if alarm is None and value > limit.value:
                alarm = Alarm(
                    state.name[key], int(key), int(frame), float(stamp_s), value, limit.value, limit.alpha,
                    why(i), limit.extrapolated,
                )  # fmt: skip
                state.open[key] = alarm
                raised.append(alarm)
            elif alarm is not None and value == 0.0:
                over.append(alarm)
            if alarm is not None:
                state.statistic[row] = min(value, alarm.threshold, limit.value)
        state.frames += 1
        for alarm in over:
            self.clear(alarm.query)
        return Verdict(
            lost_p=probability(logit).astype(np.float32),
            statistic=told.astype(np.float32),
            open=tuple(state.open.get(key) for key in keys),
            raised=tuple(raised),
            cleared=tuple(over),
        )

    def _begin_blocks(self) -> None:
        """A block begins as a calibration stream did, from nothing: only so are its maxima comparable.

        That holds for queries that rest too, but not where an alarm is open, which ends by what is seen alone.
        """
        watched = np.array([key not in self.state.open for key in self.state.name], dtype=bool)
        self.state.statistic[watched & (self._age() % self.calibration.block_frames == 0)] = 0.0

    def _age(self) -> Int64[np.ndarray, " N"]:
        """Frames since the first block of each query began."""
        return self.budget.since(self.state.frames - self.state.origin)

    def _restart(self, rows: Int64[np.ndarray, " M"]) -> None:
        """Queries whose blocks begin anew, where alpha is for the whole stream, with less of it."""
        self.state.restarts += 1
        self.state.restart[rows] = self.state.restarts
        if self.budget.frames is None:
            self.state.origin[rows] = self.state.frames

    def _find(self, key: int) -> int:
        if key not in self.state.name:
            raise InputError(f"monitor: query {key} is not being watched; call watch({key}, name) first")
        return list(self.state.name).index(key)

    def _limit(self, row: np.int64) -> Threshold:
        """What the statistic of a query has to exceed in this frame."""
        if len(self._thresholds) > _KNOWN_THRESHOLDS:  # a stream has no end
            self._thresholds.clear()
        block_frames = self.calibration.block_frames
        at = int(self._age()[row]) // block_frames + 1, int(self.state.restart[row])
        if at not in self._thresholds:
            part = self.budget.part(block=at[0], restart=at[1], block_frames=block_frames)
            self._thresholds[at] = self.calibration.threshold(part)
        return self._thresholds[at]
