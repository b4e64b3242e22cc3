"""The registry of trackers, and the tracker that sees no depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import quest
from quest.baselines import TRACKERS, Shared, line_up
from quest.baselines.flow_chain import FlowChain, units_of
from quest.baselines.of_weights import detector_of
from quest.baselines.pixels_only import PixelsOnly
from quest.baselines.point_queries import lift_pixels
from quest.baselines.redetect import Redetect
from quest.errors import ConfigError, WeightsError
from quest.evaluation.runner import has_protocol
from quest.track import Tracker, TrackerConfig
from quest.types import Clip, Query, Take
from tests.synthetic import make_take
from tests.tiny import make_network
from tests.train.prepared import make_store

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=10, views=1, entities=2, size=(64, 48))


def make_tracker(**changes) -> Tracker:
    return Tracker(make_network(**changes), TrackerConfig(slot_bias=100.0), device=CPU)


def unit_m(clip: Clip) -> float:
    return 1.0


@pytest.mark.slow
def test_every_name_is_a_tracker_of_that_name(monkeypatch: pytest.MonkeyPatch, take: Take) -> None:
    monkeypatch.setattr(quest, "load", lambda weights: make_tracker(flow=True), raising=False)
    names = (*TRACKERS, "quest")
    trackers = line_up(names, weights="any", unit_m=unit_m)
    assert [tracker.name for tracker in trackers] == list(dict.fromkeys(names))
    queries = [Query.point(0, 30.0, 20.0)]
    for tracker in trackers:
        assert tracker.track(take.views[0].clip, queries).uv_px.shape == (10, 1, 2)
        if has_protocol(tracker, "semantic"):
            assert tracker.track(take.views[0].clip).uv_px.shape[1] > 0
    with pytest.raises(ConfigError, match="expected one of"):
        line_up(["raft"], weights="any", unit_m=unit_m)


def test_trackers_of_weights_know_which(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = make_tracker(flow=True)
    tracker.weights_hash = "0123"
    monkeypatch.setattr(quest, "load", lambda weights: tracker, raising=False)
    for name in [name for name, entry in TRACKERS.items() if entry.of_weights]:
        (alone,) = line_up([name], weights="runs/mine", unit_m=unit_m)
        assert getattr(alone, "weights_hash", None) == "0123"  # answers of other weights do not count


def test_baselines_without_weights_load_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quest, "load", None, raising=False)
    names = [name for name, entry in TRACKERS.items() if not entry.of_weights]
    assert [t.name for t in line_up(names, weights="none", unit_m=unit_m)] == names


def test_variants_take_threshold_and_noise_from_their_name() -> None:
    tracker = make_tracker(flow=True)
    config = tracker.config = replace(tracker.config, slot_bias=0.5, slot_gain=2.0, slot_threshold=0.8)
    detector = detector_of(tracker)
    score = 1 / (1 + np.exp(-config.slot_gain * (detector.min_logit + config.slot_bias)))
    np.testing.assert_allclose(score, 0.8)
    shared = Shared(tracker, unit_m, seed=3)
    for name, noise in {"flow-chain": 0.0, "flow-chain-0.01": 0.01, "flow-chain-0.05": 0.05}.items():
        chain = TRACKERS[name].build(name, shared)
        assert isinstance(chain, FlowChain)
        assert (chain.noise, chain.seed) == (noise, 3)
    every = [TRACKERS[name].build(name, shared) for name in ("redetect", "redetect-1")]
    assert [t.every for t in every if isinstance(t, Redetect)] == [4, 1]
    with pytest.raises(WeightsError, match="flow head"):
        TRACKERS["flow-chain"].build("flow-chain", Shared(make_tracker(), unit_m))


def test_units_of_stores(tmp_path: Path, take: Take) -> None:
    store = make_store(tmp_path, (0,))
    unit = units_of([store])
    name = store.names()[0]
    clip = store.read(name).views[0].clip
    assert unit(clip) == store.infos()[name].half_diagonal_m
    with pytest.raises(ConfigError, match="stores at hand"):
        unit(replace(clip, name="another"))


def test_pixels_only_sees_no_depth_and_lifts_afterwards(take: Take) -> None:
    clip = take.views[0].clip
    assert clip.depth_m is not None
    tracker = PixelsOnly.without_depth(make_tracker())
    queries = [Query.point(0, 30.0, 20.0), Query.point(3, 10.0, 30.0)]
    tracks = tracker.track(clip, queries)
    far = replace(clip, depth_m=clip.depth_m + np.float32(1.0))
    np.testing.assert_array_equal(tracker.track(far, queries).uv_px, tracks.uv_px)
    lifted = lift_pixels(clip, tracks.uv_px)
    known = np.isfinite(lifted).all(axis=-1)
    assert known.any()
    np.testing.assert_array_equal(tracks.point_world[known], lifted[known])
    assert np.isnan(tracks.point_world[:3, 1]).all()
    assert tracks.joints is None or set(tracks.joints.kind) <= {"unknown", "static"}
    peaks, blind = (tracker.candidates(c.camera, c.frame(0)) for c in (clip, replace(clip, depth_m=None)))
    torch.testing.assert_close(peaks.logit, blind.logit)
    assert torch.isfinite(peaks.point_m).all(dim=1).any()
    assert torch.isnan(blind.point_m).all()
