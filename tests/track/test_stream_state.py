"""What streams say beside their tracks: where on its joint a query is, and whether one still looks; for any camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.grounding import JointKind
from quest.track.world import to_world
from quest.types import Clip, Query
from tests.track.clips import make_clip, make_tracker
from tests.track.test_stream import POINTS, assert_equal, feed


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip(frames=8)


def test_a_camera_of_double_precision(clip: Clip):
    numbers = {name: np.float64(getattr(clip.camera, name)) for name in ("fx", "fy", "cx", "cy")}
    stream = make_tracker().stream(replace(clip.camera, **numbers), POINTS)
    assert_equal(feed(stream, clip, range(2))[-1], feed(make_tracker().stream(clip.camera, POINTS), clip, range(2))[-1])


def test_where_on_its_joint_a_query_is(clip: Clip):
    """By the network's own point: the joint was never told of the user's pixel beside it."""
    stream = make_tracker().stream(clip.camera, POINTS)
    state = feed(stream, clip, range(8))[-1]
    assert stream.memory.intake.reference is not None
    for k, query in enumerate(stream.memory.following):
        joint = state.joint[k]
        assert joint is not None
        assert query.place is not None
        moves = joint.kind is not JointKind.STATIC
        own = to_world(query.place[None], stream.memory.intake.reference).astype(np.float64)
        assert state.q[k] == pytest.approx(joint.locate(own)[0] if moves else np.nan, nan_ok=True)


def test_who_still_looks(clip: Clip):
    tracker = make_tracker()
    blind = tracker.with_config(replace(tracker.config, prompt_threshold=1.0), name="blind")
    stream = blind.stream(clip.camera, [Query.semantic("knob")])
    asked = [stream.looking]
    for t in range(8):
        feed(stream, clip, range(t, t + 1))
        asked.append(stream.looking)
    assert asked == [True] * 8 + [False]
    assert [q.label for q in stream.unbound] == ["knob"]
    stream.add(Query.point(20, 9, 9))
    assert stream.looking
