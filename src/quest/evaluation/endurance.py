"""What a stream costs over a very long time: memory and time per frame, measured as it goes, and how they change."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from quest.errors import ConfigError, InputError
from quest.evaluation.bootstrap import LEVEL
from quest.model.network import QuestNetwork

RESAMPLES = 1000


@dataclass(frozen=True)
class Reading:
    """What was measured after some frames.

    Attributes:
        frames: frames done.
        resident_bytes: memory of the process that is in use.
        cpu_s: time of the processor so far, all threads.
        wall_s: time so far.
    """

    frames: int
    resident_bytes: int
    cpu_s: float
    wall_s: float


@dataclass(frozen=True)
class Change:
    """How the time per frame changed from the second tenth of a run to the last.

    Attributes:
        early_ms: median time per frame over the readings of the second tenth.
        late_ms: over those of the last.
        percent: change of the medians, percent of the early one.
        low: lower end of the 95 % interval, bootstrap over readings.
        high: upper end.
        readings: in each tenth.
    """

    early_ms: float
    late_ms: float
    percent: float
    low: float
    high: float
    readings: int


class FeatureRing:
    """The encoder's features of pictures that come again and again: computed at first, replayed later.

    The network's ``encode`` is replaced. Until :attr:`replay` is set it computes every picture, and keeps the features
    of each different one; then only pictures that are new are computed.

    Args:
        network: changed in place.
    """

    def __init__(self, network: QuestNetwork) -> None:
        self.replay = False
        self.computed = 0
        self._encode: Callable[[Tensor], Tensor] = network.encode
        self._known: dict[bytes, Tensor] = {}
        network.encode = self._features  # type: ignore[method-assign]

    def __len__(self) -> int:
        return len(self._known)

    def _features(self, rgb: Tensor) -> Tensor:
        key = hashlib.blake2b(rgb.detach().cpu().contiguous().numpy().data, digest_size=16).digest()
        if self.replay and key in self._known:
            return self._known[key]
        self.computed += 1
        # Kept once: replacing them at every pass would stir the memory that is to be measured.
        return self._known.setdefault(key, self._encode(rgb))


def forth_and_back(t: int, frames: int) -> int:
    """Frame of a clip at step ``t`` when it is played to its end, back to its start, and so on.

    Args:
        t: step, from 0.
        frames: of the clip.

    Raises:
        InputError: the clip has fewer than two frames.
    """
    if frames < 2:
        raise InputError(f"clip: expected at least 2 frames to play forth and back, got {frames}")
    period = 2 * (frames - 1)
    place = t % period
    return min(place, period - place)


def resident_bytes() -> int:
    """Memory of this process that is in use.

    Raises:
        ConfigError: the system has no ``/proc``.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError as error:
        raise ConfigError(f"resident memory: expected /proc/self/statm, got {error}; use Linux") from error
    return pages * os.sysconf("SC_PAGE_SIZE")


def memory_growth(readings: Sequence[Reading], *, since: int) -> tuple[float, float]:
    """Growth of the resident memory after some frames, in percent: at the end, and at its highest.

    Args:
        readings: in order.
        since: the first reading after at least so many frames is the reference.

    Raises:
        InputError: no reading is that late.
    """
    late = [r.resident_bytes for r in readings if r.frames >= since]
    if not late:
        raise InputError(f"readings: expected one after {since} frames, got none; run for longer")
    return 100.0 * (late[-1] / late[0] - 1.0), 100.0 * (max(late) / late[0] - 1.0)


def time_change(readings: Sequence[Reading], *, clock: str, seed: int = 0) -> Change:
    """Time per frame in the last tenth of the frames against the second.

    Args:
        readings: in order, evenly spaced, the first before any frame.
        clock: ``cpu_s`` or ``wall_s``.
        seed: of the bootstrap.

    Raises:
        InputError: a tenth holds no reading.
    """
    frames = np.array([r.frames for r in readings])
    per_frame_ms = 1e3 * np.diff([getattr(r, clock) for r in readings]) / np.diff(frames)
    tenth = -(-10 * frames[1:] // frames[-1])  # 1 to 10; a reading belongs to the frames before it
    early, late = per_frame_ms[tenth == 2], per_frame_ms[tenth == 10]
    if not len(early) or not len(late):
        raise InputError(f"readings: expected at least 10 after the first, got {len(per_frame_ms)}; run for longer")
    rng = np.random.default_rng(seed)
    drawn = [np.median(v[rng.integers(len(v), size=(RESAMPLES, len(v)))], axis=1) for v in (early, late)]
    tail = (1.0 - LEVEL) / 2.0
    low, high = np.quantile(100.0 * (drawn[1] / drawn[0] - 1.0), (tail, 1.0 - tail))
    before, after = float(np.median(early)), float(np.median(late))
    return Change(before, after, 100.0 * (after / before - 1.0), float(low), float(high), len(late))
