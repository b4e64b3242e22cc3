"""What a tracker may be told besides its weights; chosen on validation objects and stored with the weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from quest.errors import ConfigError, WeightsError
from quest.model.discovery import RADIUS_CELLS

REVISION = 9
"""Grows when the same weights and settings give other answers, so that no monitor is fitted to streams of before."""


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of tracking."""

    move_sigma: float = 0.1
    """How far an entity may move between frames, reference units (half the width of the view)."""
    jump: float = 0.0003
    """Probability that it is anywhere else, which lets a wrong belief recover."""
    temperature: float = 2.0
    """Divides the scores of the heatmap; above 1 trusts a single frame less."""
    lift_tolerance: float = 0.08
    """Largest distance between the lifted pixel and the predicted point for the pixel's depth to be taken, reference
    units; beyond it the pixel lies on something before or behind the entity."""
    hold_below: float = 0.3
    """Probability of being seen below which an entity is taken to be hidden."""
    ground: bool = True
    """Whether queries are grounded in the motion of their joint."""
    point_sigma: float = 0.04
    """Standard deviation of a seen point per coordinate, reference units."""
    joint_sigma: float = 0.06
    """How far from its joint's curve a cell of the entity may lie, reference units."""
    off_joint: float = -2.0
    """Log weight of cells that the joint does not reach, which lets a wrong joint recover."""
    along_sigma: float = 0.03
    """How far a hidden entity moves along its joint between frames, reference units (twice that in radians)."""
    hidden_trust: float = 0.5
    """How much the heatmap says of a hidden entity's place along its joint."""
    found_below: float = 0.2
    """Probability of a lost identity below which a search has found its entity."""
    found_frames: int = 3
    """How many frames in a row it must be that low."""
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

    def __post_init__(self) -> None:
        widths = (self.move_sigma, self.point_sigma, self.joint_sigma, self.along_sigma, self.temperature)
        if min(widths) <= 0 or not 0 < self.jump < 1 or self.lift_tolerance < 0:
            raise ConfigError(f"tracker: expected positive sigmas and temperature and 0 < jump < 1, got {self}")

    def to_json(self) -> str:
        """One line, stored with the weights."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> TrackerConfig:
        """Read what :meth:`to_json` wrote.

        Raises:
            WeightsError: the text holds other settings.
        """
        try:
            return cls(**json.loads(text))
        except (json.JSONDecodeError, TypeError, ConfigError) as error:
            raise WeightsError(f"settings stored with the weights cannot be read: {error}") from error
