"""The baselines: what they answer, what they refuse, what they say about missing depth."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from quest.baselines.hold_still import HoldStill
from quest.baselines.lucas_kanade import LucasKanade
from quest.baselines.point_queries import hold_last, lift_pixels
from quest.errors import ConfigError, InputError
from quest.types import Camera, Clip, Query, State, Take
from tests.synthetic import make_take

BASELINES = [HoldStill(), LucasKanade()]


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=40, views=2, entities=2, size=(160, 120))


@pytest.fixture
def shift_clip() -> Clip:
    """A texture that moves by (1.5, -0.75) pixels a frame, at 2 m."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, size=(200, 200, 3)).astype(np.float32), (0, 0), 3)
    image = np.clip((image - image.mean()) * 6 + 128, 0, 255)
    rgb = []
    for t in range(12):
        move = np.array([[1, 0, 1.5 * t - 40], [0, 1, -0.75 * t - 40]], dtype=np.float32)
        rgb.append(cv2.warpAffine(image, move, (96, 96)).astype(np.uint8))
    return Clip(
        "shift",
        Camera(100.0, 100.0, 48.0, 48.0, 96, 96),
        np.stack(rgb),
        np.full((12, 96, 96), 2.0, dtype=np.float32),
        np.arange(12) / 30.0,
        np.tile(np.eye(4), (12, 1, 1)),
    )


def test_lucas_kanade_follows_a_known_shift(shift_clip: Clip) -> None:
    tracks = LucasKanade().track(shift_clip, [Query.point(0, 40.5, 50.25), Query.point(4, 30.0, 60.0)])
    for k, (first, start) in enumerate([(0, (40.5, 50.25)), (4, (30.0, 60.0))]):
        steps = np.arange(12 - first)[:, None]
        np.testing.assert_allclose(tracks.uv_px[first:, k], start + steps * [1.5, -0.75], atol=0.3)
        assert np.isnan(tracks.uv_px[:first, k]).all()
        x_m = (tracks.uv_px[first:, k, 0] - 48.0) / 100.0 * 2.0
        np.testing.assert_allclose(tracks.point_world[first:, k, 0], x_m, atol=1e-5)
    assert (tracks.state[4:] == State.TRACKING).all()


def test_lucas_kanade_holds_a_point_that_leaves_the_image(shift_clip: Clip) -> None:
    tracks = LucasKanade().track(shift_clip, [Query.point(0, 88.0, 50.0)])
    lost = np.flatnonzero(~tracks.visible[:, 0])
    assert len(lost)
    first = lost[0]
    assert (tracks.state[first:, 0] == State.LOST).all()
    assert (tracks.confidence[first:, 0] == 0).all()
    np.testing.assert_array_equal(tracks.uv_px[first:, 0], np.tile(tracks.uv_px[first - 1, 0], (12 - first, 1)))
    last_m = tracks.point_world[first - 1, 0]
    np.testing.assert_array_equal(tracks.point_world[first:, 0], np.tile(last_m, (12 - first, 1)))


def test_lucas_kanade_beats_hold_still_on_moving_panels(take: Take) -> None:
    view = take.views[0]
    queries = [Query.point(0, *map(float, view.uv_px[0, e])) for e in range(2)]
    error = {}
    for tracker in BASELINES:
        tracks = tracker.track(view.clip, queries)
        np.testing.assert_allclose(tracks.point_world[0], take.point_world[0], atol=0.01)
        error[tracker.name] = np.linalg.norm(tracks.point_world - take.point_world, axis=-1).mean()
    assert error["lk"] < 0.5 * error["hold-still"]


def test_hold_still_holds_the_first_position(take: Take) -> None:
    view = take.views[1]
    tracks = HoldStill().track(view.clip, [Query.point(5, 80.0, 60.0, name="a", label="knob")])
    assert np.isnan(tracks.uv_px[:5]).all()
    np.testing.assert_allclose(tracks.uv_px[5:, 0], np.tile([80.0, 60.0], (35, 1)), atol=1e-3)
    assert np.ptp(tracks.point_world[5:, 0], axis=0).max() == 0
    assert (tracks.names, tracks.labels) == (("a",), ("knob",))


def test_hold_still_is_still_in_the_world_when_the_camera_moves(shift_clip: Clip) -> None:
    pose = shift_clip.cam_from_world.copy()
    pose[:, 0, 3] = 0.02 * np.arange(12)
    tracks = HoldStill().track(dataclasses.replace(shift_clip, cam_from_world=pose), [Query.point(0, 48.0, 48.0)])
    assert np.ptp(tracks.point_world[:, 0], axis=0).max() == 0
    np.testing.assert_allclose(tracks.uv_px[:, 0, 0], 48.0 + np.arange(12), atol=1e-3)


@pytest.mark.parametrize("tracker", BASELINES, ids=lambda t: t.name)
def test_without_depth_there_are_pixels_but_no_points(take: Take, tracker: HoldStill | LucasKanade) -> None:
    clip = dataclasses.replace(take.views[0].clip, depth_m=None)
    tracks = tracker.track(clip, [Query.point(0, 80.0, 60.0)])
    assert np.isnan(tracks.point_world).all()
    assert np.isfinite(tracks.uv_px).all()
    assert any("without depth" in flag for flag in tracks.frame_flags)


@pytest.mark.parametrize("tracker", BASELINES, ids=lambda t: t.name)
def test_missing_depth_at_the_query_is_flagged(take: Take, tracker: HoldStill | LucasKanade) -> None:
    clip = take.views[0].clip
    assert clip.depth_m is not None
    depth_m = clip.depth_m.copy()
    depth_m[0, 50:70, 70:90] = 0
    holed = dataclasses.replace(clip, depth_m=depth_m)
    tracks = tracker.track(holed, [Query.point(0, 80.0, 60.0, name="drawer"), Query.point(0, 10.0, 10.0)])
    assert np.isnan(tracks.point_world[0, 0]).all()
    assert np.isfinite(tracks.point_world[:, 1]).all()
    assert len(tracks.frame_flags) == 1
    assert "'drawer'" in tracks.frame_flags[0]


@pytest.mark.parametrize("tracker", BASELINES, ids=lambda t: t.name)
@pytest.mark.parametrize("queries", [None, [Query.slot()], [Query.point(0, 5.0, 5.0), Query.semantic("knob")]])
def test_only_point_queries(take: Take, tracker: HoldStill | LucasKanade, queries: list[Query] | None) -> None:
    with pytest.raises(ConfigError, match="this tracker follows given points"):
        tracker.track(take.views[0].clip, queries)


@pytest.mark.parametrize("tracker", BASELINES, ids=lambda t: t.name)
@pytest.mark.parametrize("query", [Query.point(40, 5.0, 5.0), Query.point(0, 161.0, 5.0), Query.point(0, 5.0, -1.0)])
def test_queries_outside_the_clip(take: Take, tracker: HoldStill | LucasKanade, query: Query) -> None:
    with pytest.raises(InputError, match="expected a"):
        tracker.track(take.views[0].clip, [query])


@pytest.mark.parametrize("tracker", BASELINES, ids=lambda t: t.name)
def test_no_query_gives_no_track(take: Take, tracker: HoldStill | LucasKanade) -> None:
    assert tracker.track(take.views[0].clip, []).uv_px.shape == (40, 0, 2)


def test_lift_pixels_takes_the_median_and_minds_the_border(shift_clip: Clip) -> None:
    assert shift_clip.depth_m is not None
    depth_m = shift_clip.depth_m.copy()
    depth_m[:, 20, 20], depth_m[:, 19, 20], depth_m[:, 21, 20] = 9.0, 0.0, np.nan
    clip = dataclasses.replace(shift_clip, depth_m=depth_m)
    uv_px = np.tile(np.array([[20.5, 20.5], [96.0, 96.0], [97.0, 5.0], [np.nan, 1.0]], dtype=np.float32), (12, 1, 1))
    z_m = lift_pixels(clip, uv_px)[..., 2]
    np.testing.assert_array_equal(z_m[:, :2], 2.0)
    assert np.isnan(z_m[:, 2:]).all()


def test_hold_last() -> None:
    nan = np.nan
    point = np.array([[nan, 5], [1, 6], [nan, nan], [3, nan]])[..., None]
    held = hold_last(point, first=np.array([0, 1]))[..., 0]
    np.testing.assert_array_equal(held, [[nan, nan], [1, 6], [1, 6], [3, 6]])
