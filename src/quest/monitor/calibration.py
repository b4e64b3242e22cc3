"""What the monitor knows from calibration streams, and the file of it: for streams with depth, and colours alone."""

from __future__ import annotations

import bisect
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Float64

from quest.errors import WeightsError
from quest.monitor.conformal import Budget, Threshold, least_alpha, threshold
from quest.monitor.statistic import Cusum
from quest.untrusted import build, read_json, reading
from quest.whole_file import whole_file

FORMAT = 4
"""Version of the text."""

Unit = Literal["object", "take"]
"""What a promise is about: other objects, or other takes of the same objects."""

Inputs = Literal["depth", "colours"]
"""What the frames of a stream bring: colours with depth, or colours alone."""

LOGIT_LIMIT = 8.0
"""Log odds are kept within this: no single frame is surer than 0.99966."""

_DECIMALS = 4
"""Decimals of the maxima."""

_MANY_BLOCKS = 100_000
"""An alarm that can come in so many blocks can come at any time."""


@dataclass(frozen=True)
class Calibration:
    """Log odds made right, a statistic, and how large the statistic gets where nothing is lost.

    Reference: Platt, Probabilistic outputs for support vector machines, 1999, for slope and shift.
    """

    slope: float
    """What the tracker's own log odds of a loss are multiplied by."""
    shift: float
    """What is added to them then."""
    statistic: Cusum
    """Collects these log odds over frames."""
    maxima: Float64[np.ndarray, " n"]
    """Of the statistic in each loss-free calibration stream, over queries and frames; ascending."""
    block_frames: int
    """Length of the calibration streams, frames."""
    about: str
    """What it was calibrated on, a line for people."""
    revision: int
    """Of the tracker whose log odds these are (``quest.track.settings.REVISION``)."""
    unit: Unit = "object"
    """What each of the maxima is of, and so what the promise is about."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.slope) and self.slope > 0 and math.isfinite(self.shift)):
            raise WeightsError(
                f"monitor: expected a positive slope and a finite shift, got {self.slope} and {self.shift}; "
                "calibrate again"
            )
        if not len(self.maxima) or not np.isfinite(self.maxima).all() or (np.diff(self.maxima) < 0).any():
            raise WeightsError("monitor: expected at least one maximum, finite and ascending; calibrate again")
        if self.unit not in get_args(Unit):
            raise WeightsError(f"monitor: expected unit object or take, got {self.unit!r}; calibrate again")
        if self.block_frames < 1:
            raise WeightsError(f"monitor: expected block_frames >= 1, got {self.block_frames}; calibrate again")

    def logit(self, log_odds: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
        """Calibrated log odds that a query is lost, from the tracker's own; see :func:`adjusted`."""
        return adjusted(log_odds, slope=self.slope, shift=self.shift)

    def threshold(self, alpha: float) -> Threshold:
        """What loss-free streams of the calibration's length exceed with a probability of at most alpha, in (0, 1)."""
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
        """One line of text; maxima are rounded up to four decimals, so that no threshold becomes more eager."""
        maxima = (np.ceil(np.round(self.maxima * 10**_DECIMALS, 6)) / 10**_DECIMALS).tolist()
        raw = {"format": FORMAT, **vars(self), "statistic": vars(self.statistic), "maxima": maxima}
        return json.dumps(raw, separators=(",", ":"), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """Read what :meth:`to_json` wrote.

        Raises:
            WeightsError: the text is damaged, or of another version.
        """
        with reading("monitor: its calibration", WeightsError, "run `quest calibrate` again"):
            raw = build(dict, json.loads(text), "calibration")
            if (version := raw.pop("format")) != FORMAT:
                raise WeightsError(
                    f"monitor: expected a calibration of format {FORMAT}, got {version!r}; run `quest calibrate` again"
                )
            return build(cls, {**raw, "maxima": np.array(raw["maxima"], np.float64)}, "calibration")


def adjusted(log_odds: Float[np.ndarray, "*N"], *, slope: float, shift: float) -> Float64[np.ndarray, "*N"]:
    """Log odds on another scale, within plus and minus :data:`LOGIT_LIMIT`; NaN stays NaN."""
    return np.clip(slope * log_odds.astype(np.float64) + shift, -LOGIT_LIMIT, LOGIT_LIMIT)


def probability(logit: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Probability of log odds."""
    return 1.0 / (1.0 + np.exp(-logit.astype(np.float64)))


def read_calibrations(path: Path | None = None) -> dict[Inputs, Calibration]:
    """Read the calibrations of a file, by what the frames bring.

    Args:
        path: a file of `quest calibrate`; None for the one that comes with the package, and an empty dict if none does.

    Raises:
        WeightsError: there is no such file, or it is damaged.
    """
    file = resources.files("quest") / "assets" / "monitor.json" if path is None else path
    if path is None and not file.is_file():
        return {}
    remedy = "make it with `quest calibrate`"
    with reading(f"monitor {file}", WeightsError, remedy):
        raw = json.loads(file.read_text(encoding="utf-8")) if path is None else read_json(path, WeightsError, remedy)
    if not isinstance(raw, dict) or not raw or not raw.keys() <= set(get_args(Inputs)):
        known = " or ".join(get_args(Inputs))
        raise WeightsError(f"monitor {file}: expected calibrations for {known}; make it with `quest calibrate`")
    try:
        return {inputs: Calibration.from_json(json.dumps(value)) for inputs, value in raw.items()}
    except WeightsError as error:
        raise WeightsError(f"{file}: {error}") from error


def write_calibrations(path: Path, calibrations: Mapping[Inputs, Calibration]) -> None:
    """Write at least one calibration to a file, whole or not at all."""
    raw = {inputs: json.loads(calibration.to_json()) for inputs, calibration in calibrations.items()}
    with whole_file(path) as partial:
        partial.write_text(json.dumps(raw, separators=(",", ":")) + "\n", encoding="utf-8")
