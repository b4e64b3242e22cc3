"""Settings of training by preset."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from jaxtyping import TypeCheckError

from quest.cli.train import Train
from quest.errors import ConfigError
from quest.model.config import PRESETS
from quest.train.settings import LOSSES, LossChanges, LossWeights, TrainingConfig, WindowConfig


def test_presets_have_losses_of_their_own() -> None:
    assert set(LOSSES) == set(PRESETS)
    assert LossChanges().apply("default") == LossWeights()
    paper = LossChanges(vel=0.0).apply("paper")
    assert paper == replace(LOSSES["paper"], vel=0.0)
    assert (paper.aff, paper.acc, paper.point, paper.heat, paper.joint) == (1.0, 0.5, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        (TrainingConfig(), "learning_rate", -1e-4),
        (TrainingConfig(), "clip_norm", 0.0),
        (TrainingConfig(), "weight_decay", -0.01),
        (TrainingConfig(), "warmup_steps", -1),
        (TrainingConfig(), "seed", -1),
        (TrainingConfig(), "seed", 2**64),
        (WindowConfig(), "batch", 0),
        (WindowConfig(), "max_stride", -1),
        (WindowConfig(), "point_jitter_px", -1.0),
        (WindowConfig(), "label_share", 1.5),
        (LossWeights(), "vel", -1.0),
        (LossWeights(), "acc", math.nan),
    ],
)
def test_settings_out_of_range_are_refused_before_anything_is_prepared(
    settings: TrainingConfig | WindowConfig | LossWeights, name: str, value: float
) -> None:
    with pytest.raises(ConfigError, match=f"{name} .*got {value}"):
        replace(settings, **{name: value})


def test_an_unknown_accelerator_is_refused() -> None:
    with pytest.raises((ConfigError, TypeCheckError), match="abacus"):
        TrainingConfig(accelerator="abacus")  # type: ignore[arg-type]


def test_options_that_would_do_nothing_are_refused() -> None:
    command = Train(data=("takes",), out=Path("run"), weights="quest-s16")
    with pytest.raises(ConfigError, match=r"leave --losses\.\* away"):
        replace(command, stage=2, losses=LossChanges(vel=0.0))._start()
    with pytest.raises(ConfigError, match="leave --encoder away"):
        replace(command, encoder=Path("encoder.safetensors"))._start()
