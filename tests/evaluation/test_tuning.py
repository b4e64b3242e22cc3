"""Settings are chosen on validation objects only, and remembering frames changes no answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.baselines.memory import remember_frames
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation import tuning
from quest.evaluation.selection import SplitPart
from quest.evaluation.tuning import Trial, discovery_bias, tune
from quest.model.discovery import Peaks
from quest.track import Tracker
from quest.types import LABELS, Query
from tests.synthetic import make_take
from tests.track.clips import make_tracker

NAME = "panels-100001"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    store = TakeStore(tmp_path_factory.mktemp("takes"))
    store.write(make_take(frames=10, views=1, entities=2, size=(64, 64), seed=1, name=NAME))
    return store


def test_the_best_value_of_every_setting_is_kept(store: TakeStore, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tuning, "GRID", {"jump": (0.001, 0.5), "hold_below": (0.0, 1.0)})
    told: list[Trial] = []
    tuned = tune(make_tracker(), [(store, {NAME: "validation"})], report=told.append)
    assert list(tuned.trials) == told
    assert [(t.name, t.value) for t in told] == [
        ("jump", 0.001),
        ("jump", 0.5),
        ("hold_below", 0.0),
        ("hold_below", 1.0),
    ]
    assert tuned.config.jump == min(told[:2], key=lambda t: t.ape).value
    assert tuned.config.hold_below == min(told[2:], key=lambda t: t.ape).value
    assert np.isfinite([t.ape for t in told]).all()


@pytest.mark.slow
def test_takes_of_a_suite_count_as_much_as_ordinary_ones(store: TakeStore, tmp_path: Path, monkeypatch):
    """However many there are: the mean is over sources and suites, and over every frame within them."""
    monkeypatch.setattr(tuning, "GRID", {"jump": (0.001,)})
    hard = TakeStore(tmp_path)
    names = [f"panels-10000{i}-L1-occlusion60-s000000" for i in range(2, 4)]
    for seed, name in enumerate(names, start=2):
        hard.write(make_take(frames=10, views=1, entities=2, size=(64, 64), seed=seed, name=name))
    chosen: list[tuple[TakeStore, dict[str, SplitPart]]] = [
        (store, {NAME: "validation"}), (hard, dict.fromkeys(names, "validation"))
    ]  # fmt: skip
    ape = [tune(make_tracker(), takes, report=lambda t: None).trials[0].ape for takes in ([c] for c in chosen)]
    (both,) = tune(make_tracker(), chosen, report=lambda t: None).trials
    assert both.ape == pytest.approx(np.mean(ape))


def test_other_objects_than_validation_are_refused(store: TakeStore):
    with pytest.raises(ConfigError, match="validation"):
        tune(make_tracker(), [(store, {NAME: "test"})], report=lambda trial: None)
    with pytest.raises(ConfigError, match="none"):
        tune(make_tracker(), [(store, {})], report=lambda trial: None)


def test_discovery_threshold_is_the_best_one(store: TakeStore, monkeypatch: pytest.MonkeyPatch):
    """Three candidates, of which the first and the last are entities: keeping all gives the best F2."""
    take = store.read(NAME)
    entities = [int(e) for e in take.tracked if take.views[0].visible[0, e]]
    first, second = (LABELS.index(take.info.entities[e].label) for e in entities)
    pose = take.views[0].clip.cam_from_world[0]
    point_m = torch.from_numpy(take.point_world[0, entities] @ pose[:3, :3].T + pose[:3, 3]).float()
    peaks = Peaks(
        uv=torch.zeros(3, 2),
        point_m=torch.stack([point_m[0], point_m[0] + 9, point_m[1]]),
        label=torch.tensor([first, first, second]),
        logit=torch.tensor([2.0, 1.0, -1.0]),
        intent=torch.zeros(3, dtype=torch.long),
    )
    monkeypatch.setattr(Tracker, "candidates", lambda *_: peaks)
    bias, precision, recall = discovery_bias(make_tracker(), [(store, {NAME: "validation"})])
    assert (precision, recall) == pytest.approx((2 / 3, 1.0))
    assert bias == pytest.approx(1.0)
    wrong = replace(peaks, point_m=point_m[[0, 0, 0]] + 9)
    monkeypatch.setattr(Tracker, "candidates", lambda *_: wrong)
    tracker = make_tracker()
    assert discovery_bias(tracker, [(store, {NAME: "validation"})]) == (tracker.config.slot_bias, 0.0, 0.0)


def test_every_source_counts_the_same_for_the_threshold_of_discovery(
    store: TakeStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Of two procedural views each finds both entities at 2.0 and nothing else; of the one real view the entities are
    at 1.0 and 0.0, behind two wrong ones."""
    take = store.read(NAME)
    real = TakeStore(tmp_path / "real")
    real.write(replace(take, info=replace(take.info, name="44817-L1", source="partnet-mobility")))
    more = TakeStore(tmp_path / "more")
    more.write(replace(take, info=replace(take.info, name="panels-100002")))
    entities = [int(e) for e in take.tracked if take.views[0].visible[0, e]]
    pose = take.views[0].clip.cam_from_world[0]
    point_m = torch.from_numpy(take.point_world[0, entities] @ pose[:3, :3].T + pose[:3, 3]).float()
    label = torch.tensor([LABELS.index(take.info.entities[e].label) for e in entities])

    def peaks(logits: list[float], wrong: int) -> Peaks:
        places = torch.cat((point_m[:1].expand(wrong, 3) + 9, point_m))
        return Peaks(
            torch.zeros(len(logits), 2), places, torch.cat((label[:1].expand(wrong), label)), torch.tensor(logits),
            torch.zeros(len(logits), dtype=torch.long),
        )  # fmt: skip

    seen = {"procedural": peaks([2.0, 2.0], 0), "partnet-mobility": peaks([1.5, 1.5, 1.0, 0.0], 2)}

    def discovered(*takes: tuple[TakeStore, str]) -> tuple[float, float, float]:
        answers = iter([seen[store.infos()[name].source] for store, name in takes])
        monkeypatch.setattr(Tracker, "candidates", lambda *_: next(answers))
        return discovery_bias(make_tracker(), [(store, {name: "validation"}) for store, name in takes])

    procedural = (store, NAME), (more, "panels-100002")
    assert discovered(*procedural)[1:] == (1.0, 1.0)
    one = discovered(procedural[0], (real, "44817-L1"))
    assert one == (pytest.approx(0.0), pytest.approx(0.75), 1.0)
    assert discovered(*procedural, (real, "44817-L1")) == one, "however many there are of either"


def test_after_the_map_alone_only_discovery_is_tuned(store: TakeStore):
    tracker, told = make_tracker(), list[Trial]()
    tuned = tune(tracker, [(store, {NAME: "validation"})], report=told.append, discovery_only=True)
    assert not told
    assert tuned.config == replace(tracker.config, slot_bias=tuned.config.slot_bias)
    assert 0 <= tuned.precision <= 1
    assert 0 <= tuned.recall <= 1


@pytest.mark.parametrize("capacity", [3, 100])
def test_remembering_changes_nothing(store: TakeStore, tmp_path: Path, capacity: int):
    clip = store.read_clip(NAME, 0)
    queries = [Query.point(0, 20.0, 30.0)]
    plain = make_tracker().track(clip, queries)
    tracker = make_tracker()
    remember_frames(tracker.network, capacity=capacity)
    for _ in range(2):
        again = tracker.track(clip, queries)
        np.testing.assert_allclose(again.uv_px, plain.uv_px, atol=1e-4)
        np.testing.assert_allclose(again.point_world, plain.point_world, atol=1e-5)
