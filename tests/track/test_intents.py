"""Queries that say what an entity is taken hold of for."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.types import Clip, Query
from tests.track.clips import make_clip, make_found, make_tracker


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def test_prompts_choose_by_intent(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    found = make_found(("rim", "open", (16, 16)), ("rim", "lift", (48, 48)), ("handle", "lift", (16, 48)))
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: found)
    tracker = make_tracker()
    tracks = tracker.track(clip, [Query.semantic("rim", intent=intent) for intent in ("lift", "open")])
    np.testing.assert_allclose(tracks.uv_px[0], [[48, 48], [16, 16]])
    assert tracker.track(clip).names == ("rim 0", "rim 1 (lift)", "handle 2 (lift)")


ALL_AT_ONE_PLACE = make_found(("handle", "open", (32, 32)), ("rim", "open", (32, 32)), ("rim", "lift", (32, 32)))
"""A handle, a rim to open and the same rim to lift."""


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
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: ALL_AT_ONE_PLACE)
    assert names_after(clip, [HANDLE, OPEN, LIFT]) == ["handle 0", "rim 1", "rim 2"]
    assert names_after(clip, [HANDLE, HANDLE, LIFT, LIFT]) == ["handle 0", "rim 2"]
    assert make_tracker().track(clip).names == ("handle 0", "rim 1", "rim 2 (lift)")


def test_a_prompt_that_comes_later_is_kept_from_what_is_followed_for_the_same_purpose(
    clip: Clip, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: ALL_AT_ONE_PLACE)
    assert names_after(clip, [OPEN], [LIFT]) == ["rim 0", "rim 1"]
    assert names_after(clip, [OPEN], [OPEN]) == ["rim 0"]
    assert names_after(clip, [HANDLE], [OPEN]) == ["handle 0", "rim 1"]
    assert names_after(clip, [OPEN], [Query.semantic("rim")]) == ["rim 0"]
    assert names_after(clip, [LIFT], [Query.slot()]) == ["rim 0"]
    # What is taken hold of to lift stays so whoever found that out: nobody asked for it here.
    assert names_after(clip, [HANDLE, Query.semantic("rim"), Query.semantic("rim")], [OPEN], [LIFT]) == [
        "handle 0", "rim 1", "rim 2",
    ]  # fmt: skip


def test_intents_are_to_open_and_to_lift():
    with pytest.raises(InputError, match="expected one of open, lift"):
        Query.semantic("rim", intent="push")
