"""What the monitor knows from calibration streams; stored with the weights as one JSON text."""

from __future__ import annotations

import bisect
import json
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float64

from quest.errors import ConfigError, WeightsError
from quest.monitor import memory as memories
from quest.monitor.calibrator import LOGIT_LIMIT, Calibrator
from quest.monitor.conformal import Budget, Threshold, least_alpha, threshold
from quest.monitor.signals import SIGNALS
from quest.monitor.statistic import Cusum

FORMAT = 3
"""Version of the text."""

Unit = Literal["object", "take"]
"""What a promise is about: other objects, or other takes of the same objects."""

_DIGITS = 4
"""Significant digits of the calibrator's numbers."""

_DECIMALS = 4
"""Decimals of the maxima."""

_MANY_BLOCKS = 100_000
"""An alarm that can come in so many blocks can come at any time."""


@dataclass(frozen=True)
class Calibration:
    """A calibrator, a statistic, and how large the statistic gets where nothing is lost."""

    calibrator: Calibrator
    """From signals to log odds of a loss."""
    statistic: Cusum
    """Collects these over frames."""
    maxima: Float64[np.ndarray, " n"]
    """Of the statistic in each loss-free calibration stream, over queries and frames; ascending."""
    block_frames: int
    """Length of the calibration streams, frames."""
    about: str
    """What it was calibrated on, a line for people."""
    revision: int
    """Of the tracker whose signals these are (``quest.track.settings.REVISION``)."""
    unit: Unit = "object"
    """What each of the maxima is of, and so what the promise is about."""

    def __post_init__(self) -> None:
        if not len(self.maxima) or not np.isfinite(self.maxima).all() or (np.diff(self.maxima) < 0).any():
            raise WeightsError("monitor: expected at least one maximum, finite and ascending; calibrate again")
        if self.unit not in get_args(Unit):
            raise WeightsError(f"monitor: expected unit object or take, got {self.unit!r}; calibrate again")
        if self.block_frames < 1:
            raise WeightsError(f"monitor: expected block_frames >= 1, got {self.block_frames}; calibrate again")

    def threshold(self, alpha: float) -> Threshold:
        """What loss-free streams of the calibration's length exceed with a probability of at most alpha.

        Raises:
            ConfigError: alpha is not in (0, 1).
        """
        return threshold(self.maxima, alpha)

    @property
    def least_alpha(self) -> float:
        """Smallest alpha of a stream whose first block has a threshold that is promised, not extrapolated."""
        return least_alpha(len(self.maxima))

    def shortfall(self, budget: Budget, *, frames: int | None = None) -> str | None:
        """Which alarms there will never be, as the calibration is too small for it; None if all can be.

        Where alpha is for a whole stream, thresholds rise from block to block, and the statistic, which starts anew in
        each, and after as many frames as alpha is for, has a largest value.

        Args:
            budget: of false alarms.
            frames: length of the stream, if it is known: what comes after it is not missed.
        """
        watched = (self.block_frames, budget.frames, frames)
        most = self.statistic.most(LOGIT_LIMIT, min(n for n in watched if n is not None))

        def silent(block: int) -> bool:
            part = budget.part(block=block, restart=0, block_frames=self.block_frames)
            return self.threshold(part).value >= most

        blocks = _MANY_BLOCKS if frames is None else -(-frames // self.block_frames)
        block = bisect.bisect_left(range(1, blocks + 1), True, key=silent)
        if block == blocks:
            return None
        rest = f"after {block * self.block_frames} frames of a stream" if block else "at all"
        return (
            f"no alarm {rest} at {budget}: calibrated on {len(self.maxima)} loss-free streams of "
            f"{self.block_frames} frames; more and longer ones promise more, and so does alpha for so many frames"
        )

    def to_json(self) -> str:
        """One line of text, stored with the weights.

        The calibrator's numbers are rounded to four significant digits and the maxima up to four decimals, so fit the
        maxima with a calibrator that has been through the text (:func:`rounded`).
        """
        raw = {
            "format": FORMAT,
            "signals": SIGNALS,
            "features": memories.FEATURES,
            "calibrator": {f.name: _plain(getattr(self.calibrator, f.name)) for f in fields(Calibrator)},
            "statistic": {"drift": self.statistic.drift, "keep": self.statistic.keep},
            "maxima": (np.ceil(np.round(self.maxima * 10**_DECIMALS, 6)) / 10**_DECIMALS).tolist(),
            "block_frames": self.block_frames,
            "about": self.about,
            "revision": self.revision,
            "unit": self.unit,
        }
        return json.dumps(raw, separators=(",", ":"), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """Read what :meth:`to_json` wrote.

        Raises:
            WeightsError: the text is damaged, or was written for other signals.
        """
        try:
            raw = json.loads(text)
            if (raw["format"], tuple(raw["signals"]), raw["features"]) != (FORMAT, SIGNALS, memories.FEATURES):
                raise WeightsError(
                    "monitor stored with the weights: it was calibrated on other signals than this version of quest "
                    "has; run `quest weights calibrate` again"
                )
            values = raw["calibrator"]
            return cls(
                calibrator=Calibrator(**{name: np.array(value, np.float64) for name, value in values.items()}),
                statistic=Cusum(**raw["statistic"]),
                maxima=np.array(raw["maxima"], np.float64),
                block_frames=int(raw["block_frames"]),
                about=str(raw["about"]),
                revision=int(raw["revision"]),
                unit=raw["unit"],
            )
        except (json.JSONDecodeError, KeyError, TypeError, ValueError, AttributeError, ConfigError) as error:
            raise WeightsError(
                f"monitor stored with the weights cannot be read ({type(error).__name__}: {error}); "
                "run `quest weights calibrate` again"
            ) from error


def rounded(calibrator: Calibrator) -> Calibrator:
    """The calibrator as it is after being written and read: what thresholds must be computed with."""
    return Calibrator(**{f.name: _round(getattr(calibrator, f.name)) for f in fields(Calibrator)})


def _round(values: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Every number with four significant digits."""
    texts = [f"{value:.{_DIGITS}g}" for value in values.ravel()]
    return np.array([float(text) for text in texts]).reshape(values.shape)


def _plain(values: np.ndarray) -> Any:
    return _round(values).tolist()
