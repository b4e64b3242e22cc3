"""Settings of how the finder learns, free of heavy imports so that the command line is quick."""

from __future__ import annotations

from dataclasses import dataclass

from quest.errors import ConfigError

VIEW_PX = 640
"""Side of a view."""


@dataclass(frozen=True)
class FinderSamplerConfig:
    """How cuts are drawn."""

    batch: int = 12
    """Cuts per step, of all processes and micro-batches together."""
    learned_blocks: int = 0
    """Last blocks of the vision transformer that learn too, and with them all of EfficientNet. That takes a GPU. With
    0 what the transformer sees in a picture is kept, and a step takes a tenth of the time."""
    second_alone: bool = False
    """Only the second looks learn, and all else of the finder stays as it is."""
    cut_px: int = 320
    """Side of a cut, a multiple of 32."""
    take_share: float = 0.3
    """Share of simulated frames in a batch, where there are both."""
    aimed_share: float = 0.8
    """How often a cut is one with something labelled in it, where there is any."""

    def __post_init__(self) -> None:
        shares = (self.take_share, self.aimed_share)
        if self.batch < 1 or not all(0 <= share <= 1 for share in shares):
            raise ConfigError(f"finding: expected a batch of at least 1 and shares from 0 to 1, got {self}")
        if self.learned_blocks < 0:
            raise ConfigError(f"finding: expected learned_blocks of at least 0, got {self.learned_blocks}")
        if self.second_alone and self.learned_blocks:
            raise ConfigError("finding: if the second looks learn alone, no block of the transformer does; choose one")
        if self.cut_px % 32 or not 32 <= self.cut_px <= VIEW_PX:
            raise ConfigError(f"finding: expected cuts of a multiple of 32 up to {VIEW_PX} px, got {self.cut_px}")
