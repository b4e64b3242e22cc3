"""What streams say beside their tracks: where on its joint a query is, and whether one still looks; for any camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.types import Clip, Query
from tests.track.clips import EAGER, make_clip, make_tracker
from tests.track.test_stream import POINTS, assert_equal, feed


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip(frames=9)


def test_a_camera_of_double_precision(clip: Clip):
    numbers = {name: np.float64(getattr(clip.camera, name)) for name in ("fx", "fy", "cx", "cy")}
    stream = make_tracker().stream(replace(clip.camera, **numbers), POINTS)
    assert_equal(feed(stream, clip, range(2))[-1], feed(make_tracker().stream(clip.camera, POINTS), clip, range(2))[-1])


def test_who_still_looks(clip: Clip):
    blind = make_tracker(config=replace(EAGER, prompt_threshold=1.0))
    stream = blind.stream(clip.camera, [Query.semantic("knob")])
    asked = [stream.looking]
    for t in range(9):
        feed(stream, clip, range(t, t + 1))
        asked.append(stream.looking)
    assert asked == [True] * 9 + [False]
    assert [q.label for q in stream.unbound] == ["knob"]
    stream.add(Query.point(20, 9, 9))
    assert stream.looking
