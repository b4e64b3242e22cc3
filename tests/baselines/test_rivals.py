"""Plain rivals on pictures whose motion is known: what they answer, refuse, and say about missing depth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from quest.baselines import ClipTracker
from quest.baselines.chained import (
    SEARCH_PX,
    DenseFlow,
    LucasKanade,
    LucasKanadeAgain,
    LucasKanadeGrid,
    checked_flow,
    flow,
)
from quest.baselines.hold_still import HoldStill, StillWorld, camera_poses
from quest.baselines.point_queries import hold_last, lift_pixels
from quest.errors import ConfigError, InputError
from quest.types import Camera, Clip, Query, State

STEP_PX = np.array([1.5, -0.75])
FRAMES = 10


@pytest.fixture
def shift_clip() -> Clip:
    """A textured wall at 2 m that a camera passes: all moves by (1.5, -0.75) pixels a frame."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, size=(260, 260, 3)).astype(np.float32), (0, 0), 3)
    image = np.clip((image - image.mean()) * 6 + 128, 0, 255)
    shift = STEP_PX * np.arange(FRAMES)[:, None]
    rgb = [
        cv2.warpAffine(image, np.array([[1, 0, x - 40], [0, 1, y - 40]], np.float32), (128, 128)).astype(np.uint8)
        for x, y in shift
    ]
    pose = np.tile(np.eye(4), (FRAMES, 1, 1))
    pose[:, :2, 3] = shift / 100.0 * 2.0
    depth_m = np.full((FRAMES, 128, 128), 2.0, dtype=np.float32)
    return Clip(
        "shift", Camera(100.0, 100.0, 64.0, 64.0, 128, 128), np.stack(rgb), depth_m, np.arange(FRAMES) / 30, pose
    )


QUERIES = [Query.point(0, 50.5, 60.25), Query.point(4, 70.0, 80.0)]


def expected(query: Query) -> np.ndarray:
    assert query.uv_px is not None
    return query.uv_px + STEP_PX * np.arange(FRAMES - query.frame)[:, None]


@pytest.mark.parametrize("tracker", [LucasKanade(), LucasKanadeGrid(), LucasKanadeAgain(), DenseFlow()])
def test_chained_flow_follows_a_known_shift(shift_clip: Clip, tracker: LucasKanade) -> None:
    tracks = tracker.track(replace(shift_clip, cam_from_world=np.tile(np.eye(4), (FRAMES, 1, 1))), QUERIES)
    for k, query in enumerate(QUERIES):
        asked = slice(query.frame, None)
        np.testing.assert_allclose(tracks.uv_px[asked, k], expected(query), atol=0.7)
        x_m = (tracks.uv_px[asked, k, 0] - 64.0) / 100.0 * 2.0
        np.testing.assert_allclose(tracks.point_world[asked, k, 0], x_m, atol=1e-5)
        assert np.isnan(tracks.uv_px[: query.frame, k]).all()
        assert (tracks.state[asked, k] == State.TRACKING).all()
        assert not tracks.visible[: query.frame, k].any()


def test_a_point_that_leaves_the_image_is_held(shift_clip: Clip) -> None:
    tracks = LucasKanade().track(shift_clip, [Query.point(0, 122.0, 80.0)])
    first = int(np.flatnonzero(~tracks.visible[:, 0])[0])
    assert (tracks.state[first:, 0] == State.LOST).all()
    assert (tracks.confidence[first:, 0] == 0).all()
    for answer in (tracks.uv_px, tracks.point_world):
        np.testing.assert_array_equal(answer[first:, 0], np.tile(answer[first - 1, 0], (FRAMES - first, 1)))


@pytest.mark.parametrize("tracker", [HoldStill(), LucasKanade()], ids=lambda t: t.name)
def test_missing_depth_is_told_and_odd_queries_are_refused(shift_clip: Clip, tracker: ClipTracker) -> None:
    blind = tracker.track(replace(shift_clip, depth_m=None), [Query.point(0, 80.0, 60.0)])
    assert np.isnan(blind.point_world).all()
    assert np.isfinite(blind.uv_px).all()
    assert any("without depth" in flag for flag in blind.frame_flags)
    assert shift_clip.depth_m is not None
    depth_m = shift_clip.depth_m.copy()
    depth_m[0, 50:70, 70:90] = 0
    queries = [Query.point(0, 80.0, 60.0, name="drawer", label="knob"), Query.point(0, 10.0, 20.0)]
    tracks = tracker.track(replace(shift_clip, depth_m=depth_m), queries)
    assert (tracks.names, tracks.labels) == (("drawer", "point-1"), ("knob", None))
    assert np.isnan(tracks.point_world[0, 0]).all()
    assert np.isfinite(tracks.point_world[:, 1]).all()
    assert len(tracks.frame_flags) == 1
    assert "'drawer'" in tracks.frame_flags[0]
    for asked in (None, [Query.slot()], [Query.point(0, 5.0, 5.0), Query.semantic("knob")]):
        with pytest.raises(ConfigError, match="this tracker follows given points"):
            tracker.track(shift_clip, asked)
    for query in (Query.point(FRAMES, 5.0, 5.0), Query.point(0, 129.0, 5.0), Query.point(0, 5.0, -1.0)):
        with pytest.raises(InputError, match="expected a"):
            tracker.track(shift_clip, [query])
    assert tracker.track(shift_clip, []).uv_px.shape == (FRAMES, 0, 2)


def test_lift_pixels_takes_the_median_and_minds_the_border(shift_clip: Clip) -> None:
    assert shift_clip.depth_m is not None
    depth_m = shift_clip.depth_m.copy()
    depth_m[:, 20, 20], depth_m[:, 19, 20], depth_m[:, 21, 20] = 9.0, 0.0, np.nan
    clip = replace(shift_clip, depth_m=depth_m)
    places = np.array([[20.5, 20.5], [128.0, 128.0], [129.0, 5.0], [np.nan, 1.0]], dtype=np.float32)
    z_m = lift_pixels(clip, np.tile(places, (FRAMES, 1, 1)))[..., 2]
    np.testing.assert_array_equal(z_m[:, :2], 2.0)
    assert np.isnan(z_m[:, 2:]).all()


def test_hold_last() -> None:
    nan = np.nan
    point = np.array([[nan, 5], [1, 6], [nan, nan], [3, nan]])[..., None]
    held = hold_last(point, first=np.array([0, 1]))[..., 0]
    np.testing.assert_array_equal(held, [[nan, nan], [1, 6], [1, 6], [3, 6]])


def test_checked_flow_refuses_what_does_not_come_back(shift_clip: Clip) -> None:
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in shift_clip.rgb[:2]]
    covered = grey[1].copy()
    covered[40:100, 40:100] = np.random.default_rng(1).integers(0, 255, (60, 60))
    uv_px = np.array([[70.0, 70.0], [20.0, 20.0]], np.float32)
    end, good = checked_flow(grey[0], covered, uv_px)
    assert good.tolist() == [False, True]
    np.testing.assert_array_equal(end[1], flow(grey[0], covered, uv_px)[0][1])


def test_a_grid_that_is_covered_waits_and_goes_on(shift_clip: Clip) -> None:
    rgb = shift_clip.rgb.copy()
    rgb[3, 40:90, 40:90] = np.random.default_rng(2).integers(0, 255, (50, 50, 3))
    tracks = LucasKanadeGrid().track(replace(shift_clip, rgb=rgb), [Query.point(0, 60.0, 60.0)])
    assert tracks.state[3, 0] == State.LOST
    np.testing.assert_array_equal(tracks.uv_px[3, 0], tracks.uv_px[2, 0])
    np.testing.assert_array_equal(tracks.point_world[3, 0], tracks.point_world[2, 0])
    assert tracks.visible[6:, 0].all()


def occluded_clip(shift_clip: Clip, *, step_px: int) -> Clip:
    """A wall that moves on while a board of another texture is in front of it; board and wall part slowly."""
    rgb = np.repeat(shift_clip.rgb[:1], 14, axis=0)
    board = np.random.default_rng(3).integers(0, 255, (70, 70, 3))
    for t in range(14):
        rgb[t] = np.roll(shift_clip.rgb[0], step_px * t, axis=1)
        if 3 <= t < 9:
            rgb[t, 25:95, 30:100] = board
    poses, depth_m = np.tile(np.eye(4), (14, 1, 1)), np.full((14, 128, 128), 2.0, np.float32)
    return replace(shift_clip, rgb=rgb, depth_m=depth_m, stamp_s=np.arange(14) / 30, cam_from_world=poses)


def test_what_moved_behind_a_board_is_found_again_by_its_first_patch(shift_clip: Clip) -> None:
    clip = occluded_clip(shift_clip, step_px=5)
    where = np.add((40.5, 60.5), np.arange(14)[:, None] * (5, 0))
    tracks = LucasKanadeAgain().track(clip, [Query.point(0, 40.5, 60.5)])
    assert tracks.visible[:, 0].tolist() == [not 3 <= t < 9 for t in range(14)]
    off_px = np.linalg.norm(tracks.uv_px[:, 0] - where, axis=-1)
    assert off_px[tracks.visible[:, 0]].max() < 1
    np.testing.assert_array_equal(tracks.uv_px[3:9, 0], np.tile(tracks.uv_px[2, 0], (6, 1)))
    np.testing.assert_array_equal(tracks.point_world[8, 0], tracks.point_world[2, 0])
    for other in (LucasKanade(), LucasKanadeGrid()):
        assert np.linalg.norm(other.track(clip, [Query.point(0, 40.5, 60.5)]).uv_px[-1, 0] - where[-1]) > 10


def test_what_has_no_patch_or_is_far_away_is_not_found_again(shift_clip: Clip) -> None:
    grey = replace(shift_clip, rgb=np.full_like(shift_clip.rgb, 128))
    assert not LucasKanadeAgain().track(grey, [Query.point(0, 60.0, 60.0)]).visible[1:].any()
    far = shift_clip.rgb.copy()
    far[3:5] = 0
    far[5:] = np.roll(far[5:], SEARCH_PX - 15, axis=2)
    tracks = LucasKanadeAgain().track(replace(shift_clip, rgb=far), [Query.point(0, 30.0, 60.0)])
    assert not tracks.visible[3:5, 0].any()
    assert tracks.visible[5:, 0].all()
    np.testing.assert_allclose(tracks.uv_px[5, 0], (30 + 5 * 1.5 + SEARCH_PX - 15, 60 - 5 * 0.75), atol=1.5)


def test_a_still_world_needs_no_poses(shift_clip: Clip) -> None:
    unknown = replace(shift_clip, cam_from_world=np.tile(np.eye(4), (FRAMES, 1, 1)))
    np.testing.assert_allclose(camera_poses(unknown)[:, :3, 3], shift_clip.cam_from_world[:, :3, 3], atol=0.03)
    tracks = StillWorld().track(unknown, QUERIES)
    given = HoldStill("world-given").track(shift_clip, QUERIES)
    for k, query in enumerate(QUERIES):
        np.testing.assert_allclose(tracks.uv_px[query.frame :, k], expected(query), atol=1.5)
        np.testing.assert_allclose(given.uv_px[query.frame :, k], expected(query), atol=1e-3)
    assert np.ptp(tracks.point_world[:, 0], axis=0).max() == 0
    # Without depth nothing is known of the camera.
    blind = StillWorld().track(replace(shift_clip, depth_m=None), QUERIES)
    np.testing.assert_array_equal(blind.uv_px[:, 0], np.tile([50.5, 60.25], (FRAMES, 1)))


def test_a_camera_that_sees_nothing_keeps_its_pose(shift_clip: Clip) -> None:
    grey = replace(shift_clip, rgb=np.full_like(shift_clip.rgb, 128))
    poses = camera_poses(grey)
    np.testing.assert_array_equal(poses, np.tile(shift_clip.cam_from_world[0], (FRAMES, 1, 1)))


def test_what_is_still_is_hidden_by_nearer_depth_and_out_of_view(shift_clip: Clip) -> None:
    assert shift_clip.depth_m is not None
    depth_m = shift_clip.depth_m.copy()
    depth_m[5, 50:70, 50:80] = 1.0
    depth_m[6, 50:70, 50:80] = 0.0
    clip = replace(shift_clip, depth_m=depth_m)
    tracks = HoldStill().track(clip, [Query.point(0, 60.0, 64.0), Query.point(0, 120.0, 64.0)])
    assert tracks.visible[:, 0].tolist() == [t != 5 for t in range(FRAMES)]
    assert tracks.state[5, 0] == State.HELD
    inside = 120.0 + 1.5 * np.arange(FRAMES) < 128
    np.testing.assert_array_equal(tracks.visible[:, 1], inside)
