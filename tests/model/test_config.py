"""Presets and configurations on disk."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from quest.errors import ConfigError
from quest.model.config import DEFAULT as PRESET
from quest.model.config import NetworkConfig
from quest.model.encoder import EncoderConfig
from tests.tiny import DEFAULT


@pytest.mark.parametrize("config", [PRESET, DEFAULT], ids=lambda c: f"{c.width}")
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


@pytest.mark.parametrize(
    "changes",
    [
        {"heads": 5},
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


def test_files_that_say_how_queries_and_head_work():
    """Earlier ones do; those of learned queries hold another network."""
    said = {"queries": "anchored", "head": "heatmap"}
    assert NetworkConfig.from_json(json.dumps(json.loads(DEFAULT.to_json()) | said)) == DEFAULT
    with pytest.raises(ConfigError, match="learned"):
        NetworkConfig.from_json(json.dumps(json.loads(DEFAULT.to_json()) | {"queries": "learned"}))
