"""What determines the shapes of a network; an ablation is another value of a field, never another class."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TypeVar

from quest.errors import ConfigError
from quest.model.encoder import EncoderConfig

_Config = TypeVar("_Config", bound="DecoderConfig")
_Network = TypeVar("_Network", bound="NetworkConfig")


@dataclass(frozen=True, kw_only=True)
class DecoderConfig:
    """Queries that look at windows of frames."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """The image encoder."""
    window: int = 4
    """T, frames that the decoder sees together."""
    cell_px: int = 8
    """Side of a cell, whose depth is known and which a heatmap scores, pixels of the network's input."""
    width: int = 256
    """Channels inside the decoder."""
    heads: int = 8
    """Attention heads of the decoder."""
    decoder_layers: int = 3
    """Layers of the decoder."""
    slots: int = 32
    """K, most entities that are discovered."""
    flow: bool = False
    """Whether there is a flow head, which stage 2 trains."""

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ConfigError(f"network: width {self.width} must be a multiple of heads {self.heads}")
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
    def from_json(cls: type[_Config], text: str) -> _Config:
        """Read what :meth:`to_json` wrote.

        Raises:
            ConfigError: the text is not a network configuration of this version.
        """
        try:
            values = json.loads(text)
            return cls(**{**values, "encoder": EncoderConfig(**values["encoder"])})
        except (json.JSONDecodeError, KeyError, TypeError) as error:
            raise ConfigError(f"network configuration cannot be read: {error}") from error


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(DecoderConfig):
    """Everything that determines the shapes of the network."""

    preset: str = "default"
    """Name of the preset that this started from."""
    token_layers: int = 1
    """Transformer layers over the tokens of one frame before the decoder looks at them."""
    points3d: bool = True
    """Whether tokens and queries carry the position code of their 3D point, and details of depth."""
    intents: bool = False
    """Whether queries and the affordance map tell entities to open from entities to lift."""
    map_layers: int = 0
    """Transformer layers of the affordance map's own trunk, over tokens of the image at twice its size; 0 reads the map
    off what the decoder looks at."""
    pieces: bool = False
    """Whether discovery ranks what stands out of planes, which `quest weights pieces` teaches."""

    @classmethod
    def from_json(cls: type[_Network], text: str) -> _Network:
        """Read what :meth:`to_json` wrote; files of earlier versions also say how their queries and head work.

        Raises:
            ConfigError: the text is not a network configuration of this version.
        """
        try:
            values = json.loads(text)
            kind = (values.pop("queries", "anchored"), values.pop("head", "heatmap"))
        except (json.JSONDecodeError, AttributeError, TypeError) as error:
            raise ConfigError(f"network configuration cannot be read: {error}") from error
        if kind != ("anchored", "heatmap"):
            raise ConfigError(f"network: expected anchored queries and a heatmap, got {' and '.join(map(str, kind))}")
        return super().from_json(json.dumps(values))


DEFAULT = NetworkConfig(intents=True, map_layers=1)
"""The preset ``default``: what measured best so far."""
