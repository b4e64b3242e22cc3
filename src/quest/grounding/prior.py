"""What is believed of a joint before its motion has been seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from quest.errors import InputError

_UNIT = 1e-3
"""How far the length of an axis may be from 1."""


@dataclass(frozen=True)
class JointPrior:
    """Independent beliefs on a joint's kind, its axis as either kind, and where the axis of turning is.

    Raises:
        InputError: a probability outside (0, 1), a spread that is not positive, a number that is not finite, or an axis
            that has not length 1.
    """

    revolute_probability: float
    """That it turns rather than slides."""
    prismatic_axis: Float[np.ndarray, "3"]
    """Unit direction of sliding, of either sign."""
    prismatic_axis_sigma_rad: float
    """Standard deviation of that direction about each of two perpendicular axes."""
    revolute_axis: Float[np.ndarray, "3"]
    """Unit direction of the axis of turning, of either sign."""
    revolute_axis_sigma_rad: float
    """The same of this direction."""
    origin: Float[np.ndarray, "3"]
    """Point of the axis of turning."""
    origin_sigma: float
    """Its standard deviation per coordinate."""

    def __post_init__(self) -> None:
        spreads = (self.prismatic_axis_sigma_rad, self.revolute_axis_sigma_rad, self.origin_sigma)
        places = np.concatenate((self.prismatic_axis, self.revolute_axis, self.origin))
        if not np.isfinite(places).all() or not all(np.isfinite(s) and s > 0 for s in spreads):
            raise InputError(f"joint prior: expected finite axes and positive spreads, got {self}")
        if max(abs(np.linalg.norm(axis) - 1) for axis in (self.prismatic_axis, self.revolute_axis)) > _UNIT:
            raise InputError(f"joint prior: expected axes of length 1, got {self}")
        if not 0 < self.revolute_probability < 1:
            raise InputError(f"joint prior: expected a probability within (0, 1), got {self.revolute_probability}")
