"""Depth that begins after the first frame: what is seen goes on where it was seen."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.track.preprocess import DEPTH_BEGINS_FLAG
from quest.types import Query
from tests.filter.scenes import scene
from tests.track.clips import make_clip, make_tracker

POINTS = [Query.point(0, 20.0, 30.0, name="a"), Query.point(0, 40.0, 25.0, name="b")]


def test_places_are_known_from_there_on():
    clip, tracker = scene(np.zeros(4)), make_tracker()
    stream, told = tracker.stream(clip.camera, POINTS), []
    for t in range(4):
        frame = clip.frame(t)
        told.append(stream.step(frame.rgb, None if t == 0 else frame.depth_m, frame.stamp_s, frame.cam_from_world))
    assert np.isnan(told[0].point_world).all()
    assert [DEPTH_BEGINS_FLAG in state.flags for state in told] == [False, True, False, False]
    whole = tracker.track(clip, POINTS)
    np.testing.assert_allclose(told[-1].point_world, whole.point_world[-1], atol=0.01)


def test_depth_that_is_not_in_metres():
    clip, tracker = make_clip(frames=3, size=(96, 96)), make_tracker()
    stream, (first, second, third) = tracker.stream(clip.camera, POINTS), map(clip.frame, range(3))
    assert first.depth_m is not None
    assert second.depth_m is not None
    with pytest.raises(InputError, match="expected depth in metres"):
        stream.step(first.rgb, first.depth_m * np.float32(1000), first.stamp_s)
    stream.step(first.rgb, first.depth_m, first.stamp_s)
    state = stream.step(second.rgb, second.depth_m * np.float32(1000), second.stamp_s)
    assert any(flag.startswith("depth ignored") for flag in state.flags)
    assert not state.has_depth
    after = stream.step(third.rgb, third.depth_m, third.stamp_s)
    assert not any("depth" in flag for flag in after.flags)
    assert np.isfinite(after.point_world).all()
