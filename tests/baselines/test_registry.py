"""The registry of trackers, and the tracker that sees no depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import quest
from quest.baselines import TRACKERS, line_up
from quest.baselines.pixels_only import PixelsOnly
from quest.baselines.point_queries import lift_pixels
from quest.baselines.redetect import Redetect
from quest.errors import ConfigError
from quest.evaluation.runner import has_protocol
from quest.track import Tracker, TrackerConfig
from quest.types import Query, Take
from tests.synthetic import make_take
from tests.tiny import make_finder

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=5, views=1, entities=2, size=(64, 48))


def make_tracker() -> Tracker:
    return Tracker(make_finder(), TrackerConfig(bias=100.0, size_px=64, follow_px=64), device=CPU)


@pytest.mark.slow
def test_every_name_is_a_tracker_of_that_name(monkeypatch: pytest.MonkeyPatch, take: Take) -> None:
    monkeypatch.setattr(quest, "load", lambda weights: make_tracker(), raising=False)
    names = (*(name for name, entry in TRACKERS.items() if not (entry.official or entry.retrained)), "quest")
    trackers = line_up(names, weights="any")
    assert [tracker.name for tracker in trackers] == list(dict.fromkeys(names))
    queries = [Query.point(0, 30.0, 20.0)]
    for tracker in trackers:
        assert tracker.track(take.views[0].clip, queries).uv_px.shape == (5, 1, 2)
        if has_protocol(tracker, "semantic"):
            assert tracker.track(take.views[0].clip).uv_px.shape[1] > 0
    with pytest.raises(ConfigError, match="expected one of"):
        line_up(["raft"], weights="any")


def test_trackers_of_weights_know_which(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = make_tracker()
    tracker.weights_hash = "0123"
    monkeypatch.setattr(quest, "load", lambda weights: tracker, raising=False)
    for name in [name for name, entry in TRACKERS.items() if entry.of_weights]:
        (alone,) = line_up([name], weights="runs/mine")
        assert getattr(alone, "weights_hash", None) == "0123"  # answers of other weights do not count


def test_baselines_without_weights_load_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quest, "load", None, raising=False)
    names = [name for name, entry in TRACKERS.items() if entry.plain]
    assert [t.name for t in line_up(names, weights="none")] == names


def test_names_say_what_they_are() -> None:
    assert all(entry.official == name.endswith("-official") for name, entry in TRACKERS.items())
    assert not any(entry.official and (entry.of_weights or entry.plain) for entry in TRACKERS.values())
    every = [TRACKERS[name].build(name, make_tracker()) for name in ("redetect", "redetect-1")]
    assert [t.every for t in every if isinstance(t, Redetect)] == [4, 1]


def test_pixels_only_sees_no_depth_and_lifts_afterwards(take: Take) -> None:
    clip = take.views[0].clip
    assert clip.depth_m is not None
    tracker = PixelsOnly.without_depth("quest-pixels", make_tracker())
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
