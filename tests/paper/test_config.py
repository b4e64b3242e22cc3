"""Configurations on disk, and those that contradict themselves."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from quest.errors import ConfigError
from quest.model.encoder import EncoderConfig
from quest.paper.network import PaperConfig
from tests.paper.tiny import PAPER


@pytest.mark.parametrize("config", [PaperConfig(), PAPER], ids=lambda c: f"{c.width}")
def test_json_round_trip(config: PaperConfig):
    assert PaperConfig.from_json(config.to_json()) == config


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
        PaperConfig.from_json(text)


@pytest.mark.parametrize(
    "changes",
    [
        {"heads": 5},
        {"cell_px": 0},
        {"cell_px": 10},
        {"window": 0},
        {"slots": 0},
        {"decoder_layers": 0},
        {"encoder": EncoderConfig(image_size=230)},
        {"encoder": EncoderConfig(heads=5)},
    ],
)
def test_contradictions_are_refused(changes: dict):
    with pytest.raises(ConfigError):
        replace(PaperConfig(), **changes)


def test_configurations_from_before_there_was_a_flow_head():
    values = json.loads(PAPER.to_json())
    assert values.pop("flow") is False
    assert PaperConfig.from_json(json.dumps(values)) == PAPER
