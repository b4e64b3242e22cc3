"""What determines the shapes of a network, as it is stored beside its weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import ClassVar, TypeVar

from quest.errors import ConfigError
from quest.model.encoder import EncoderConfig
from quest.untrusted import build, parse_json, reading

_Config = TypeVar("_Config", bound="StoredConfig")


@dataclass(frozen=True, kw_only=True)
class StoredConfig:
    """Shapes of a network."""

    _always: ClassVar[tuple[str, ...]] = ()
    """What a stored one must name; for all else there are defaults."""

    def to_json(self) -> str:
        """One line, stored beside the weights."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls: type[_Config], text: str) -> _Config:
        """Read what :meth:`to_json` wrote.

        Raises:
            ConfigError: the text is not a network configuration of this version.
        """
        what, remedy = "network configuration", "fetch or train the network again"
        values = parse_json(text, what, ConfigError, remedy)
        with reading(what, ConfigError, remedy):
            return build(cls, {**values, **{name: values[name] for name in cls._always}}, "configuration")


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(StoredConfig):
    """A network with a vision transformer."""

    _always: ClassVar[tuple[str, ...]] = ("encoder",)

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """The vision transformer; the side of its image says for which grid its places are stored."""
