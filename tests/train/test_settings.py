"""Settings of training by preset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from quest.cli.train import Train
from quest.errors import ConfigError
from quest.train.settings import TrainingConfig, WindowConfig


@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        (TrainingConfig(), "learning_rate", -1e-4),
        (TrainingConfig(), "clip_norm", 0.0),
        (TrainingConfig(), "weight_decay", -0.01),
        (TrainingConfig(), "warmup_steps", -1),
        (TrainingConfig(), "seed", -1),
        (TrainingConfig(), "seed", 2**64),
        (TrainingConfig(), "steps", 0),
        (TrainingConfig(), "patience", 0),
        (TrainingConfig(), "validate_every", 0),
        (TrainingConfig(), "accumulate", 0),
        (TrainingConfig(), "devices", 0),
        (TrainingConfig(), "average_decay", 1.0),
        (TrainingConfig(), "precision", "16"),
        (TrainingConfig(), "accelerator", "abacus"),
        (WindowConfig(), "batch", 0),
        (WindowConfig(), "max_stride", -1),
        (WindowConfig(), "depth_drop_share", 1.5),
    ],
)
def test_settings_out_of_range_are_refused_before_anything_is_prepared(
    settings: TrainingConfig | WindowConfig, name: str, value: float | str
) -> None:
    with pytest.raises(ConfigError, match=f"(?s)(?=.*{name}).*got .*{value}"):
        replace(settings, **{name: value})


def test_options_that_would_do_nothing_are_refused() -> None:
    command = Train(out=Path("run"), data=("takes",), stage=1, weights="runs/paper")
    with pytest.raises(ConfigError, match=r"omit --losses"):
        replace(command, stage=2, losses={"vel": 0.0})._start_paper()
    with pytest.raises(ConfigError, match="omit --encoder"):
        replace(command, encoder=Path("encoder.safetensors"))._start_paper()
    with pytest.raises(ConfigError, match="omit --encoder"):
        replace(command, stage="find", detail=Path("detail.safetensors"))._start_finder()
