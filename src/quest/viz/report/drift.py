"""How far tracks are from the truth, as a report shows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Drift:
    """Tracks beside the true entities that they were assigned to; the room ``evaluation`` makes the numbers."""

    entity: tuple[str | None, ...]
    """Name of the entity per query; None where none was near it at first."""
    distance: Float[np.ndarray, "T K"]
    """Normalised units; NaN where the query has no entity, and before it is bound."""
    accuracy: Float[np.ndarray, " K"]
    """Share of frames in which the answer is nearest to its own entity and within :attr:`gate`; NaN likewise."""
    gate: float
    """Normalised units; an answer that is farther from every entity has no identity."""
    unit_m: float
    """Metres of a normalised unit."""
    missing: float
    """Distance of an answer without a world point, normalised units."""
