"""The tracker and its stream: what they promise whatever the weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.data.cut import cut_clip
from quest.data.recording import read_recording, write_recording
from quest.errors import ConfigError, InputError, WeightsError
from quest.model.weights import save_network
from quest.monitor import write_calibrations
from quest.track import Tracker, load
from quest.track.settings import REVISION, TrackerConfig
from quest.track.tracker import (
    NO_DEPTH_FLAG,
    NOTHING_FOUND_FLAG,
    PARTLY_NO_DEPTH_FLAG,
    PARTLY_WITHHELD_FLAG,
    WITHHELD_FLAG,
    collect,
    pick_device,
)
from quest.types import GUESSED_CAMERA, LABELS, Clip, Query, State, Tracks
from tests.tolerances import PIXEL, PIXEL_MOVED, POINT, POINT_MOVED
from tests.track.clips import EAGER, POINTS, feed, make_calibration, make_clip, make_tracker, moved_world, without_depth


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def assert_same(got: Tracks, expected: Tracks, *, atol: float = 1e-5) -> None:
    assert got.names == expected.names
    for name in ("uv_px", "point_world", "confidence"):
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), atol=atol, rtol=1e-4, err_msg=name)
    assert (got.visible == expected.visible).all()
    assert (got.state == expected.state).all()


def test_answers(clip: Clip):
    tracks = make_tracker().track(clip, POINTS)
    assert (tracks.names, tracks.labels) == (("a", "b"), (None, "knob"))
    assert tracks.uv_px.shape == (6, 2, 2)
    assert np.isfinite(tracks.uv_px).all()
    assert ((tracks.confidence > 0) & (tracks.confidence < 1)).all()
    assert set(tracks.state.flat) <= {s.value for s in State}
    assert tracks.stamp_s.tolist() == clip.stamp_s.tolist()
    assert tracks.frame_flags == ()


@pytest.mark.parametrize("queries", [POINTS, None], ids=["points", "discovery"])
def test_stream_equals_clip(queries: tuple[Query, ...] | None, clip: Clip):
    tracker = make_tracker()
    states = feed(tracker.stream(clip.camera, queries), clip, range(len(clip)))
    assert_same(collect(states, queries), tracker.track(clip, queries))


def test_the_future_is_not_used(clip: Clip):
    tracker = make_tracker()
    whole, start = tracker.track(clip, POINTS), tracker.track(cut_clip(clip, slice(0, 3)), POINTS)
    np.testing.assert_allclose(whole.uv_px[:3], start.uv_px, **PIXEL)
    np.testing.assert_allclose(whole.point_world[:3], start.point_world, **POINT)


@pytest.mark.parametrize("wrong", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_what_is_no_picture_is_refused(wrong: np.ndarray):
    with pytest.raises(InputError, match="uint8"):
        make_tracker().find(wrong)


def test_tracks_come_in_the_order_of_the_queries(clip: Clip):
    """Whenever they bind: evaluation takes answer k for query k."""
    tracker = make_tracker()
    label = next(label for label in tracker.find(clip.rgb[0]).labels if label in LABELS)
    asked = (Query.point(3, 20, 30), POINTS[0], Query.semantic(label), Query.point(1, 30, 30), POINTS[1])
    tracks = tracker.track(clip, asked)
    bound = np.all(np.isfinite(tracks.uv_px), axis=-1)
    first = [3, 0, 0, 1, 0]
    for k, t in enumerate(first):
        assert bound[:, k].tolist() == [f >= t for f in range(6)], k
        assert np.isnan(tracks.point_world[:t, k]).all()
        assert (tracks.confidence[:t, k] == 0).all()
        assert (tracks.state[:t, k] == State.LOST).all()
        assert not tracks.visible[:t, k].any()
    assert tracks.names[1] == "a"
    assert tracks.labels == (None, None, label, None, "knob")
    assert len(set(tracks.names)) == 5
    alone = make_tracker().track(clip, [POINTS[0]])
    assert np.abs(alone.uv_px[0, 0] - tracks.uv_px[0, 1]).max() < 64


def test_what_is_not_watched_has_no_alarms(clip: Clip):
    """None, which a file of tracks keeps apart from an alarm that is not open."""
    assert make_tracker().track(clip, POINTS).lost_p is None
    tracker = make_tracker(depth=make_calibration(alarming=False))
    unwatched, watched = (tracker.track(clip, POINTS, alpha=alpha) for alpha in (None, 0.1))
    assert unwatched.lost_p is unwatched.alarm is None
    assert watched.lost_p is not None
    assert watched.alarm is not None


@pytest.mark.parametrize("alarming", [False, True])
def test_without_a_calibration_for_colours_nothing_is_said_of_losses(clip: Clip, alarming: bool):
    tracker, dark = make_tracker(depth=make_calibration(alarming=alarming)), replace(clip, depth_m=None)
    tracks = tracker.track(dark, POINTS)
    assert tracks.lost_p is not None
    assert np.isnan(tracks.lost_p).all()
    assert tracks.alarm is not None
    assert not tracks.alarm.any()
    assert tracks.frame_flags == (NO_DEPTH_FLAG, WITHHELD_FLAG)
    assert_same(tracks, tracker.track(dark, POINTS, alpha=None))
    late = tracker.track(without_depth(clip, slice(0, 2)), POINTS)
    assert late.lost_p is not None
    assert np.isfinite(late.lost_p).all(axis=1).tolist() == [False] * 2 + [True] * 4
    assert PARTLY_WITHHELD_FLAG in late.frame_flags
    tracker.calibrations["colours"] = make_calibration(alarming=alarming)
    told = tracker.track(dark, POINTS)
    assert told.lost_p is not None
    assert np.isfinite(told.lost_p).all()
    assert told.frame_flags == (NO_DEPTH_FLAG,)


def test_a_stream_says_that_p_lost_is_withheld(clip: Clip):
    tracker, frame = make_tracker(depth=make_calibration(alarming=True)), clip.frame(0)
    assert WITHHELD_FLAG not in make_tracker().stream(clip.camera, POINTS).step(frame.rgb, None, 0.0).flags
    stream = tracker.stream(clip.camera, POINTS)
    state = stream.step(frame.rgb, None, 0.0)
    assert WITHHELD_FLAG in state.flags
    assert np.isnan(state.lost_p).all()
    again = tracker.restore(tracker.save(stream))
    for each in (stream, again):
        assert WITHHELD_FLAG in each.step(clip.rgb[1], None, 0.1).flags
        assert WITHHELD_FLAG not in each.step(frame.rgb, frame.depth_m, 0.2).flags


def test_whatever_can_be_read_can_be_tracked(clip: Clip, tmp_path: Path):
    write_recording(clip, tmp_path / "mine", rgb="png")
    tracker = make_tracker()
    assert_same(tracker.track(tmp_path / "mine", POINTS), tracker.track(read_recording(tmp_path / "mine"), POINTS))
    arrays = Clip.from_arrays(clip.rgb)
    for frames in (clip.rgb, torch.from_numpy(clip.rgb)):
        tracks = tracker.track(frames, POINTS)
        assert_same(tracks, tracker.track(arrays, POINTS))
        assert tracks.frame_flags[0] == GUESSED_CAMERA


def test_joints_of_a_clip(clip: Clip):
    tracker = make_tracker()
    tracks = tracker.track(clip, [*POINTS, Query.point(5, 3, 3)])
    joints = tracks.joints
    assert joints is not None
    assert joints.q.shape == (6, 3)
    for k, kind in enumerate(joints.kind):
        moves = kind in ("prismatic", "revolute")
        assert np.isfinite(joints.axis[k]).all() == moves
        assert np.isfinite(joints.q[:, k]).any() == moves
        assert np.isfinite([joints.q_min_seen[k], joints.q_max_seen[k]]).all() == moves
        assert np.isfinite(joints.covariance[k, 3:, 3:]).all() == (kind != "unknown")
    assert joints.select(np.array([1])).q.shape == (6, 1)
    dark = tracker.track(replace(clip, depth_m=None), POINTS).joints
    assert dark is not None
    assert dark.kind == ("unknown", "unknown")
    assert np.isnan(dark.covariance).all()


def test_answers_are_printed_in_few_lines(clip: Clip):
    tracker = make_tracker(replace(EAGER, prompt_threshold=1.0))
    assert repr(tracker) == "Tracker('quest', unnamed weights, on cpu, no monitor)"
    lines = repr(tracker.track(clip, [*POINTS, Query.semantic("knob")])).splitlines()
    assert lines[0] == "Tracks(6 frames, 3 queries)"
    assert lines[1].startswith("  a: seen in ")
    assert lines[3] == "  knob: not found"
    frame = clip.frame(0)
    state = repr(tracker.stream(clip.camera, POINTS).step(frame.rgb, None, 0.0)).splitlines()
    assert state[0] == "StreamState(0.000 s, 2 queries)"
    assert state[1].startswith("  a: ")
    assert state[3] == f"  note: {NO_DEPTH_FLAG}"


def test_what_is_no_query_is_refused(clip: Clip):
    for queries in (["handle"], "handle", POINTS[0], [(0, 3, 4)], [POINTS[0], POINTS[0]]):
        with pytest.raises(InputError, match=r"expected Query|called so already|queries"):
            make_tracker().track(clip, queries)  # type: ignore[arg-type]


def test_permuting_queries_permutes_tracks(clip: Clip):
    tracker, twin = make_tracker(), replace(POINTS[0], name="twin")
    tracks = tracker.track(clip, [*POINTS, twin, Query.point(0, 0, 0), Query.point(0, 64, 64)])
    assert np.isfinite(tracks.uv_px).all()
    np.testing.assert_allclose(tracks.uv_px[:, 0], tracks.uv_px[:, 2], **PIXEL)
    assert_same(tracker.track(clip, POINTS[::-1]), tracker.track(clip, POINTS).select([1, 0]), atol=1e-3)


def test_discovery(clip: Clip):
    tracks = make_tracker().track(clip)
    assert 1 <= len(tracks.names) <= EAGER.most
    assert len(set(tracks.names)) == len(tracks.names)
    assert set(tracks.labels) <= set(LABELS)
    assert np.isfinite(tracks.uv_px).all()


def test_discovery_that_finds_nothing(clip: Clip):
    blind = make_tracker(replace(EAGER, threshold=1.0))
    for queries, flags in ((None, (NOTHING_FOUND_FLAG,)), ([], ())):
        tracks = blind.track(clip, queries)
        assert tracks.uv_px.shape == (6, 0, 2)
        assert tracks.frame_flags == flags


def test_prompts(clip: Clip):
    asked = [Query.semantic("handle", "left"), Query.slot(), Query.semantic("handle")]
    tracks = make_tracker().track(clip, asked)
    found = np.all(np.isfinite(tracks.uv_px), axis=(0, 2))
    assert tracks.names[0] == "left"
    assert found[1]
    assert all(tracks.labels[k] == "handle" for k in (0, 2))
    first = tracks.uv_px[0, found]
    assert len(np.unique(first.round(2), axis=0)) == found.sum(), "every prompt has its own slot"


def test_a_label_that_is_not_there_is_lost_and_flagged(clip: Clip):
    tracks = make_tracker(replace(EAGER, prompt_threshold=1.0)).track(clip, [Query.semantic("knob"), POINTS[0]])
    assert (tracks.names, tracks.labels) == (("knob", "a"), ("knob", None))
    assert np.isnan(tracks.uv_px[:, 0]).all()
    assert (tracks.state[:, 0] == State.LOST).all()
    assert (tracks.confidence[:, 0] == 0).all()
    assert np.isfinite(tracks.uv_px[:, 1]).all()
    assert len(tracks.frame_flags) == 1
    assert "'knob'" in tracks.frame_flags[0]


def test_a_clip_without_depth(clip: Clip):
    for dark in (replace(clip, depth_m=None), without_depth(clip, slice(None))):
        tracks = make_tracker().track(dark, POINTS)
        assert tracks.frame_flags == (NO_DEPTH_FLAG,)
        assert np.isnan(tracks.point_world).all()
        assert np.isfinite(tracks.uv_px).all()
        assert np.isfinite(tracks.confidence).all()


@pytest.mark.parametrize("missing", [slice(0, 2), slice(2, 4), slice(5, 6)])
def test_depth_missing_in_some_frames(missing: slice, clip: Clip):
    tracks = make_tracker().track(without_depth(clip, missing), POINTS)
    begins = ("depth begins: 1 of 6 frames",) if missing.start == 0 else ()
    assert set(tracks.frame_flags) == {PARTLY_NO_DEPTH_FLAG, *begins}
    assert np.isfinite(tracks.uv_px).all()
    known = np.isfinite(tracks.point_world).all(axis=(1, 2))
    assert known.tolist() == [t >= 2 or missing.start > 0 for t in range(6)]


def test_bad_depth_is_missing_depth(clip: Clip):
    assert clip.depth_m is not None
    hole, rng = clip.depth_m.copy(), np.random.default_rng(0)
    hole[rng.random(hole.shape) < 0.2] = 0
    bad = hole.copy()
    bad[hole == 0] = rng.choice([np.nan, np.inf, -np.inf, -1.0], int((hole == 0).sum()))
    tracker = make_tracker()
    assert_same(tracker.track(replace(clip, depth_m=bad), POINTS), tracker.track(replace(clip, depth_m=hole), POINTS))


def test_world_points_follow_the_world(clip: Clip):
    """In another world frame the pixels stay and the points move along."""
    angle = 0.7
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    motion[:3, 3] = [3.0, -2.0, 0.5]
    tracker = make_tracker()
    here, there = tracker.track(clip, POINTS), tracker.track(moved_world(clip, motion), POINTS)
    np.testing.assert_allclose(there.uv_px, here.uv_px, **PIXEL_MOVED)
    np.testing.assert_allclose(there.point_world, here.point_world @ motion[:3, :3].T + motion[:3, 3], **POINT_MOVED)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"rgb": np.zeros((64, 32, 3), np.uint8)}, "32"),
        ({"rgb": np.zeros((64, 64), np.uint8)}, "uint8"),
        ({"rgb": np.zeros((64, 64, 3), np.float32)}, "float32"),
        ({"depth_m": np.zeros((32, 64), np.float32)}, "32"),
        ({"depth_m": np.zeros((64, 64), np.uint16)}, "units"),
        ({"cam_from_world": np.eye(3)}, "4 x 4"),
        ({"cam_from_world": np.full((4, 4), np.nan)}, "rigid"),
        ({"stamp_s": float("nan")}, "stamp"),
    ],
)
def test_bad_frames(changes: dict, named: str, clip: Clip):
    stream = make_tracker().stream(clip.camera, POINTS)
    with pytest.raises(InputError, match=named):
        feed(stream, clip, range(1), **{"cam_from_world": None, **changes})
    feed(stream, clip, range(1))


@pytest.mark.parametrize(
    ("query", "named"),
    [
        (Query.point(0, 65, 3), "65"),
        (Query.point(0, 3, -1), "-1"),
        (Query.point(6, 3, 3), "6 frames"),
    ],
)
def test_points_outside_the_clip(query: Query, named: str, clip: Clip):
    with pytest.raises(InputError, match=named):
        make_tracker().track(clip, [query])


def test_from_a_file(tmp_path: Path, clip: Clip):
    tracker = make_tracker()
    path = tmp_path / "net.safetensors"
    save_network(path, tracker.network, settings=EAGER.to_json(), about="")
    loaded = load(path, device="cpu")
    assert loaded.config == EAGER
    assert isinstance(loaded, Tracker)
    assert loaded.track(clip, POINTS).uv_px.shape == (6, 2, 2)
    save_network(path, tracker.network, settings='{"bias": "red"}', about="")
    with pytest.raises(WeightsError, match="settings"):
        load(path, device="cpu")


def test_a_monitor_of_another_filter_is_refused(tmp_path: Path):
    path, calibration = tmp_path / "net.safetensors", make_calibration(alarming=False)
    save_network(path, make_tracker().network, settings="{}", about="")
    monitor = tmp_path / "monitor.json"
    write_calibrations(monitor, {"depth": replace(calibration, revision=REVISION - 1)})
    with pytest.raises(WeightsError, match="quest calibrate"):
        load(path, monitor=monitor)
    assert load(path, monitor=False).calibrations == {}
    write_calibrations(monitor, {"depth": calibration})
    assert list(load(path, monitor=monitor).calibrations) == ["depth"]


@pytest.mark.parametrize("name", ["abacus", "cuda:99"])
def test_devices_that_are_not_there(name: str):
    with pytest.raises(ConfigError, match="cpu"):
        pick_device(name)


@pytest.mark.parametrize("name", ["size_px", "follow_px"])
def test_pictures_are_brought_to_a_size_that_fits_into_memory(name: str):
    with pytest.raises(ConfigError, match=f"expected {name} from 16 to 4096"):
        TrackerConfig(**{name: 10**9})
    with pytest.raises(WeightsError, match=f"expected {name}"):
        TrackerConfig.from_json(f'{{"{name}": 8}}')
