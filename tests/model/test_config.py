"""Presets and configurations on disk."""

from __future__ import annotations

from dataclasses import replace

import pytest

from quest.errors import ConfigError
from quest.model.config import PRESETS, NetworkConfig
from quest.model.encoder import EncoderConfig
from tests.tiny import DEFAULT, PAPER


@pytest.mark.parametrize("config", [*PRESETS.values(), DEFAULT, PAPER], ids=lambda c: f"{c.preset}-{c.width}")
def test_json_round_trip(config: NetworkConfig):
    assert NetworkConfig.from_json(config.to_json()) == config


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        "3",
        '"x"',
        "{}",
        '{"encoder": {}, "colour": 1}',
        '{"encoder": {"colour": 1}}',
        '{"encoder": 3}',
    ],
)
def test_foreign_json_is_refused(text: str):
    with pytest.raises(ConfigError):
        NetworkConfig.from_json(text)


def test_the_published_shape():
    paper = PRESETS["paper"]
    assert (paper.encoder.image_size, paper.encoder.patch_size, paper.encoder.grid**2) == (224, 16, 196)
    assert (paper.width, paper.slots, paper.decoder_layers, paper.heads, paper.window) == (384, 8, 2, 4, 4)


@pytest.mark.parametrize(
    "changes",
    [
        {"heads": 5},
        {"queries": "learned"},
        {"head": "regression"},
        {"cell_px": 4},
        {"window": 0},
        {"slots": 0},
        {"decoder_layers": 0},
        {"encoder": EncoderConfig(image_size=230)},
        {"encoder": EncoderConfig(heads=5)},
    ],
)
def test_contradictions_are_refused(changes: dict):
    with pytest.raises(ConfigError):
        replace(NetworkConfig(), **changes)
