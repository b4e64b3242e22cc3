"""Queries that say what an entity is taken hold of for."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from quest.errors import InputError
from quest.model.decoder import Anchor
from quest.model.discovery import Peaks
from quest.model.network import QuestNetwork
from quest.model.observation import Observation
from quest.types import Clip, Query
from tests.tiny import DEFAULT
from tests.track.clips import make_clip, make_tracker


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def peaks(*_: object, **__: object) -> Peaks:
    return Peaks(
        uv=torch.tensor([[0.25, 0.25], [0.75, 0.75], [0.25, 0.75]]),
        point_m=torch.ones(3, 3),
        label=torch.tensor([2, 2, 0]),
        logit=torch.tensor([9.0, 8.0, 7.0]),
        intent=torch.tensor([0, 1, 1]),
    )


def test_prompts_choose_by_intent(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.track.binding.find_peaks", peaks)
    tracker, bound, bind = make_tracker(), [], QuestNetwork.bind

    def spy(self: QuestNetwork, observed: Observation, uv: torch.Tensor, *rest: torch.Tensor) -> Anchor:
        bound.append((uv[0].tolist(), rest[-1][0].tolist()))
        return bind(self, observed, uv, *rest)

    monkeypatch.setattr(QuestNetwork, "bind", spy)
    tracker.track(clip, [Query.semantic("rim", intent=intent) for intent in ("lift", "open")])
    assert bound == [([[0.75, 0.75], [0.25, 0.25]], [1, 0])]
    assert tracker.track(clip).names == ("rim 0", "rim 1 (lift)", "handle 2 (lift)")


def test_what_is_asked_for_to_be_lifted_by_stands_still(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.track.binding.find_peaks", peaks)
    tracker, frame = make_tracker(), clip.frame(0)
    queries = [Query.semantic("rim", intent=intent) for intent in ("lift", "open")]
    stream = tracker.stream(clip.camera, [*queries, Query.semantic("handle")], alpha=None)
    stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
    # Of a handle that nobody asked for to lift by, the network may only think so.
    for each in (stream, tracker.restore(tracker.save(stream))):
        assert [f.ground.fixed for f in each._following] == [True, False, False]


def test_weights_that_know_no_intents_say_so(clip: Clip):
    tracker = make_tracker(replace(DEFAULT, intents=False))
    with pytest.raises(InputError, match="cannot tell what to lift"):
        tracker.track(clip, [Query.semantic("rim", intent="lift")])
    with pytest.raises(InputError, match="expected one of open, lift"):
        Query.semantic("rim", intent="push")
