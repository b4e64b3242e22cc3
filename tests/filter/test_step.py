"""The filter on planes that slide: what rests, what moves, what is occluded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.types import Clip, Query
from tests.filter.scenes import FOCAL, WALL_M, Board, follow, scene
from tests.track.clips import make_tracker

FRAMES = 24
STILL = np.zeros(FRAMES)
AT = (70.0, 60.0)


def without_poses(clip: Clip) -> Clip:
    return replace(clip, cam_from_world=np.tile(np.eye(4), (len(clip), 1, 1)))


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize("depth", [True, False])
def test_what_rests_stays_in_the_world_while_the_camera_moves(posed: bool, depth: bool) -> None:
    camera_m = np.linspace(0, 0.4, FRAMES)
    clip = scene(camera_m, depth=depth)
    tracks = follow(clip if posed else without_poses(clip), [Query.point(0, *AT)])
    off = tracks.uv_px[:, 0] - np.stack([AT[0] - FOCAL * camera_m / WALL_M, np.full(FRAMES, AT[1])], axis=-1)
    assert np.abs(off).max() < 0.5
    assert tracks.visible.all()
    if depth:
        assert np.abs(tracks.point_world[:, 0] - tracks.point_world[0, 0]).max() < 0.01


LAGS = pytest.mark.xfail(
    reason="whether a patch slipped or its entity moved is told by looks alone: what slides is said to rest at first"
)


@pytest.mark.parametrize(
    ("stride", "depth"),
    [
        *((stride, False) for stride in (1, 2, 3)),
        pytest.param(1, True, marks=LAGS),
        (2, True),
        (3, True),
    ],
)
def test_what_moves_is_followed_and_what_rests_beside_it_stays(stride: int, depth: bool) -> None:
    way = np.stack([30 + 2.0 * np.arange(FRAMES), np.full(FRAMES, 40.0)], axis=-1)[::stride]
    clip = scene(STILL[::stride], Board(way, (50, 40), 1.7, seed=5), depth=depth)
    clip = replace(clip, stamp_s=stride * clip.stamp_s)
    tracks = follow(clip, [Query.point(0, 55.0, 60.0), Query.point(0, 140.0, 60.0)])
    np.testing.assert_allclose(tracks.uv_px[:, 0], way + np.array([25, 20]), atol=1.0)
    np.testing.assert_allclose(tracks.uv_px[:, 1], np.tile([140.0, 60.0], (len(way), 1)), atol=0.5)


def test_a_room_does_not_move_because_given_poses_err() -> None:
    camera_m = np.linspace(0, 0.4, 40)
    board_px = np.stack([100 - np.round(FOCAL * camera_m / 0.5), np.full(40, 20)], axis=-1)
    room = scene(camera_m, Board(board_px, (60, 70), 0.5, seed=3))
    assert room.cam_from_world is not None
    poses = room.cam_from_world.copy()
    poses[20:, 0, 3] += 0.04
    tracks = follow(replace(room, cam_from_world=poses), [Query.point(0, 120.0, 50.0), Query.point(0, 40.0, 60.0)])
    assert tracks.joints is not None
    assert tracks.joints.kind == ("static", "static")


def test_an_occluder_that_passes_takes_nothing_along() -> None:
    """The camera moves, so that its poses are taken from the clip."""
    camera_m = np.linspace(0, 0.2, FRAMES)
    way = np.stack([-60 + 10.0 * np.arange(FRAMES), np.full(FRAMES, 20.0)], axis=-1)
    tracks = follow(scene(camera_m, Board(way, (50, 80), 0.8, seed=6)), [Query.point(0, *AT)])
    there = np.stack([AT[0] - FOCAL * camera_m / WALL_M, np.full(FRAMES, AT[1])], axis=-1)
    covered = (way[:, 0] < there[:, 0] - 2) & (way[:, 0] + 50 > there[:, 0] + 2)
    assert not tracks.visible[covered, 0].any()
    assert tracks.visible[-5:, 0].all()
    np.testing.assert_allclose(tracks.uv_px[:, 0], there, atol=1.0)


def test_how_an_occluder_looks_does_not_tell_what_carries_what_is_behind_it() -> None:
    way = np.stack([np.where(np.arange(FRAMES) < 8, -200.0, 40.0), np.full(FRAMES, 20.0)], axis=-1)
    log_odds = []
    for seed in (1, 4):
        clip = scene(STILL, Board(way, (60, 80), 0.8, seed))
        stream = make_tracker().stream(clip.camera, [Query.point(0, *AT)])
        states = [stream.step(**vars(clip.frame(t))) for t in range(FRAMES)]
        assert stream.memory.filter is not None
        log_odds.append(float(stream.memory.filter.queries.log_odds[0, 0]))
        assert not any(state.visible[0] for state in states[8:])
        np.testing.assert_allclose(states[-1].point_world, states[0].point_world, atol=0.01)
    assert log_odds[0] == pytest.approx(log_odds[1], abs=0.01)
    assert log_odds[0] > 2


def test_what_was_covered_is_found_again_where_it_rests_without_depth() -> None:
    way = np.stack([-60 + 8.0 * np.arange(30), np.full(30, 20.0)], axis=-1)
    tracks = follow(scene(np.zeros(30), Board(way, (50, 80), 0.8, seed=6), depth=False), [Query.point(0, *AT)])
    np.testing.assert_allclose(tracks.uv_px[-3:, 0], np.tile(AT, (3, 1)), atol=1.0)
    assert tracks.visible[-3:, 0].all()


def test_depth_may_begin_while_layers_move() -> None:
    way = np.stack([10 + 2.0 * np.arange(FRAMES), np.full(FRAMES, 40.0)], axis=-1)
    clip = scene(STILL, Board(way, (50, 40), 1.7, seed=5))
    stream = make_tracker().stream(clip.camera, [Query.point(0, 140.0, 60.0), Query.point(15, 145.0, 100.0)])
    for t in range(len(clip)):
        frame = clip.frame(t)
        state = stream.step(frame.rgb, frame.depth_m if t >= 15 else None, frame.stamp_s)
    np.testing.assert_allclose(state.uv_px, [[140.0, 60.0], [145.0, 100.0]], atol=1.0)
    assert np.isfinite(state.point_world).all()


def test_queries_come_in_when_they_are_asked_for() -> None:
    clip = scene(np.linspace(0, 0.2, FRAMES))
    queries = [Query.point(5, 90.0, 50.0, name="late"), Query.point(0, *AT, name="first")]
    tracks = follow(clip, queries)
    assert tracks.names == ("late", "first")
    assert np.isnan(tracks.uv_px[:5, 0]).all()
    assert np.isfinite(tracks.uv_px[:, 1]).all()
    np.testing.assert_allclose(tracks.uv_px[5, 0], [90.0, 50.0])
    alone = follow(clip, queries[1:])
    np.testing.assert_array_equal(alone.uv_px[:, 0], tracks.uv_px[:, 1])
