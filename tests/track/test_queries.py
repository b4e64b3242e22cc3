"""Queries by label, intent and words: which of what is found they are bound to, and when."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.track.settings import TrackerConfig
from quest.types import Clip, Query
from tests.track.clips import feed, make_clip, make_found, make_tracker

OPEN, LIFT, HANDLE = (
    Query.semantic("rim", intent="open"),
    Query.semantic("rim", intent="lift"),
    Query.semantic("handle"),
)
HANDLES = make_found(("handle", "open", (16, 16)), ("handle", "open", (48, 20)), ("rim", "lift", (30, 60)))


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def test_prompts_choose_by_intent(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    found = make_found(("rim", "open", (16, 16)), ("rim", "lift", (48, 48)), ("handle", "lift", (16, 48)))
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: found)
    tracks = make_tracker().track(clip, [LIFT, OPEN])
    np.testing.assert_allclose(tracks.uv_px[0], [[48, 48], [16, 16]])
    assert make_tracker().track(clip).names == ("rim 0", "rim 1 (lift)", "handle 2 (lift)")


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        # Another label at the same place keeps a prompt from nothing ...
        ([[HANDLE, OPEN, LIFT]], ["handle 0", "rim 1", "rim 2"]),
        ([[HANDLE, HANDLE, LIFT, LIFT]], ["handle 0", "rim 2"]),
        # ... nor one of a frame before, but for the same purpose.
        ([[OPEN], [LIFT]], ["rim 0", "rim 1"]),
        ([[OPEN], [OPEN]], ["rim 0"]),
        ([[HANDLE], [OPEN]], ["handle 0", "rim 1"]),
        ([[OPEN], [Query.semantic("rim")]], ["rim 0"]),
        ([[LIFT], [Query.slot()]], ["rim 0"]),
        # What is taken hold of to lift stays so whoever found that out: nobody asked for it here.
        ([[HANDLE, Query.semantic("rim"), Query.semantic("rim")], [OPEN], [LIFT]], ["handle 0", "rim 1", "rim 2"]),
        (None, ["handle 0", "rim 1", "rim 2 (lift)"]),
    ],
)
def test_a_handle_a_rim_to_open_and_the_same_rim_to_lift(
    asked: list[list[Query]] | None, names: list[str], clip: Clip, monkeypatch: pytest.MonkeyPatch
):
    """All at one place, with these prompts in front of each frame."""
    found = make_found(("handle", "open", (32, 32)), ("rim", "open", (32, 32)), ("rim", "lift", (32, 32)))
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: found)
    stream = make_tracker().stream(clip.camera, None if asked is None else [], alpha=None)
    for t, queries in enumerate(asked or [[]]):
        for query in queries:
            stream.add(query)
        (state,) = feed(stream, clip, range(t, t + 1))
    assert list(state.names) == names


def test_texts_bind_what_they_mean(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: HANDLES)
    words = ("right handle", "third handle", "the handle on the right")
    queries = [*map(Query.text, words), Query.text("rim to lift", name="base"), HANDLE]
    tracks = make_tracker().track(clip, queries)
    assert tracks.names == (*words, "base", "handle 4")
    assert tracks.labels == ("handle", None, "handle", "rim", "handle")
    np.testing.assert_allclose(tracks.uv_px[0, [0, 2, 3, 4]], [[48, 20], [48, 20], [30, 60], [16, 16]])
    assert np.isnan(tracks.uv_px[:, 1]).all()
    assert any("'third handle' found no entity" in flag for flag in tracks.frame_flags)


def test_texts_wait_as_labels_do(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    """A text looks for a quarter of a second, and follows what it found then, wherever others appear later."""
    frames = iter([make_found(), HANDLES.select([1]), HANDLES, HANDLES, HANDLES, HANDLES])
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: next(frames))
    tracker = make_tracker(TrackerConfig(size_px=64, follow_px=64))
    stream = tracker.stream(clip.camera, [Query.text("left handle"), Query.text("left knob")])
    states = [feed(stream, clip, range(t, t + 1), stamp_s=0.1 * t)[0] for t in range(4)]
    assert [state.names for state in states] == [(), ("left handle",), ("left handle",), ("left handle",)]
    np.testing.assert_allclose(states[1].uv_px, [[48, 20]])
    assert not stream.looking
    assert [query.name for query in stream.unbound] == ["left knob"]
    assert tracker.restore(tracker.save(stream)).unbound == stream.unbound


@pytest.mark.parametrize("text", ["all handles", "left hinge", "handle beside the door"])
def test_texts_that_are_no_queries(text: str, clip: Clip):
    with pytest.raises(InputError, match=f"text '{text}'"):
        make_tracker().stream(clip.camera, [Query.text(text)])


def test_what_a_query_says_of_itself():
    assert repr(Query.text("left handle")) == "Query.text('left handle')"
    assert repr(Query.text("left handle", name="mine")) == "Query.text('left handle', name='mine')"
    with pytest.raises(InputError, match="needs words"):
        Query("text")
    with pytest.raises(InputError, match="expected one of open, lift"):
        Query.semantic("rim", intent="push")
