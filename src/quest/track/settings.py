"""What a tracker is told besides its weights; chosen on validation data and stored with the weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from quest.errors import ConfigError, WeightsError
from quest.model.found import Odds
from quest.untrusted import build, parse_json, reading

REVISION = 17
"""Grows when the filter or the network of losses gives other answers: no monitor is calibrated on those of before."""
_SIZES_PX = (16, 4096)
"""Smallest and largest side that pictures are brought to."""


@dataclass(frozen=True)
class TrackerConfig(Odds):
    """Settings of discovery, and how large pictures are at least."""

    threshold: float = 0.5
    """Probability above which discovery follows what was found."""
    prompt_threshold: float = 0.2
    """Probability above which a label or slot is bound; lower, because the user says that it is there."""
    size_px: int = 640
    """Longer side of the picture that the finder sees, pixels."""
    follow_px: int = 480
    """Longer side that smaller pictures are enlarged to before anything is followed in them, pixels: the filter's
    patches and noises are of such pictures."""
    most: int = 32
    """Most entities that discovery follows."""

    def __post_init__(self) -> None:
        for name in ("size_px", "follow_px"):
            if not _SIZES_PX[0] <= getattr(self, name) <= _SIZES_PX[1]:
                raise ConfigError(f"tracker: expected {name} from {_SIZES_PX[0]} to {_SIZES_PX[1]}, got {self}")

    def to_json(self) -> str:
        """One line, stored with the weights."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> TrackerConfig:
        """Read what :meth:`to_json` wrote.

        Raises:
            WeightsError: the text holds no settings.
        """
        with reading("settings stored with the weights", WeightsError, "fetch or train them again"):
            return build(cls, parse_json(text, "settings stored with the weights", WeightsError), "settings")
