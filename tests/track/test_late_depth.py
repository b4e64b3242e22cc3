"""Depth that begins after the first frame: what is seen goes on where it was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from quest.errors import InputError
from quest.track.intake import DEPTH_BEGINS_FLAG
from quest.types import Query
from tests.track.clips import make_clip, make_tracker

POINTS = [Query.point(0, 20.0, 30.0, name="a"), Query.point(0, 40.0, 25.0, name="b")]


def test_what_is_seen_is_bound_again_where_it_was_seen():
    clip, tracker = make_clip(frames=3), make_tracker()
    stream, (first, second, third) = tracker.stream(clip.camera, POINTS), map(clip.frame, range(3))
    stream.step(first.rgb, None, first.stamp_s)
    for query, visible in zip(stream.memory.following, (True, False), strict=True):
        assert query.answer is not None
        query.answer = replace(query.answer, visible=visible)
    answer, before = stream.memory.following[0].answer, stream.memory.binding.anchor
    assert answer is not None
    assert before is not None
    state = stream.step(second.rgb, second.depth_m, second.stamp_s)
    assert DEPTH_BEGINS_FLAG in state.flags
    assert state.names == ("a", "b")
    # As if it had been asked for here; what was hidden keeps what it was bound to.
    fresh = tracker.stream(clip.camera, [Query.point(0, *map(float, answer.uv_px))])
    assert DEPTH_BEGINS_FLAG not in fresh.step(second.rgb, second.depth_m, second.stamp_s).flags
    after, expected = stream.memory.binding.anchor, fresh.memory.binding.anchor
    assert after is not None
    assert expected is not None
    torch.testing.assert_close(after.content[0, 0], expected.content[0, 0])
    torch.testing.assert_close(after.template[0, 0], expected.template[0, 0])
    torch.testing.assert_close(after.content[0, 1], before.content[0, 1])
    assert not torch.allclose(after.content[0, 0], before.content[0, 0])
    assert DEPTH_BEGINS_FLAG not in stream.step(third.rgb, third.depth_m, third.stamp_s).flags


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
    assert np.isnan(state.point_world).all()
    after = stream.step(third.rgb, third.depth_m, third.stamp_s)
    assert not any("depth" in flag for flag in after.flags)
    assert np.isfinite(after.point_world).all()
