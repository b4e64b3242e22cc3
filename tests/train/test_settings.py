"""Settings of training by preset."""

from __future__ import annotations

from dataclasses import replace

from quest.model.config import PRESETS
from quest.train.settings import LOSSES, LossChanges, LossWeights


def test_presets_have_losses_of_their_own() -> None:
    assert set(LOSSES) == set(PRESETS)
    assert LossChanges().apply("default") == LossWeights()
    paper = LossChanges(vel=0.0).apply("paper")
    assert paper == replace(LOSSES["paper"], vel=0.0)
    assert (paper.aff, paper.acc, paper.point, paper.heat, paper.joint) == (1.0, 0.5, 0.0, 0.0, 0.0)
