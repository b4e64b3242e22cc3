"""Discovery's threshold is chosen on validation objects only, and remembering frames changes no answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.baselines.memory import remember_frames
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.tuning import Tuned, discovery_bias
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


def test_other_objects_than_validation_are_refused(store: TakeStore):
    with pytest.raises(ConfigError, match="validation"):
        discovery_bias(make_tracker(), [(store, {NAME: "test"})])
    with pytest.raises(ConfigError, match="none"):
        discovery_bias(make_tracker(), [(store, {})])


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
    tuned = discovery_bias(make_tracker(), [(store, {NAME: "validation"})])
    assert (tuned.precision, tuned.recall) == pytest.approx((2 / 3, 1.0))
    assert tuned.slot_bias == pytest.approx(1.0)
    wrong = replace(peaks, point_m=point_m[[0, 0, 0]] + 9)
    monkeypatch.setattr(Tracker, "candidates", lambda *_: wrong)
    tracker = make_tracker()
    assert discovery_bias(tracker, [(store, {NAME: "validation"})]) == Tuned(tracker.config.slot_bias, 0.0, 0.0)


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

    def discovered(*takes: tuple[TakeStore, str]) -> Tuned:
        answers = iter([seen[store.infos()[name].source] for store, name in takes])
        monkeypatch.setattr(Tracker, "candidates", lambda *_: next(answers))
        return discovery_bias(make_tracker(), [(store, {name: "validation"}) for store, name in takes])

    procedural = (store, NAME), (more, "panels-100002")
    both = discovered(*procedural)
    assert (both.precision, both.recall) == (1.0, 1.0)
    one = discovered(procedural[0], (real, "44817-L1"))
    assert (one.slot_bias, one.precision, one.recall) == (pytest.approx(0.0), pytest.approx(0.75), 1.0)
    assert discovered(*procedural, (real, "44817-L1")) == one, "however many there are of either"


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
