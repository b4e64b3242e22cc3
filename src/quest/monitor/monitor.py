"""The monitor of one stream: signals in, probabilities and alarms out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64, Int64

from quest.errors import InputError
from quest.monitor import memory as memories
from quest.monitor.alarm import Alarm, Verdict
from quest.monitor.calibration import Calibration
from quest.monitor.calibrator import probability
from quest.monitor.conformal import Budget, Threshold
from quest.monitor.reason import reason
from quest.monitor.signals import Signals

_KNOWN_THRESHOLDS = 1000


@dataclass
class MonitorState:
    """What the next verdict depends on; rows are queries, in the order of ``name``."""

    statistic: Float64[np.ndarray, "N Z"]
    """Of each query."""
    name: dict[int, str] = field(default_factory=dict)
    """By key, of the queries that are being watched."""
    open: dict[int, Alarm] = field(default_factory=dict)
    """Alarms by key."""
    memory: Float64[np.ndarray, "N R S"] = field(default_factory=lambda: memories.start(0))
    """Of each query's signals."""
    restart: Int64[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Number, over the stream, of each query's last alarm that was cleared; 0 without any."""
    origin: Int64[np.ndarray, " N"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """The frame from which each query's blocks count."""
    frames: int = 0
    """That were seen."""
    restarts: int = 0
    """Alarms that were cleared."""


class Monitor:
    """Watches the queries of one stream.

    On a stream in which no identity is lost, the probability that any query raises any alarm is at most alpha, as far
    as the stream is like the calibration streams; ``docs/monitor.md`` says what that means. An alarm stays open until
    it is cleared.

    Args:
        calibration: what is stored with the weights.
        alpha: in (0, 1).
        alpha_frames: alpha is for every so many frames, in a stream without an end; None for the whole stream.

    Raises:
        ConfigError: alpha is no probability, or there are no frames.
    """

    def __init__(self, calibration: Calibration, *, alpha: float, alpha_frames: int | None = None) -> None:
        self.calibration = calibration
        self.budget = Budget(alpha, alpha_frames)
        self._thresholds: dict[tuple[int, int], Threshold] = {}
        self.state = MonitorState(statistic=np.zeros((0, calibration.statistic.size)))

    def watch(self, key: int, name: str) -> None:
        """Begin to watch a query; its next frame is its first.

        Args:
            key: number of the query, unique in the stream.
            name: what alarms call it.

        Raises:
            InputError: the key is being watched already.
        """
        if key in self.state.name:
            raise InputError(f"monitor: query {key} is being watched already; forget it first")
        self.state.name[key] = name
        state = self.state
        state.memory = np.concatenate([state.memory, memories.start(1)])
        state.statistic = np.concatenate([state.statistic, np.zeros((1, state.statistic.shape[1]))])
        state.restart, state.origin = np.append(state.restart, 0), np.append(state.origin, 0)

    def forget(self, key: int) -> None:
        """Stop watching a query.

        Raises:
            InputError: it is not being watched.
        """
        row = self._find(key)
        for name in ("memory", "statistic", "restart", "origin"):
            setattr(self.state, name, np.delete(getattr(self.state, name), row, axis=0))
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
            self.state.restarts += 1
            self.state.restart[row] = self.state.restarts
            if self.budget.frames is None:
                self.state.origin[row] = self.state.frames
        self.state.memory[row] = memories.forgive(self.state.memory[row])
        self.state.statistic[row] = 0.0

    def step(self, keys: Sequence[int], signals: Signals, *, frame: int, stamp_s: float) -> Verdict:
        """Take in one frame.

        Args:
            keys: queries that are answered in this frame, in the order of the rows of ``signals``. Others that are
                being watched rest: their memory stays as it is.
            signals: what the tracker measured.
            frame: index of the frame, for alarms.
            stamp_s: its time in seconds, for alarms.

        Raises:
            InputError: a key is not being watched or comes twice, or there are not as many rows as keys.
        """
        if len(keys) != len(signals) or len(set(keys)) != len(keys):
            raise InputError(
                f"monitor: expected one row of signals per query, got {len(signals)} for keys {list(keys)}"
            )
        rows = np.array([self._find(key) for key in keys], dtype=np.int64)
        calibrator = self.calibration.calibrator
        values = signals.values.astype(np.float64)
        memory, features = calibrator.step(self.state.memory[rows], values)
        logit = calibrator.logit(features)
        lost_p = probability(logit)
        age = self.budget.since(self.state.frames - self.state.origin)
        # A block begins as a calibration stream did, from nothing: only so are its maxima comparable; also who rests.
        self.state.statistic[age % self.calibration.block_frames == 0] = 0.0
        state, statistic = self.calibration.statistic.update(self.state.statistic[rows], logit)
        self.state.memory[rows], self.state.statistic[rows] = memory, state
        block = age[rows] // self.calibration.block_frames + 1
        raised = []
        for i, key in enumerate(keys):
            limit = self._threshold(int(block[i]), int(self.state.restart[rows[i]]))
            if key not in self.state.open and statistic[i] > limit.value:
                why = self._reason(features[i], memory[i], values[i], float(lost_p[i]))
                alarm = Alarm(
                    self.state.name[key], int(key), int(frame), float(stamp_s), float(statistic[i]), limit.value,
                    limit.alpha, why, limit.extrapolated,
                )  # fmt: skip
                self.state.open[key] = alarm
                raised.append(alarm)
        self.state.frames += 1
        return Verdict(
            lost_p=lost_p.astype(np.float32),
            statistic=statistic.astype(np.float32),
            open=tuple(self.state.open.get(key) for key in keys),
            raised=tuple(raised),
        )

    def _find(self, key: int) -> int:
        if key not in self.state.name:
            raise InputError(f"monitor: query {key} is not being watched; call watch({key}, name) first")
        return list(self.state.name).index(key)

    def _threshold(self, block: int, restart: int) -> Threshold:
        if len(self._thresholds) > _KNOWN_THRESHOLDS:  # a stream has no end
            self._thresholds.clear()
        if (block, restart) not in self._thresholds:
            part = self.budget.part(block=block, restart=restart, block_frames=self.calibration.block_frames)
            self._thresholds[block, restart] = self.calibration.threshold(part)
        return self._thresholds[block, restart]

    def _reason(self, features: np.ndarray, memory: np.ndarray, values: np.ndarray, lost_p: float) -> str:
        calibrator = self.calibration.calibrator
        return reason(
            calibrator.shares(features, memory),
            np.where(np.isfinite(values), values, calibrator.unsquash(memory[memories.FAST])),
            calibrator.unsquash(memory[memories.LEVEL]),
            memory[memories.OFF],
            lost_p=lost_p,
        )
