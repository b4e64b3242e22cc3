"""Presets of the network.

A preset is a named :class:`NetworkConfig`; an ablation is another value of a field, never another class.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Literal

from quest.errors import ConfigError
from quest.model.encoder import EncoderConfig


@dataclass(frozen=True)
class NetworkConfig:
    """Everything that determines the shapes of the network.

    Attributes:
        preset: name of the preset that this started from.
        encoder: the image encoder.
        queries: ``anchored`` queries carry the feature, pixel and 3D point at which they were bound;
            ``learned`` queries are free embeddings, as published.
        head: ``heatmap`` over cells with an offset, or direct ``regression`` of coordinates, as published.
        width: channels inside the decoder.
        heads: attention heads of the decoder.
        decoder_layers: layers of the decoder.
        token_layers: transformer layers over the tokens of one frame before the decoder looks at them.
        window: T, frames that the decoder sees together.
        slots: K, most entities that discovery returns (and number of learned queries).
        points3d: whether tokens and queries carry the position code of their 3D point, and details of depth.
        cell_px: side of a cell of the heatmap, pixels of the network's input.
        intents: whether queries and the affordance map tell entities to open from entities to lift.
        map_layers: transformer layers of the affordance map's own trunk, over tokens of the image at twice its size;
            0 reads the map off what the decoder looks at.
        pieces: whether discovery ranks what stands out of planes, which `quest weights pieces` teaches.
        flow: whether there is a flow head, which stage 2 trains.
    """

    preset: str = "default"
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    queries: Literal["anchored", "learned"] = "anchored"
    head: Literal["heatmap", "regression"] = "heatmap"
    width: int = 256
    heads: int = 8
    decoder_layers: int = 3
    token_layers: int = 1
    window: int = 4
    slots: int = 32
    points3d: bool = True
    cell_px: int = 8
    intents: bool = False
    map_layers: int = 0
    pieces: bool = False
    flow: bool = False

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ConfigError(f"network: width {self.width} must be a multiple of heads {self.heads}")
        if (self.queries, self.head) not in {("anchored", "heatmap"), ("learned", "regression")}:
            raise ConfigError(f"network: queries {self.queries!r} do not go with head {self.head!r}")
        if self.encoder.patch_size != 2 * self.cell_px:
            raise ConfigError(
                f"network: expected cells of half a patch ({self.encoder.patch_size // 2} px), got {self.cell_px}"
            )
        if self.encoder.image_size % self.encoder.patch_size or self.encoder.width % self.encoder.heads:
            raise ConfigError(
                f"network: expected whole patches and a width that is a multiple of heads, got {self.encoder}"
            )
        if min(self.window, self.slots, self.decoder_layers) < 1:
            raise ConfigError("network: window, slots and decoder_layers must be at least 1")

    @property
    def cells(self) -> int:
        """Cells along one side of the image."""
        return self.encoder.image_size // self.cell_px

    def to_json(self) -> str:
        """The configuration as one line, stored beside the weights."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> NetworkConfig:
        """Read what :meth:`to_json` wrote.

        Raises:
            ConfigError: the text is not a network configuration of this version.
        """
        try:
            values = json.loads(text)
            return cls(**{**values, "encoder": EncoderConfig(**values["encoder"])})
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ConfigError(f"network configuration cannot be read: {error}") from error


PRESETS: dict[str, NetworkConfig] = {
    "default": NetworkConfig(intents=True, map_layers=1),
    "paper": NetworkConfig(
        preset="paper",
        queries="learned",
        head="regression",
        width=384,
        heads=4,
        decoder_layers=2,
        token_layers=0,
        slots=8,
        points3d=False,
    ),
}
"""Named starting points: ``paper`` is the network as published, ``default`` what measured best so far."""
