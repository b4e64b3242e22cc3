"""Queries in words: bound once, at first sight, to the one thing that they mean."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.track.settings import TrackerConfig
from quest.types import Clip, Query
from tests.track.clips import make_clip, make_found, make_tracker

HANDLES = make_found(("handle", "open", (16, 16)), ("handle", "open", (48, 20)), ("rim", "lift", (30, 60)))


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def test_texts_bind_what_they_mean(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: HANDLES)
    queries = [
        Query.text("right handle"),
        Query.text("rim to lift", name="base"),
        Query.text("third handle"),
        Query.semantic("handle"),
        Query.text("the handle on the right"),
    ]
    tracks = make_tracker().track(clip, queries)
    assert tracks.names == ("right handle", "base", "third handle", "handle 3", "the handle on the right")
    assert tracks.labels == ("handle", "rim", None, "handle", "handle")
    np.testing.assert_allclose(tracks.uv_px[0, [0, 1, 3, 4]], [[48, 20], [30, 60], [16, 16], [48, 20]])
    assert np.isnan(tracks.uv_px[:, 2]).all()
    assert any("'third handle' found no entity" in flag for flag in tracks.frame_flags)


def test_texts_wait_as_labels_do(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    """A text looks for a quarter of a second, and follows what it found then, wherever others appear later."""
    frames = iter([make_found(), HANDLES.select([1]), HANDLES, HANDLES, HANDLES, HANDLES])
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: next(frames))
    tracker = make_tracker(config=TrackerConfig(size_px=64))
    stream = tracker.stream(clip.camera, [Query.text("left handle"), Query.text("left knob")])
    states = []
    for t in range(4):
        frame = clip.frame(t)
        states.append(stream.step(frame.rgb, frame.depth_m, 0.1 * t, frame.cam_from_world))
    assert [state.names for state in states] == [(), ("left handle",), ("left handle",), ("left handle",)]
    np.testing.assert_allclose(states[1].uv_px, [[48, 20]])
    assert not stream.looking
    assert [query.name for query in stream.unbound] == ["left knob"]
    assert tracker.restore(tracker.save(stream)).unbound == stream.unbound


@pytest.mark.parametrize("text", ["all handles", "left hinge", "handle beside the door"])
def test_texts_that_are_no_queries(text: str, clip: Clip):
    with pytest.raises(InputError, match=f"text '{text}'"):
        make_tracker().stream(clip.camera, [Query.text(text)])


def test_text_queries_are_written_as_they_are_made():
    assert repr(Query.text("left handle")) == "Query.text('left handle')"
    assert repr(Query.text("left handle", name="mine")) == "Query.text('left handle', name='mine')"
    with pytest.raises(InputError, match="needs words"):
        Query("text")
