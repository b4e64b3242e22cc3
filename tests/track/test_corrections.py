"""What somebody says who looks at the picture: where a query's entity is, and that an answer is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.errors import InputError
from quest.types import Clip, Query, State
from tests.track.clips import POINTS, feed, make_calibration, make_clip, make_tracker


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip(frames=8)


def test_what_is_placed_goes_on_from_there(clip: Clip):
    stream, other = (make_tracker().stream(clip.camera, POINTS) for _ in range(2))
    for each in (stream, other):
        feed(each, clip, range(3))
    stream.place("a", 30, 12)
    left, kept = (feed(each, clip, range(3, 5))[-1] for each in (stream, other))
    assert (left.query, left.names, left.labels) == (kept.query, kept.names, kept.labels)
    assert np.linalg.norm(left.uv_px[0] - (30, 12)) < 4 < np.linalg.norm(kept.uv_px[0] - (30, 12))
    assert np.linalg.norm(left.uv_px[1] - kept.uv_px[1]) < 4, "of random pictures"


def test_a_query_that_waits_is_bound_where_it_is_placed(clip: Clip):
    stream = make_tracker(depth=make_calibration(alarming=False)).stream(clip.camera, POINTS[:1], alpha=0.1)
    feed(stream, clip, range(3))
    number = stream.add(Query.point(stream.frame, 10, 10, name="new"))
    stream.place(number, 40, 22)
    state = feed(stream, clip, range(3, 4))[0]
    assert (state.names, stream.unbound) == (("a", "new"), ())
    assert np.linalg.norm(state.uv_px[1] - (40, 22)) < 4
    number = stream.add(Query.point(stream.frame, 10, 10, name="another"))
    stream.place(number, 30, 22)
    stream.rename(number, "newer")  # at once
    stream.retire("newer")
    assert feed(stream, clip, range(4, 5))[0].names == ("a", "new")


@pytest.mark.parametrize("how", ["place", "confirm"])
def test_an_answered_alarm_ends(how: str, clip: Clip):
    stream = make_tracker(depth=make_calibration(alarming=True)).stream(clip.camera, POINTS, alpha=0.1)
    alarmed = feed(stream, clip, range(4))[-1]
    assert alarmed.state == (State.LOST, State.LOST)
    assert stream._monitor is not None
    stream._monitor.calibration = make_calibration(alarming=False)
    if how == "place":
        stream.place("b", *alarmed.uv_px[1].tolist())
    else:
        stream.confirm("b")
    state = feed(stream, clip, range(4, 5))[0]
    assert state.alarm[0] is not None
    assert (state.alarm[1], state.state[1]) == (None, State.TRACKING)


def test_what_is_occluded_is_confirmed_where_it_is_held(clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS)
    feed(stream, clip, range(3))
    covered = clip.frame(3)
    assert covered.depth_m is not None
    before = stream.step(np.full_like(covered.rgb, 90), np.full_like(covered.depth_m, 0.3), 0.2, covered.cam_from_world)
    stream.confirm("a")
    after = feed(stream, clip, range(4, 5))[0]
    np.testing.assert_allclose(after.uv_px[0], before.uv_px[0], atol=3)
    assert after.lost_log_odds[0] < 0


def test_corrections_that_cannot_be_meant(clip: Clip):
    stream = make_tracker().stream(clip.camera, [*POINTS, Query.point(6, 5, 5, name="later")])
    with pytest.raises(InputError, match="a frame first"):
        stream.place("a", 1, 1)
    feed(stream, clip, range(2))
    for x in (64.5, float("nan")):
        with pytest.raises(InputError, match="within 64 x 64"):
            stream.place("a", x, 3)
    with pytest.raises(InputError, match="'c'"):
        stream.place("c", 1, 1)
    with pytest.raises(InputError, match="that waits"):
        stream.confirm("later")


def test_the_pose_of_the_camera_is_told(clip: Clip):
    poses = clip.cam_from_world.copy()
    poses[:, 0, 3] += 0.01 * np.arange(len(clip))
    moving = replace(clip, cam_from_world=poses)
    stream = make_tracker().stream(clip.camera, POINTS)
    for t in range(4):
        (state,) = feed(stream, moving, range(t, t + 1))
        assert state.cam_from_world is not None
        np.testing.assert_allclose(state.cam_from_world, poses[t], atol=1e-6)
    colours = make_tracker().stream(clip.camera, POINTS)
    assert colours.step(clip.rgb[0], None, 0.0).cam_from_world is None
    tracks = make_tracker().track(moving, POINTS)
    assert tracks.cam_from_world is not None
    np.testing.assert_allclose(tracks.cam_from_world, poses, atol=1e-6)
