"""What discovery is told besides its weights; chosen on validation objects and stored with the weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from quest.errors import WeightsError
from quest.model.discovery import RADIUS_CELLS

REVISION = 10
"""Grows when the filter gives other answers, so that no monitor is calibrated on streams of before."""


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of discovery."""

    slot_bias: float = 0.0
    """Added to the affordance logit, so that slots worth keeping have a confidence above one half."""
    slot_gain: float = 1.0
    """Multiplies the affordance logit."""
    slot_threshold: float = 0.5
    """Probability above which discovery takes a slot."""
    prompt_threshold: float = 0.2
    """Probability above which a prompt takes a slot; lower, because the user says it is there."""
    slot_radius_cells: float = RADIUS_CELLS
    """Peaks of one label closer than this are one slot."""

    def to_json(self) -> str:
        """One line, stored with the weights."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> TrackerConfig:
        """Read what :meth:`to_json` wrote; settings of a tracker before that this one does not have are left out.

        Raises:
            WeightsError: the text holds no settings.
        """
        try:
            stored = json.loads(text).items()
            return cls(**{name: float(value) for name, value in stored if name in cls.__dataclass_fields__})
        except (json.JSONDecodeError, TypeError, ValueError, AttributeError) as error:
            raise WeightsError(f"settings stored with the weights cannot be read: {error}") from error
