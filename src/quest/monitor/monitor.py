"""The monitor of one stream: signals in, probabilities and alarms out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from quest.errors import InputError
from quest.monitor import memory as memories
from quest.monitor.alarm import Alarm, Verdict
from quest.monitor.calibration import Calibration
from quest.monitor.calibrator import probability
from quest.monitor.conformal import Budget, Threshold
from quest.monitor.reason import reason
from quest.monitor.signals import Signals

_KNOWN_THRESHOLDS = 1000

_ARRAYS = ("keys", "memory", "statistic", "restart", "origin", "clock", "texts")


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
        self._row: dict[int, int] = {}
        self._name: dict[int, str] = {}
        self._open: dict[int, Alarm] = {}
        self._memory = memories.start(0)
        self._statistic = np.zeros((0, calibration.statistic.size))
        self._restart = np.zeros(0, np.int64)
        self._origin = np.zeros(0, np.int64)
        self._frames = 0
        self._restarts = 0

    def watch(self, key: int, name: str) -> None:
        """Begin to watch a query; its next frame is its first.

        Args:
            key: number of the query, unique in the stream.
            name: what alarms call it.

        Raises:
            InputError: the key is being watched already.
        """
        if key in self._row:
            raise InputError(f"monitor: query {key} is being watched already; forget it first")
        self._row[key] = len(self._row)
        self._name[key] = name
        self._memory = np.concatenate([self._memory, memories.start(1)])
        self._statistic = np.concatenate([self._statistic, np.zeros((1, self._statistic.shape[1]))])
        self._restart = np.append(self._restart, 0)
        self._origin = np.append(self._origin, 0)

    def forget(self, key: int) -> None:
        """Stop watching a query.

        Raises:
            InputError: it is not being watched.
        """
        row = self._find(key)
        for name in ("_memory", "_statistic", "_restart", "_origin"):
            setattr(self, name, np.delete(getattr(self, name), row, axis=0))
        self._row = {k: i for i, k in enumerate(k for k in self._row if k != key)}
        del self._name[key]
        self._open.pop(key, None)

    def rename(self, key: int, name: str) -> None:
        """Call a query by another name in alarms from now on, in an open one too.

        Raises:
            InputError: it is not being watched.
        """
        self._find(key)
        self._name[key] = name
        if key in self._open:
            self._open[key] = replace(self._open[key], name=name)

    def alarm(self, key: int) -> Alarm | None:
        """The open alarm of a query."""
        return self._open.get(key)

    def clear(self, key: int) -> None:
        """The identity is right again: the alarm ends, and the statistic starts anew.

        What follows the j-th time spends alpha / 2^j, where alpha is for the whole stream, and its blocks count from
        here. Where alpha is for so many frames, all queries share the blocks of the stream, or there would be more of
        them in so many frames than alpha is divided by.

        Raises:
            InputError: the query is not being watched.
        """
        row = self._find(key)
        if self._open.pop(key, None) is not None:
            self._restarts += 1
            self._restart[row] = self._restarts
            if self.budget.frames is None:
                self._origin[row] = self._frames
        self._memory[row] = memories.forgive(self._memory[row])
        self._statistic[row] = 0.0

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
        memory, features = calibrator.step(self._memory[rows], values)
        logit = calibrator.logit(features)
        lost_p = probability(logit)
        age = self.budget.since(self._frames - self._origin)
        # A block begins as a calibration stream did, from nothing: only so are its maxima comparable; also who rests.
        self._statistic[age % self.calibration.block_frames == 0] = 0.0
        state, statistic = self.calibration.statistic.update(self._statistic[rows], logit)
        self._memory[rows], self._statistic[rows] = memory, state
        block = age[rows] // self.calibration.block_frames + 1
        raised = []
        for i, key in enumerate(keys):
            limit = self._threshold(int(block[i]), int(self._restart[rows[i]]))
            if key not in self._open and statistic[i] > limit.value:
                why = self._reason(features[i], memory[i], values[i], float(lost_p[i]))
                alarm = Alarm(
                    self._name[key], int(key), int(frame), float(stamp_s), float(statistic[i]), limit.value,
                    limit.alpha, why, limit.extrapolated,
                )  # fmt: skip
                self._open[key] = alarm
                raised.append(alarm)
        self._frames += 1
        return Verdict(
            lost_p=lost_p.astype(np.float32),
            statistic=statistic.astype(np.float32),
            open=tuple(self._open.get(key) for key in keys),
            raised=tuple(raised),
        )

    def state(self) -> dict[str, np.ndarray]:
        """Everything that a continuation needs, as plain numeric arrays; texts are bytes of JSON."""
        texts = {
            "names": list(self._name.values()),
            "open": [asdict(alarm) for alarm in self._open.values()],
        }
        return {
            "keys": np.array(list(self._row), dtype=np.int64),
            "memory": self._memory.copy(),
            "statistic": self._statistic.copy(),
            "restart": self._restart.copy(),
            "origin": self._origin.copy(),
            "clock": np.array([self._frames, self._restarts], dtype=np.int64),
            "texts": np.frombuffer(json.dumps(texts).encode(), dtype=np.uint8).copy(),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from what :meth:`state` gave, as if nothing had happened in between.

        Raises:
            InputError: the state is of another monitor.
        """
        missing = [name for name in _ARRAYS if name not in state]
        if missing:
            raise InputError(f"monitor state: expected the arrays of Monitor.state(), {', '.join(missing)} are missing")
        keys = [int(key) for key in state["keys"]]
        shapes = {
            "memory": memories.start(len(keys)).shape,
            "statistic": (len(keys), self.calibration.statistic.size),
            "restart": (len(keys),),
            "origin": (len(keys),),
            "clock": (2,),
        }
        for name, shape in shapes.items():
            if state[name].shape != shape:
                raise InputError(f"monitor state: expected {name} of shape {shape}, got {state[name].shape}")
        try:
            texts = json.loads(state["texts"].tobytes().decode())
            names = dict(zip(keys, texts["names"], strict=True))
            alarms = {raw["query"]: Alarm(**raw) for raw in texts["open"]}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"monitor state: expected the texts of Monitor.state(), they cannot be read ({error})"
            ) from error
        self._row = {key: i for i, key in enumerate(keys)}
        self._name, self._open = names, alarms
        self._memory = state["memory"].astype(np.float64)
        self._statistic = state["statistic"].astype(np.float64)
        self._restart = state["restart"].astype(np.int64)
        self._origin = state["origin"].astype(np.int64)
        self._frames, self._restarts = int(state["clock"][0]), int(state["clock"][1])

    def _find(self, key: int) -> int:
        if key not in self._row:
            raise InputError(f"monitor: query {key} is not being watched; call watch({key}, name) first")
        return self._row[key]

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
