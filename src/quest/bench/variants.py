"""The published network and its variants (see docs/metrics.md for what every row is)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from quest.bench.settings import Base
from quest.paper.network import PaperConfig
from quest.paper.objective import LOSSES, Order
from quest.train.settings import WindowConfig

LOSSES_3D = ("vel", "acc", "geo")
"""Losses that know of 3D; the others are of pixels, features, labels and confidences."""


@dataclass(frozen=True)
class Variant:
    """What is trained."""

    name: str
    """Of its folder."""
    network: PaperConfig = field(default_factory=PaperConfig)
    losses: Mapping[str, float] = field(default_factory=dict)
    """Weights of losses that differ from the published ones."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    order: Order = "match"

    def without(self, name: str, *losses: str) -> Variant:
        """The same trained without some losses."""
        return replace(self, name=f"{self.name}-no-{name}", losses={**self.losses, **dict.fromkeys(losses, 0.0)})

    def sized(self, name: str, size: int) -> Variant:
        """The same with another number of frames (``window``) or queries (``slots``)."""
        if getattr(self.network, name) == size:
            return self
        network = replace(self.network, **{name: size})  # type: ignore[arg-type]
        return replace(self, name=f"{self.name}-{name}-{size}", network=network)


_FROM_MAP = PaperConfig(place_from="map")
_EVERY = {"early": 1.0, "conf": 0.0, "exists": 0.3, "where": 0.3}

BASES: dict[Base, Variant] = {
    "published": Variant("published"),
    "remedies": Variant("remedies", _FROM_MAP, _EVERY, order="entity"),
}
"""What the tables vary."""

REMEDIES: Mapping[str, Variant] = {
    "as published": BASES["published"],
    "loss at every layer": Variant("early", losses={"early": 1.0}),
    "confidence: it exists": Variant("exists", losses={"conf": 0.0, "exists": 0.3}),
    "entity i has slot i": Variant("order", order="entity"),
    "place off the map": Variant("map", _FROM_MAP, losses={"where": 0.3}),
    "all four": BASES["remedies"],
}
"""What is said to help the prediction of sets, one by one and together."""


def without_3d(base: Variant) -> Variant:
    """Pixel losses alone, and windows without depth. The tracker lifts by depth as ever."""
    return replace(base.without("3d", *LOSSES_3D), windows=WindowConfig(depth_drop_share=1.0))


def trained_losses(base: Variant) -> list[str]:
    """Losses that have a weight in the training of a variant."""
    return [name for name, loss in LOSSES.items() if base.losses.get(name, loss.weight) > 0]
