"""Messages of a bag go in, messages of the definitions come out, and they are what the tracker answers."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from quest_ros.settings import Settings
from quest_ros.tracking import Tracking

from quest.data.recording import open_recording
from quest.errors import QuestError
from quest.filter.joints import Joint, JointKind
from quest.filter.view import move
from quest.monitor import Alarm
from quest.track import StreamState, Tracker
from quest.types import Clip, Query, State
from tests.data.bags import COLOUR, COLOUR_FRAME, COLOUR_INFO, DEPTH, SECOND, transform
from tests.ros.played import START_NS, bag_of, play
from tests.ros.ros_types import Types, types_of

FRAMES = 4
JAZZY = types_of("jazzy")
CLICK = (450.0, 228.0)


@pytest.fixture(scope="module")
def clip() -> Clip:
    source = open_recording("sample")
    frames = list(islice(source, FRAMES))
    rgb, depth_m = (np.stack([getattr(frame, name) for frame in frames]) for name in ("rgb", "depth_m"))
    return Clip.from_arrays(rgb, depth_m, source.camera, stamp_s=[frame.stamp_s for frame in frames])


@pytest.fixture(scope="module")
def bag(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bag_of(clip, FRAMES, tmp_path_factory.mktemp("ros") / "bag")


@pytest.fixture(scope="module")
def messages(bag: Path) -> list[tuple[str, Any, int]]:
    return list(play(bag))


def one_point(**settings: Any) -> Settings:
    """The handle of the drawer, by a pixel as ROS counts it."""
    return Settings(points=(f"{CLICK[0] - 0.5},{CLICK[1] - 0.5},handle",), **settings)


def feed(tracking: Tracking, sent: Any) -> None:
    topic, message, log_ns = sent
    if topic == COLOUR_INFO:
        tracking.take_info(message)
    else:
        (tracking.take_colours if topic == COLOUR else tracking.take_depth)(message, log_ns)


def run(tracking: Tracking, messages: Any) -> list[Any]:
    """What is answered if the tracker is as fast as the camera."""
    answers = []
    for sent in messages:
        feed(tracking, sent)
        answers.append(tracking.step())
    return [answer for answer in answers if answer is not None]


def shifted(messages: Any, seconds: float) -> list[Any]:
    """The same messages at another time."""
    moved = deepcopy(messages)
    for _, message, _ in moved:
        message.header.stamp.sec += int(seconds)
    return moved


def changed(message: Any, **fields: Any) -> Any:
    """A copy with other fields, which the messages of rosbags allow."""
    copy = deepcopy(message)
    for name, value in fields.items():
        setattr(copy, name, value)
    return copy


@pytest.fixture
def tracking(tracker: Tracker) -> Tracking:
    return Tracking(tracker, one_point(), JAZZY)


def statuses(tracking: Tracking, types: Types = JAZZY, *, now_ns: int = START_NS) -> dict[str, tuple[str, str]]:
    """Level and message of each line of the diagnostics, as another node would receive them."""
    names = {0: "OK", 1: "WARN", 2: "ERROR"}
    diagnostics = tracking.diagnostics(now_ns)
    assert diagnostics is not None
    told = types.again(diagnostics)
    return {status.name.removeprefix("quest: "): (names[status.level], status.message) for status in told.status}


def test_answers_are_those_of_the_stream(tracker: Tracker, bag: Path, messages: Any):
    tracking = Tracking(tracker, one_point(), JAZZY, topic=COLOUR)
    answers = run(tracking, messages)
    source = open_recording(str(bag))
    stream = tracker.stream(source.camera, [Query.point(0, *CLICK, name="handle")])
    states = [stream.step(frame.rgb, frame.depth_m, frame.stamp_s) for frame in source]
    assert len(answers) == len(states) == FRAMES
    for t, (answer, state) in enumerate(zip(answers, states, strict=True)):
        tracks = JAZZY.again(answer.tracks)
        assert (tracks.header.frame_id, tracks.frame, tracks.stream) == (COLOUR_FRAME, t, 0)
        stamp = tracks.header.stamp
        assert stamp.sec + stamp.nanosec * 1e-9 == pytest.approx(state.stamp_s, abs=1e-6)
        (track,) = tracks.tracks
        assert (track.name, track.query, track.visible) == ("handle", 0, True)
        assert (track.state, track.alarm, track.p_lost) == (0, False, pytest.approx(float(state.lost_p[0])))
        np.testing.assert_allclose((track.x_px, track.y_px), state.uv_px[0] - 0.5, atol=1e-4)
        assert state.cam_from_world is not None
        point = move(state.cam_from_world, state.point_world[0].astype(np.float64))
        np.testing.assert_allclose((track.point.x, track.point.y, track.point.z), point, atol=1e-6)
        assert track.joint.kind == {None: 0, "static": 1}[getattr(state.joint[0], "kind", None)]
        JAZZY.serialise(answer.markers)
        pixel = source.camera.matrix @ point
        np.testing.assert_allclose(pixel[:2] / pixel[2], state.uv_px[0], atol=0.01)
    assert statuses(tracking)["handle"][0] == "OK"
    assert statuses(tracking)["input"] == ("OK", f"{FRAMES} pictures tracked")


def test_compressed_colours_and_none_of_depth(tracker: Tracker, messages: Any, clip: Clip):
    tracking = Tracking(tracker, one_point(use_depth=False), JAZZY)
    jpeg = cv2.imencode(".jpg", clip.rgb[0][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    tracking.take_info(messages[0][1])
    header = next(message for topic, message, _ in messages if topic == COLOUR).header
    picture = JAZZY("sensor_msgs/msg/CompressedImage")(format="rgb8; jpeg compressed bgr8")
    picture.data.frombytes(jpeg)
    picture.header.stamp.sec, picture.header.frame_id = header.stamp.sec, COLOUR_FRAME
    tracking.take_colours(picture, START_NS)
    answer = tracking.step()
    assert answer is not None
    track = JAZZY.again(answer.tracks).tracks[0]
    assert (track.x_px, track.y_px) == pytest.approx((CLICK[0] - 0.5, CLICK[1] - 0.5))
    assert np.isnan(track.point.x)
    assert track.joint.kind == 0
    assert answer.markers.markers == []


def test_only_the_newest_picture_is_tracked_while_busy(tracking: Tracking, messages: Any):
    for sent in messages:
        feed(tracking, sent)
    answer = tracking.step()
    assert answer is not None
    assert tracking.step() is None
    assert answer.tracks.dropped == FRAMES - 1
    last = [message for topic, message, _ in messages if topic == COLOUR][-1]
    assert answer.tracks.header.stamp.nanosec == last.header.stamp.nanosec
    diagnostics = tracking.diagnostics(START_NS)
    assert diagnostics is not None
    values = {each.key: each.value for each in diagnostics.status[0].values}
    assert values["dropped while busy"] == str(FRAMES - 1)


def test_a_bag_that_loops_begins_a_new_stream_and_a_late_picture_is_left_out(tracking: Tracking, messages: Any):
    first = run(tracking, shifted(messages[:6], 3))
    again = run(tracking, messages[:6])
    assert [answer.tracks.stream for answer in first + again] == [0, 0, 1, 1]
    assert again[0].tracks.frame == 0
    told = [notice.text for notice in tracking.notices() if notice.level == "WARN"]
    assert any("time jumped back by" in text and "new stream" in text for text in told)
    assert all(answer.tracks.has_depth for answer in again)
    assert len(run(tracking, messages[1:2] + messages[6:9])) == 1
    assert statuses(tracking)["input"][0] == "WARN"
    assert "late: 1 picture" in statuses(tracking)["input"][1]


def wrong_pictures(message: Any) -> dict[str, tuple[Any, str]]:
    half = changed(message, height=message.height // 2)
    return {
        "depth as colours": (changed(message, encoding="16UC1"), "not one of colours"),
        "unknown encoding": (changed(message, encoding="nv99"), "'nv99'"),
        "too few bytes": (changed(message, data=message.data[:100]), "100 bytes"),
        "of another size": (half, "640 x 240"),
        "empty": (changed(message, height=0, width=0, data=message.data[:0]), "0 x 0"),
    }


def test_wrong_pictures_are_errors_in_the_diagnostics_and_the_next_one_is_tracked(tracking: Tracking, messages: Any):
    run(tracking, messages[:3])
    feed(tracking, messages[5])  # depth is there already
    for picture, words in wrong_pictures(messages[4][1]).values():
        feed(tracking, (COLOUR, picture, START_NS))
        assert tracking.step() is None
        level, message = statuses(tracking)["input"]
        assert level == "ERROR"
        assert words in message
    answers = run(tracking, messages[6:9])
    assert answers[0].tracks.frame == 1
    assert statuses(tracking)["input"][0] == "OK"
    errors = [notice for notice in tracking.notices() if notice.level == "ERROR"]
    assert len(errors) == 5  # each is logged once


def test_camera_info_that_is_missing_or_wrong(tracking: Tracking, messages: Any):
    info, colours, depth = messages[:3]
    assert run(tracking, [colours, depth]) == []
    assert "no camera_info" in statuses(tracking)["input"][1]
    broken = {"never calibrated": np.zeros(9), "finite": info[1].k * np.nan}
    for k in broken.values():
        assert run(tracking, [(COLOUR_INFO, changed(info[1], k=k), 0), colours, depth]) == []
        assert statuses(tracking)["input"][0] == "ERROR"
    assert len(run(tracking, messages[3:6])) == 1
    nan = (COLOUR_INFO, changed(info[1], k=info[1].k * np.nan), 0)
    assert len(run(tracking, [nan, *messages[7:9]])) == 1  # the stream has its camera already
    assert statuses(tracking)["input"][0] == "WARN"


def test_depth_that_cannot_be_used_leaves_the_colours(tracking: Tracking, messages: Any):
    info, colours, depth = messages[:3]
    metres = np.frombuffer(depth[1].data, np.uint16).astype(np.float32)  # millimetres that say to be metres
    as_float = changed(depth[1], encoding="32FC1", step=640 * 4, data=np.frombuffer(metres.tobytes(), np.uint8))
    answers = run(tracking, [info, colours, (DEPTH, as_float, START_NS)])
    assert not answers[0].tracks.has_depth
    assert "depth is not used" in statuses(tracking)["input"][1]
    assert "in the median" in statuses(tracking)["input"][1]
    strange = changed(messages[5][1], encoding="rgb8")
    assert not run(tracking, [*messages[3:5], (DEPTH, strange, START_NS)])[0].tracks.has_depth
    assert "'rgb8'" in statuses(tracking)["input"][1]
    small = changed(messages[8][1], width=320)
    assert not run(tracking, [*messages[6:8], (DEPTH, small, START_NS)])[0].tracks.has_depth
    holes = np.where(metres > np.median(metres), np.float32(np.nan), metres / 1000)
    fine = changed(messages[11][1], encoding="32FC1", step=640 * 4, data=np.frombuffer(holes.tobytes(), np.uint8))
    assert run(tracking, [*messages[9:11], (DEPTH, fine, START_NS)])[0].tracks.has_depth


def test_without_depth_in_time_a_picture_waits_half_a_second(tracking: Tracking, messages: Any):
    first, later = messages[1], shifted(messages[4:5], 1)[0]
    assert run(tracking, [messages[0], first]) == []
    answers = run(tracking, [later])
    assert [answer.tracks.has_depth for answer in answers] == [False]
    assert "no depth within 0.02 s" in statuses(tracking)["input"][1]


def test_pictures_of_another_size_begin_a_new_stream_once_camera_info_says_so(
    tracker: Tracker, messages: Any, clip: Clip
):
    tracking = Tracking(tracker, Settings(discover=False, use_depth=False), JAZZY)
    assert len(run(tracking, messages[:2])) == 1
    colours, info = messages[4][1], messages[3][1]
    halved = np.ascontiguousarray(clip.rgb[1][::2, ::2])
    small = changed(colours, width=320, height=240, step=960, data=halved.ravel())
    assert run(tracking, [(COLOUR, small, 0)]) == []
    k = info.k * np.array([0.5] * 6 + [1] * 3)
    told = changed(info, width=320, height=240, k=k)
    answers = run(tracking, [(COLOUR_INFO, told, 0), (COLOUR, changed(small, header=messages[7][1].header), 0)])
    assert [answer.tracks.stream for answer in answers] == [1]


def test_answers_in_the_world_frame_follow_tf(tracker: Tracker, messages: Any, bag: Path):
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    world_from_camera[:3, 3] = (1, 2, 3)
    tracking = Tracking(tracker, one_point(world_frame="map"), JAZZY)
    assert run(tracking, messages[:3]) == []
    assert "no tf joins" in statuses(tracking)["input"][1]
    for t in (0, 1):  # between them is the picture
        fields = transform("map", COLOUR_FRAME, world_from_camera, START_NS + t * SECOND)["transforms"][0]
        tracking.take_transforms(_transforms(fields), START_NS, static=False)
    answer = run(tracking, messages[3:6])[0]
    assert answer.tracks.header.frame_id == "map"
    frame = next(iter(open_recording(str(bag))))
    assert frame.depth_m is not None
    track = answer.tracks.tracks[0]
    depth_m = float(frame.depth_m[int(CLICK[1]), int(CLICK[0])])
    camera = open_recording(str(bag)).camera
    seen = np.array([(CLICK[0] - camera.cx) / camera.fx, (CLICK[1] - camera.cy) / camera.fy, 1]) * depth_m
    expected = move(world_from_camera, seen)
    np.testing.assert_allclose((track.point.x, track.point.y, track.point.z), expected, atol=0.02)


def _transforms(fields: dict[str, Any]) -> Any:
    stamped = JAZZY("geometry_msgs/msg/TransformStamped")(child_frame_id=fields["child_frame_id"])
    stamped.header.frame_id = fields["header"]["frame_id"]
    stamped.header.stamp.sec = fields["header"]["stamp"]["sec"]
    for part, values in fields["transform"].items():
        for name, value in values.items():
            setattr(getattr(stamped.transform, part), name, float(value))
    return JAZZY("tf2_msgs/msg/TFMessage")(transforms=[stamped])


def test_requests(tracker: Tracker, messages: Any):
    tracking = Tracking(tracker, Settings(discover=False), JAZZY)

    def ask(service: str, method: Any, **fields: Any) -> Any:
        request, response = (JAZZY(f"quest_msgs/srv/{service}_{half}")() for half in ("Request", "Response"))
        for name, value in fields.items():
            setattr(request, name, value)
        answered = method(request, response)
        JAZZY.serialise(answered)
        return answered

    x, y = CLICK[0] - 0.5, CLICK[1] - 0.5
    early = ask("AddQuery", tracking.add, kind=1, x_px=x, y_px=y)
    assert (early.success, early.query) == (False, -1)
    assert "no picture" in early.message
    assert run(tracking, messages[:3])[0].tracks.tracks == []
    added = ask("AddQuery", tracking.add, kind=1, x_px=x, y_px=y, name="mine", label="handle")
    assert (added.success, added.query) == (True, 0)
    assert ask("AddQuery", tracking.add, kind=2, label="knob", intent="open", name="a knob").success
    assert ask("AddQuery", tracking.add, kind=3, text="the left handle").success
    for name in ("a knob", "the left handle"):  # which would look for them
        assert ask("RetireQuery", tracking.retire, name=name, query=-1).success
    for wrong in (
        {"kind": 0}, {"kind": 1, "x_px": np.nan}, {"kind": 1, "x_px": 9999.0}, {"kind": 2, "label": "lid"},
        {"kind": 3, "text": ""}, {"kind": 1, "x_px": x, "y_px": y, "name": "mine"},
    ):  # fmt: skip
        refused = ask("AddQuery", tracking.add, **wrong)
        assert not refused.success
        assert refused.message
    assert ask("RenameQuery", tracking.rename, query=-1, name="mine", new_name="yours").success
    (track,) = run(tracking, messages[3:6])[0].tracks.tracks
    assert (track.name, track.label) == ("yours", "handle")
    assert (track.x_px, track.y_px) == pytest.approx((x, y))
    assert ask("AnswerAlarm", tracking.answer_alarm, answer=1, query=0).success
    assert ask("AnswerAlarm", tracking.answer_alarm, answer=2, query=0, x_px=x + 3, y_px=y).success
    assert not ask("AnswerAlarm", tracking.answer_alarm, answer=0, query=0).success
    assert not ask("RetireQuery", tracking.retire, query=-1, name="mine").success
    assert ask("RetireQuery", tracking.retire, query=0).success
    assert run(tracking, messages[6:9])[0].tracks.tracks == []
    assert tracking.reset(None, JAZZY("std_srvs/srv/Trigger_Response")()).success
    assert run(tracking, messages[9:12])[0].tracks.stream == 1


def test_a_query_that_cannot_be_followed_is_told_and_the_others_are_followed(tracker: Tracker, messages: Any):
    tracking = Tracking(tracker, Settings(points=("9999,3,far", "449.5,227.5,near")), JAZZY)
    answer = run(tracking, messages[:3])[0]
    assert [track.name for track in answer.tracks.tracks] == ["near"]
    assert any("far" in notice.text for notice in tracking.notices() if notice.level == "ERROR")


@pytest.mark.slow
def test_labels_of_the_parameters(tracker: Tracker, messages: Any, bag: Path):
    settings = Settings.from_parameters({**vars(Settings()), "labels": ["handle:open", ""], "online_s": 1})
    answers = run(Tracking(tracker, settings, JAZZY), messages[:3])
    frame, camera = next(iter(open_recording(str(bag)))), open_recording(str(bag)).camera
    stream = tracker.stream(camera, None, online=1.0)
    stream.add(Query.semantic("handle", intent="open"))
    state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s)
    (track,) = answers[0].tracks.tracks
    assert (track.name, track.label) == (state.names[0], "handle")
    np.testing.assert_allclose((track.x_px, track.y_px), state.uv_px[0] - 0.5, atol=1e-4)


def test_parameters_that_cannot_be():
    for name, value, words in (
        ("alpha", 1.5, "between 0 and 1"), ("sync_s", -0.1, "not negative"), ("online_s", np.nan, "not negative"),
        ("image_transport", "theora", "raw or compressed"), ("labels", ["lid"], "'lid' is unknown"),
        ("points", ["4"], "X,Y"), ("weights", 3, "expected str"), ("use_depth", "yes", "expected bool"),
        ("marker_m", 0, "above 0"),
    ):  # fmt: skip
        with pytest.raises(QuestError, match=name.rstrip("s")) as caught:
            Settings.from_parameters({**vars(Settings()), name: value})
        assert words in str(caught.value)


class Told:
    """A tracker that answers what it is told to; an exception is raised."""

    def __init__(self, states: list[Any], stream: Any) -> None:
        self.config, self.states, self.inner, self.frame = None, iter(states), stream, 0

    def stream(self, *_: Any, **__: Any) -> Told:
        return self

    def step(self, *_: Any) -> StreamState:
        self.frame += 1
        state = next(self.states)
        if isinstance(state, Exception):
            raise state
        return state

    def add(self, query: Query) -> int:
        return 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


def told_to(states: list[Any], stream: Any) -> Any:
    return Told(states, stream)  # a tracker as far as types go


@pytest.fixture(scope="module")
def seen(tracker: Tracker, clip: Clip) -> tuple[StreamState, Any]:
    """An answer of the tracker, and its stream."""
    stream = tracker.stream(clip.camera, [Query.point(0, *CLICK, name="handle")])
    frame = clip.frame(0)
    return stream.step(frame.rgb, frame.depth_m, 0.0), stream


@pytest.mark.parametrize("distribution", ["humble", "jazzy"])
def test_alarms_and_joints(seen: tuple[StreamState, Any], messages: Any, distribution: str):
    types, (state, stream) = types_of(distribution), seen
    turn = Joint(
        JointKind.REVOLUTE, np.array([0.0, 1, 0]), np.array([0.1, 0.2, 0.3]), np.array([0.6, 0.2, 0.3]), 0.0, 0.5,
        np.diag([0.01, 0.02, 0.03, 0.04]),
    )  # fmt: skip
    alarm = Alarm("handle", 0, 1, float(START_NS * 1e-9), 7.9, 6.2, 0.05, "not seen for 1.2 s", True)
    moved = np.eye(4)
    moved[:3, 3] = (0, 0, 1)
    opened = replace(state, joint=(turn,), q=np.array([0.4], np.float32), cam_from_world=moved)
    lost = replace(opened, alarm=(alarm,), state=(State.LOST,), visible=np.array([False]))
    held = replace(opened, state=(State.HELD,), visible=np.array([False]), flags=("covered: nothing stands out",))
    gone = opened.only([])
    tracking = Tracking(told_to([opened, lost, held, gone], stream), one_point(), types)

    answers = [run(tracking, messages[:3])[0]]
    assert statuses(tracking, types)["handle"][0] == "OK"
    assert tracking.diagnostics(START_NS, news=True) is None
    joint = types.again(answers[0].tracks).tracks[0].joint
    assert (joint.kind, joint.coordinate, joint.lower, joint.upper) == (3, pytest.approx(0.4), 0.0, 0.5)
    assert (joint.axis.y, joint.origin.z) == (1.0, pytest.approx(1.3))
    covariance = joint.covariance.reshape(6, 6)
    np.testing.assert_allclose(np.trace(covariance[:3, :3]), 0.03)
    np.testing.assert_allclose(np.trace(covariance[3:, 3:]), 0.07)
    shown = {(marker.ns, marker.action) for marker in types.again(answers[0].markers).markers}
    assert shown == {("points", 0), ("names", 0), ("joints", 0)}

    answers += run(tracking, messages[3:6])
    track = types.again(answers[1].tracks).tracks[0]
    assert (track.alarm, track.alarm_reason, track.state) == (True, "not seen for 1.2 s", 2)
    assert track.alarm_stamp.sec == START_NS // SECOND
    assert track.alarm_extrapolated
    assert tracking.diagnostics(START_NS, news=True) is not None
    assert statuses(tracking, types)["handle"] == ("ERROR", "alarm: not seen for 1.2 s")
    assert [notice.text for notice in tracking.notices() if notice.level == "WARN"] == [
        "alarm of handle: not seen for 1.2 s"
    ]

    answers += run(tracking, messages[6:9])
    assert statuses(tracking, types)["handle"][0] == "WARN"
    assert statuses(tracking, types)["tracker"] == ("WARN", "covered: nothing stands out")
    answers += run(tracking, messages[9:12])
    assert {marker.action for marker in types.again(answers[3].markers).markers} == {2}


def test_an_error_of_the_program_is_told_and_the_next_picture_is_tracked(seen: Any, messages: Any):
    state, stream = seen
    tracking = Tracking(told_to([ZeroDivisionError("oh"), state], stream), one_point(), JAZZY)
    assert run(tracking, messages[:3]) == []
    assert statuses(tracking)["input"] == ("ERROR", "ZeroDivisionError: oh")
    assert "Traceback" in next(notice.text for notice in tracking.notices() if notice.level == "ERROR")
    assert len(run(tracking, messages[3:6])) == 1


def test_silence_is_told(seen: Any, messages: Any):
    state, stream = seen
    tracking = Tracking(told_to([state], stream), one_point(), JAZZY, topic="/front/image")
    assert statuses(tracking) == {
        "input": ("WARN", "no pictures on /front/image yet"),
        "tracker": ("WARN", "no stream yet"),
    }
    run(tracking, messages[:3])
    assert statuses(tracking)["input"][0] == "OK"
    assert "for 10 s" in statuses(tracking, now_ns=START_NS + 10 * SECOND)["input"][1]
