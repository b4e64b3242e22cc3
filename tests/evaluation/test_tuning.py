"""Scores of the finder and its threshold are fitted on validation data only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.tuning import tune
from quest.model.found import LABELS_FOUND, Found, Panels
from quest.track import Tracker
from tests.synthetic import make_take
from tests.track.clips import make_tracker

NAME = "panels-100001"
NO_PANELS = Panels(np.zeros((0, 4)), np.zeros(0, int), np.zeros(0), np.zeros((0, 5)))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    store = TakeStore(tmp_path_factory.mktemp("takes"))
    store.write(make_take(frames=10, views=1, entities=2, size=(64, 64), seed=1, name=NAME))
    return store


def made_up(uv_px: np.ndarray, logit: np.ndarray) -> Found:
    """Handles at some pixels."""
    n = len(logit)
    label_p = np.zeros((n, len(LABELS_FOUND)))
    label_p[:, 0] = 1
    return Found(uv_px, logit, label_p, np.zeros(n), np.full((n, 4), np.nan), np.full(n, -1), NO_PANELS)


def test_other_objects_than_validation_are_refused(store: TakeStore):
    with pytest.raises(ConfigError, match="validation"):
        tune(make_tracker(), [], [(store, {NAME: "test"})])
    with pytest.raises(ConfigError, match="nothing was found"):
        tune(make_tracker(), [], [])


def test_the_threshold_lies_below_what_is_right(store: TakeStore, monkeypatch: pytest.MonkeyPatch):
    """Two entities found and four places without any: likelier and less likely ones are right in part."""
    take = store.read(NAME)
    entities = [int(e) for e in take.tracked if take.views[0].visible[0, e]]
    true = take.views[0].uv_px[0, entities].astype(float)
    away = np.array([[1.0, 1], [63, 1], [1, 63], [63, 63]])
    found = made_up(np.concatenate((true[:1], away[:1], true[1:], away[1:])), np.array([4.0, 3, 2, -1, -2, -3]))

    def find(tracker: Tracker, rgb: np.ndarray) -> Found:
        return replace(found, logit=tracker.config.gain * found.logit + tracker.config.bias)

    monkeypatch.setattr(Tracker, "find", find)
    tuned = tune(make_tracker(), [], [(store, {NAME: "validation"})])
    assert tuned.of == ("takes",)
    assert (*tuned.precision, *tuned.recall) == pytest.approx((2 / 3, 1.0))
    p = 1 / (1 + np.exp(-(tuned.config.gain * found.logit + tuned.config.bias)))
    assert p[2] > tuned.config.threshold > p[3]
    assert p.sum() == pytest.approx(2, abs=0.05)  # as many as are right
    monkeypatch.setattr(Tracker, "find", lambda *_: made_up(away, np.arange(4.0)))
    with pytest.raises(ConfigError, match="nothing was found"):
        tune(make_tracker(), [], [(store, {NAME: "validation"})])
