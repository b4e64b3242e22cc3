"""Queries that say what an entity is taken hold of for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from quest.errors import InputError
from quest.model.discovery import Candidates, Peaks
from quest.types import Clip, Query
from tests.tiny import DEFAULT
from tests.track.clips import make_clip, make_tracker


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def peaks(*_: object, **__: object) -> Candidates:
    found = Peaks(
        uv=torch.tensor([[0.25, 0.25], [0.75, 0.75], [0.25, 0.75]]),
        point_m=torch.ones(3, 3),
        label=torch.tensor([2, 2, 0]),
        logit=torch.tensor([9.0, 8.0, 7.0]),
        intent=torch.tensor([0, 1, 1]),
    )
    return Candidates(found, torch.eye(3, dtype=torch.bool))


def test_prompts_choose_by_intent(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.track.finder.find_candidates", peaks)
    tracker = make_tracker()
    tracks = tracker.track(clip, [Query.semantic("rim", intent=intent) for intent in ("lift", "open")])
    np.testing.assert_allclose(tracks.uv_px[0], [[48, 48], [16, 16]])
    assert tracker.track(clip).names == ("rim 0", "rim 1 (lift)", "handle 2 (lift)")


def all_at_one_place(*_: object, **__: object) -> Candidates:
    """A handle, a rim to open and the same rim to lift, which are no two rims but may be a rim and a handle."""
    found = Peaks(
        uv=torch.full((4, 2), 0.5),
        point_m=torch.ones(4, 3),
        label=torch.tensor([0, 2, 2, 2]),
        logit=torch.tensor([9.0, 8.0, 7.0, 6.0]),
        intent=torch.tensor([0, 0, 1, 1]),
    )
    clash = torch.ones(4, 4, dtype=torch.bool)
    clash[1, 2:] = clash[2:, 1] = False
    return Candidates(found, clash)


def names_after(clip: Clip, *asked: list[Query]) -> list[str]:
    """Who is followed after so many frames, with these prompts before each of them."""
    stream = make_tracker().stream(clip.camera, [], alpha=None)
    for t, queries in enumerate(asked):
        for query in queries:
            stream.add(query)
        frame = clip.frame(t)
        state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
    return list(state.names)


HANDLE, OPEN, LIFT = (
    Query.semantic("handle"),
    Query.semantic("rim", intent="open"),
    Query.semantic("rim", intent="lift"),
)


def test_a_prompt_is_not_kept_from_its_entity_by_another_label(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.track.finder.find_candidates", all_at_one_place)
    assert names_after(clip, [HANDLE, OPEN, LIFT]) == ["handle 0", "rim 1", "rim 2"]
    assert names_after(clip, [HANDLE, HANDLE, LIFT, LIFT]) == ["handle 0", "rim 2"]
    assert make_tracker().track(clip).names == ("handle 0", "rim 1 (or handle 0)", "rim 2 (lift) (or handle 0)")


def test_a_prompt_that_comes_later_is_kept_from_what_is_followed_for_the_same_purpose(
    clip: Clip, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("quest.track.finder.find_candidates", all_at_one_place)
    monkeypatch.setattr("quest.track.queries.StreamQueries._near", lambda _, __, at_px: [[True] * len(at_px)] * 4)
    assert names_after(clip, [OPEN], [LIFT]) == ["rim 0", "rim 1"]
    assert names_after(clip, [OPEN], [OPEN]) == ["rim 0"]
    assert names_after(clip, [HANDLE], [OPEN]) == ["handle 0", "rim 1"]
    assert names_after(clip, [OPEN], [Query.semantic("rim")]) == ["rim 0"]
    assert names_after(clip, [LIFT], [Query.slot()]) == ["rim 0"]
    # What is taken hold of to lift stays so whoever found that out: nobody asked for it here.
    assert names_after(clip, [HANDLE, Query.semantic("rim"), Query.semantic("rim")], [OPEN], [LIFT]) == [
        "handle 0", "rim 1", "rim 2",
    ]  # fmt: skip


def test_weights_that_know_no_intents_say_so(clip: Clip):
    tracker = make_tracker(replace(DEFAULT, intents=False))
    with pytest.raises(InputError, match="cannot tell what to lift"):
        tracker.track(clip, [Query.semantic("rim", intent="lift")])
    with pytest.raises(InputError, match="expected one of open, lift"):
        Query.semantic("rim", intent="push")
