"""Streams as they come from cameras: late, double and missing frames, queries that come and go, alarms, saved state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quest.errors import ConfigError, InputError
from quest.filter.landmarks import Landmarks
from quest.filter.picture import Picture
from quest.filter.queries import Queries
from quest.filter.step import FilterState
from quest.filter.view import View
from quest.geometry import scale_camera
from quest.monitor import Alarm, Budget
from quest.track import StreamState, Tracker
from quest.track.events import Events
from quest.track.preprocess import DEPTH_BEGINS_FLAG
from quest.track.stream import reason
from quest.types import Clip, Query, State
from tests.filter.scenes import scene
from tests.tolerances import PIXEL_MOVED, POINT
from tests.track.clips import EAGER, POINTS, feed, make_calibration, make_clip, make_tracker, moved_world, without_depth


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip(frames=9)


def assert_equal(got: StreamState, expected: StreamState) -> None:
    for name in ("names", "labels", "state", "query", "alarm", "stamp_s"):
        assert getattr(got, name) == getattr(expected, name), name
    for name in ("uv_px", "point_world", "confidence", "visible", "lost_log_odds", "lost_p", "q"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), err_msg=name)


def watched(alarming: bool = False) -> Tracker:
    """A tracker with a monitor, which finds everything or nothing suspicious."""
    return make_tracker(depth=make_calibration(alarming=alarming))


def test_small_pictures_are_enlarged(clip: Clip):
    """They are answered in their own pixels, as the user's own enlargement would be in its own."""
    assert clip.depth_m is not None
    grey = clip.rgb.mean(axis=-1).round().astype(np.uint8)  # colours would be rounded before they became grey
    small = replace(clip, rgb=np.repeat(grey[..., None], 3, axis=-1))
    camera = scale_camera(clip.camera, scale=(2.0, 2.0), pad_left_px=0, pad_top_px=0, width=128, height=128)
    images = [cv2.resize(image, (128, 128), interpolation=cv2.INTER_LINEAR) for image in small.rgb]
    depths = [cv2.resize(depth, (128, 128), interpolation=cv2.INTER_NEAREST_EXACT) for depth in clip.depth_m]
    large = replace(small, camera=camera, rgb=np.stack(images), depth_m=np.stack(depths))
    twice = [replace(q, uv_px=(2 * q.uv_px[0], 2 * q.uv_px[1])) for q in POINTS if q.uv_px is not None]
    streams = [make_tracker(replace(EAGER, follow_px=n)).stream(c.camera, q) for n, c, q in (
        (128, small, POINTS), (64, large, twice),
    )]  # fmt: skip
    for t in range(len(clip)):
        (got,), (expected,) = (feed(s, c, range(t, t + 1)) for s, c in zip(streams, (small, large), strict=True))
        np.testing.assert_allclose(2 * got.uv_px, expected.uv_px, atol=1e-3)
        np.testing.assert_allclose(got.point_world, expected.point_world, atol=1e-5)
        if t == 4:
            streams[0].place("a", 30.0, 24.0)
            streams[1].place("a", 60.0, 48.0)
    assert np.ptp([s.memory.answer.uv_px[0] for s in streams], axis=0).max() > 10  # type: ignore[union-attr]


@pytest.mark.parametrize(("frame", "flag"), [(1, "late"), (3, "duplicate")])
def test_late_and_double_frames_repeat_the_answer(frame: int, flag: str, clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS)
    last = feed(stream, clip, range(4))[-1]
    repeated = feed(stream, clip, range(frame, frame + 1))[0]
    assert flag in repeated.flags[0]
    assert_equal(repeated, last)
    straight = make_tracker().stream(clip.camera, POINTS)
    assert_equal(feed(stream, clip, range(4, 8))[-1], feed(straight, clip, range(8))[-1])


def test_double_frames_of_a_clip_are_counted(clip: Clip):
    twice = np.repeat(np.arange(3), 2)
    double = replace(
        clip, **{name: getattr(clip, name)[twice] for name in ("rgb", "depth_m", "stamp_s", "cam_from_world")}
    )
    assert make_tracker().track(double, POINTS).frame_flags == ("duplicate: 3 of 6 frames",)


def test_a_clock_that_begins_anew_is_followed(clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS)
    feed(stream, clip, range(2), stamp_s=1000.0)
    state = feed(stream, clip, range(2, 3), stamp_s=0.0)[0]
    assert "clock" in state.flags[0]
    assert state.stamp_s == 0.0


def test_missing_depth_and_poses_are_flagged(clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS)
    assert feed(stream, clip, range(1))[0].flags == ()
    assert "depth" in feed(stream, without_depth(clip, slice(1, 2)), range(1, 2))[0].flags[0]
    moved = np.eye(4)
    moved[0, 3] = 0.01
    feed(stream, clip, range(2, 3), cam_from_world=moved)
    assert "pose" in feed(stream, clip, range(3, 4), cam_from_world=None)[0].flags[0]
    unposed = make_tracker().stream(clip.camera, POINTS)
    assert feed(unposed, clip, range(1), cam_from_world=None)[0].flags == ()


def test_depth_that_begins_late_tells_places_from_there_on():
    clip, tracker = scene(np.zeros(4)), make_tracker()
    stream = tracker.stream(clip.camera, POINTS)
    told = [*feed(stream, clip, range(1), depth_m=None), *feed(stream, clip, range(1, 4))]
    assert np.isnan(told[0].point_world).all()
    assert [DEPTH_BEGINS_FLAG in state.flags for state in told] == [False, True, False, False]
    np.testing.assert_allclose(told[-1].point_world, tracker.track(clip, POINTS).point_world[-1], atol=0.01)


def test_depth_that_is_not_in_metres(clip: Clip):
    stream, millimetres = make_tracker().stream(clip.camera, POINTS), 1000 * clip.frame(0).depth_m  # type: ignore[operator]
    with pytest.raises(InputError, match="expected depth in metres"):
        feed(stream, clip, range(1), depth_m=millimetres)
    feed(stream, clip, range(1))
    state, after = feed(stream, clip, range(1, 2), depth_m=millimetres)[0], feed(stream, clip, range(2, 3))[0]
    assert any(flag.startswith("depth ignored") for flag in state.flags)
    assert not state.has_depth
    assert not any("depth" in flag for flag in after.flags)
    assert np.isfinite(after.point_world).all()


def test_poses_that_begin_late_move_nothing():
    """Until a pose comes the world is the first camera, so the first pose is where the camera is by then."""
    clip = scene(np.zeros(6))
    still, late = (make_tracker().stream(clip.camera, POINTS) for _ in range(2))
    turned = np.eye(4)
    turned[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    for t in range(6):
        frame = clip.frame(t)
        expected = still.step(frame.rgb, frame.depth_m, frame.stamp_s)
        state = late.step(frame.rgb, frame.depth_m, frame.stamp_s, None if t < 3 else turned)
        np.testing.assert_allclose(state.uv_px, expected.uv_px, **PIXEL_MOVED)
        told = "poses begin" in " ".join(state.flags)
        assert told == (t == 3)
    np.testing.assert_allclose(state.point_world, expected.point_world @ turned[:3, :3], **POINT)


def test_poses_are_rigid_up_to_rounding(clip: Clip):
    stream, frame = make_tracker().stream(clip.camera, POINTS), clip.frame(0)
    rounded = np.eye(4)
    rounded[:3, :3] = np.round(Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix(), 4)
    for t in range(4):
        with pytest.raises(InputError, match="rigid"):
            stream.step(frame.rgb, frame.depth_m, t / 30, np.zeros((4, 4)))
        assert stream.frame == t
        state = stream.step(clip.frame(t).rgb, frame.depth_m, t / 30, rounded)
    assert all(joint is not None for joint in state.joint)


@pytest.mark.plain  # where types are checked it is refused
def test_a_pose_of_lists_is_taken_whole(clip: Clip):
    """Never taken in half: the frame would come again as a double one."""
    stream, frame = make_tracker().stream(clip.camera, POINTS), clip.frame(0)
    pose: Any = np.eye(4).tolist()
    assert stream.step(frame.rgb, frame.depth_m, 0.0, pose).names == ("a", "b")


def test_retiring_leaves_the_others_alone(clip: Clip):
    both, one = (make_tracker().stream(clip.camera, POINTS) for _ in range(2))
    feed(both, clip, range(3))
    feed(one, clip, range(3))
    one.retire("a")
    left, kept = (feed(stream, clip, range(3, 6))[-1] for stream in (one, both))
    np.testing.assert_allclose(left.uv_px[0], kept.uv_px[1], atol=0.5)
    assert left.names == ("b",)


def test_queries_come_and_go(clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS[:1])
    feed(stream, clip, range(2))
    number = stream.add(Query.point(stream.frame, 40.5, 22.25, name="b"))
    assert [q.name for q in stream.unbound] == ["b"]
    both = feed(stream, clip, range(2, 4))[-1]
    assert (both.query, both.names) == ((0, number), ("a", "b"))
    stream.rename("b", "second")
    stream.retire("a")
    after = feed(stream, clip, range(4, 6))[-1]
    assert (after.query, after.names) == ((number,), ("second",))
    assert stream.add(Query.semantic("handle")) == 2
    assert feed(stream, clip, range(6, 8))[-1].query == (1, 2)
    stream.retire(1)
    stream.retire(2)
    assert feed(stream, clip, range(7, 8), stamp_s=9.0)[0].query == ()


def test_queries_that_are_not_there(clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS)
    feed(stream, clip, range(2))
    with pytest.raises(InputError, match="'c'"):
        stream.retire("c")
    with pytest.raises(InputError, match="called 'b' already"):
        stream.rename("a", "b")
    with pytest.raises(InputError, match="has passed"):
        stream.add(Query.point(1, 3, 3))
    with pytest.raises(InputError, match="99"):
        stream.add(Query.point(5, 99, 3))


def test_a_label_is_looked_for_in_several_frames(clip: Clip):
    stream = make_tracker(replace(EAGER, prompt_threshold=1.0)).stream(clip.camera, [Query.semantic("handle")])
    assert feed(stream, clip, range(2))[-1].query == ()
    stream._queries._config = EAGER
    assert feed(stream, clip, range(2, 3))[0].query == (0,)


def test_ignored_frames_use_up_no_patience(clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS[:1])
    feed(stream, clip, range(1))
    number = stream.add(Query.semantic("handle"))
    for _ in range(9):
        assert "duplicate" in feed(stream, clip, range(1))[0].flags[0]
    assert feed(stream, clip, range(1, 2))[0].query == (0, number)


def test_who_still_looks(clip: Clip):
    stream = make_tracker(replace(EAGER, prompt_threshold=1.0)).stream(clip.camera, [Query.semantic("knob")])
    asked = [stream.looking]
    for t in range(9):
        feed(stream, clip, range(t, t + 1))
        asked.append(stream.looking)
    assert asked == [True] * 9 + [False]
    assert [q.label for q in stream.unbound] == ["knob"]
    stream.add(Query.point(20, 9, 9))
    assert stream.looking


def test_a_camera_of_double_precision(clip: Clip):
    numbers = {name: np.float64(getattr(clip.camera, name)) for name in ("fx", "fy", "cx", "cy")}
    cameras = clip.camera, replace(clip.camera, **numbers)
    one, other = (feed(make_tracker().stream(camera, POINTS), clip, range(2))[-1] for camera in cameras)
    assert_equal(one, other)


def test_joints_are_in_the_world(clip: Clip):
    """In another world frame they move along, like the points."""
    motion = np.eye(4)
    motion[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    motion[:3, 3] = [3.0, -2.0, 0.5]
    tracker = make_tracker()
    here, there = (
        feed(tracker.stream(c.camera, POINTS), c, range(8))[-1].joint for c in (clip, moved_world(clip, motion))
    )
    for one, other in zip(here, there, strict=True):
        assert one is not None
        assert other is not None
        assert one.kind == other.kind
        q = np.linspace(one.lower, one.upper, 5)
        moved = one.at(q) @ motion[:3, :3].T + motion[:3, 3]
        np.testing.assert_allclose(other.at(q), moved, atol=1e-3)


def test_an_alarm_is_told_and_searched(clip: Clip):
    told: list[Alarm] = []
    stream = watched(alarming=True).stream(clip.camera, POINTS, alpha=0.1)
    stream.on_alarm(told.append)
    states = feed(stream, clip, range(8))
    assert [a.query for a in told] == [0, 1]
    assert told[0].name == "a"
    assert told[0].reason
    assert states[-1].state == (State.LOST, State.LOST)
    assert [a.query for a in states[-1].alarm if a is not None] == [0, 1]
    assert not states[-1].visible.any()


def test_an_open_alarm_goes_by_the_new_name(clip: Clip):
    stream, events = watched(alarming=True).stream(clip.camera, POINTS, alpha=0.1), Events()
    for t, state in enumerate(feed(stream, clip, range(4))):
        events.step(t, state)
    stream.rename("b", "b")
    stream.rename("a", "lid")
    state = feed(stream, clip, range(4, 5))[0]
    assert [alarm.name for alarm in state.alarm if alarm is not None] == ["lid", "b"]
    assert events.step(4, state) == ()


def test_a_callback_may_save_the_stream_or_fail(clip: Clip, caplog: pytest.LogCaptureFixture):
    tracker = watched(alarming=True)
    stream, saved, heard = tracker.stream(clip.camera, POINTS, alpha=0.1), [], []

    def keep(alarm: Alarm) -> None:
        saved.append((stream.frame, tracker.save(stream)))
        raise RuntimeError(f"about {alarm.name}")

    stream.on_alarm(keep)
    stream.on_alarm(heard.append)
    before = feed(stream, clip, range(8))
    assert len(before) == 8
    assert len(heard) == len(saved) > 0
    assert f"about {heard[0].name}" in caplog.text
    begun, data = saved[0]
    after, again = before[begun:], feed(tracker.restore(data), clip, range(begun, 8))
    for a, b in zip(after, again, strict=True):
        assert_equal(a, b)


def test_a_watched_stream_is_not_restored_unwatched(clip: Clip):
    tracker = watched()
    data = tracker.save(tracker.stream(clip.camera, POINTS, alpha=0.1))
    with pytest.raises(InputError, match="calibration"):
        make_tracker().restore(data)
    unwatched = tracker.save(tracker.stream(clip.camera, POINTS, alpha=None))
    assert make_tracker().restore(unwatched).budget is None


def test_a_saved_stream_keeps_what_alpha_is_for(clip: Clip):
    tracker = watched()
    for budget in (Budget(0.1), Budget(0.2, 90)):
        stream = tracker.stream(clip.camera, POINTS, alpha=budget.alpha, alpha_frames=budget.frames)
        assert tracker.restore(tracker.save(stream)).budget == budget
    for each in (tracker, make_tracker()):
        with pytest.raises(ConfigError, match="alpha_frames"):
            each.stream(clip.camera, POINTS, alpha_frames=0)


def test_what_is_found_again_ends_the_alarm(clip: Clip):
    tracker = watched(alarming=True)
    stream = tracker.stream(clip.camera, POINTS[1:], alpha=0.1)
    assert feed(stream, clip, range(4))[-1].state == (State.LOST,)
    assert stream._monitor is not None
    stream._monitor.calibration = make_calibration(alarming=False)
    after = feed(stream, clip, range(4, 8))
    assert after[0].alarm[0] is not None
    assert after[-1].alarm == (None,)
    assert after[-1].state != (State.LOST,)


def test_without_alpha_there_are_no_alarms(clip: Clip):
    stream = watched(alarming=True).stream(clip.camera, POINTS, alpha=None)
    assert stream.budget is None
    states = feed(stream, clip, range(8))
    assert all(s.alarm == (None, None) for s in states)


@pytest.mark.parametrize(("after", "alarming"), [(1, False), (5, True)])
def test_a_saved_stream_goes_on_to_the_bit(after: int, alarming: bool, clip: Clip):
    tracker = watched(alarming)
    stream = tracker.stream(clip.camera, [*POINTS, Query.semantic("handle"), Query.point(6, 9, 9, name="late")])
    feed(stream, clip, range(after))
    data = tracker.save(stream)
    again = tracker.restore(data)
    assert tracker.save(again) == data
    for got, expected in zip(feed(again, clip, range(after, 8)), feed(stream, clip, range(after, 8)), strict=True):
        assert_equal(got, expected)
    assert tracker.save(again) == tracker.save(stream)


def test_a_stream_saved_before_its_first_frame(clip: Clip):
    tracker = make_tracker()
    again = tracker.restore(tracker.save(tracker.stream(clip.camera)))
    assert_equal(feed(again, clip, range(2))[-1], feed(tracker.stream(clip.camera), clip, range(2))[-1])


def test_what_is_no_saved_stream_is_refused(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    tracker = make_tracker()
    stream = tracker.stream(clip.camera, POINTS)
    feed(stream, clip, range(2))
    data = tracker.save(stream)
    with pytest.raises(InputError, match="other weights, settings"):
        make_tracker(replace(EAGER, bias=0.2)).restore(data)
    monkeypatch.setattr("quest.track.tracker.REVISION", -1)
    with pytest.raises(InputError, match="another revision"):
        tracker.restore(data)


def test_why_something_is_lost():
    at = np.array([[30.0, 30.0]])
    picture = Picture(np.zeros((64, 64), np.uint8), np.ones((2, 8, 8), np.float32))
    named = Queries.named(picture, at, np.ones(1), np.zeros((1, 1, 3)), np.zeros((1, 3)), None, np.eye(4)[None])
    queries = replace(named, rival_px=np.array([[33.0, 34.0]]))
    for changes, words in (
        ({"seen_log_odds": -4.0}, "behind something or out of view"),
        (
            {"seen_log_odds": -4.0, "unseen_s": 1.24, "rival_log_odds": -1.0},
            "not seen for 1.2 s where it should be; looks more like what is 5 px away",
        ),
        ({"seen_log_odds": 0.5}, "looks little like its anchor"),
    ):
        changed = replace(queries, **{name: np.array([value]) for name, value in changes.items()})
        view = View(np.eye(3), np.eye(4), None)
        state = FilterState(picture, view, 0.0, Landmarks.none(), changed, None)
        assert reason(state, 0, at[0]) == words
