"""What a likeness is worth, fitted to choices."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.fit_appearance import NAMES, Choices, FitAppearance, count, fit, log_odds, loss
from quest.filter.noise import Noise
from quest.filter.posterior import RIVALS
from tests.filter.scenes import scene

TRUE = np.array([2.0, 0.7, -4.0, -1.5])


def test_parameters_are_found_again_that_made_the_choices() -> None:
    rng = np.random.default_rng(0)
    terms = rng.uniform(0, 4, (20_000, RIVALS + 1, 2))
    unknown = Choices(terms, np.zeros(len(terms), dtype=np.int64), np.ones(len(terms)))
    gumbel = rng.gumbel(size=(len(terms), RIVALS + 2))
    choices = Choices(terms, (log_odds(TRUE, unknown) + gumbel).argmax(axis=1), unknown.weight)
    found = fit([choices])
    np.testing.assert_allclose(found, TRUE, atol=0.15)
    assert loss(found, choices) <= loss(TRUE, choices)


def test_corners_of_a_still_scene_teach() -> None:
    clip = scene(np.linspace(0, 0.4, 6))
    settings = FitAppearance([], corners=8)
    choices = settings.choices(clip, np.random.default_rng(0))
    assert choices.terms.shape == (count(choices), RIVALS + 1, 2)
    followed = choices.right == 0
    assert 0.1 < followed.mean() < 0.9
    assert choices.terms[followed, 0, 0].mean() > choices.terms[~followed, 0, 0].mean() + 1


def test_the_filter_uses_what_was_fitted() -> None:
    fitted = json.loads(FitAppearance([]).out.read_text())["parameters"]
    assert fitted == {name: getattr(Noise(), name) for name in NAMES}
