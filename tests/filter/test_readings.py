"""What a loss is told from: readings of the posterior on planes that slide and turn about the line of sight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from quest.filter.queries import READINGS
from quest.types import Clip, Query
from tests.filter.scenes import WALL_M, Board, scene
from tests.track.clips import make_tracker

FRAMES = 12
STILL = np.zeros(FRAMES)


def readings(clip: Clip, *queries: Query) -> dict[str, np.ndarray]:
    """By name, [T, K], of the frames in which all are followed."""
    stream, found = make_tracker().stream(clip.camera, queries), []
    for t in range(len(clip)):
        stream.step(**vars(clip.frame(t)))
        assert stream.memory.filter is not None
        if len(stream.memory.filter.queries) == len(queries):
            found.append(stream.memory.filter.queries.readings)
    return dict(zip(READINGS, np.moveaxis(np.array(found), -1, 0), strict=True))


def test_what_rests_and_is_seen_looks_like_its_anchor() -> None:
    told = readings(scene(STILL), Query.point(0, 70.0, 60.0))
    assert all(np.isnan(values[0]).all() and np.isfinite(values[1:]).all() for values in told.values())
    later = {name: values[-1, 0] for name, values in told.items()}
    assert_allclose([later[name] for name in ("turn", "distance", "roll", "went", "depth off")], 0, atol=1e-3)
    assert_allclose([later["anchor cosine"], later["newest cosine"], later["tile"]], 1, atol=0.1)
    assert later["rides on world"] == 1
    assert later["anchor correlation"] > 3
    assert later["lost"] < -3


def test_from_how_far_another_side() -> None:
    camera_m = np.linspace(0, 0.4, FRAMES)
    told = readings(scene(camera_m), Query.point(0, 80.0, 60.0))
    assert_allclose(told["turn"][1:, 0], np.degrees(np.arctan2(camera_m, WALL_M))[1:], atol=0.1)
    assert_allclose(told["distance"][1:, 0], np.log(np.hypot(camera_m, WALL_M) / WALL_M)[1:], atol=1e-3)


def test_a_camera_that_rolls() -> None:
    clip, turned = scene(STILL), np.tile(np.eye(4), (FRAMES, 1, 1))
    angle = np.linspace(0, 0.1, FRAMES)
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angle)
    turned[:, 1, 0] = np.sin(angle)
    turned[:, 0, 1] = -turned[:, 1, 0]
    told = readings(replace(clip, cam_from_world=turned), Query.point(0, 80.0, 60.0))
    assert_allclose(told["roll"][1:, 0], np.degrees(angle)[1:], atol=0.01)


@pytest.mark.parametrize("covered", [True, False])
def test_what_is_in_front(covered: bool) -> None:
    way = np.stack([np.where(np.arange(FRAMES) < 4, -200.0, 40.0), np.full(FRAMES, 20.0 if covered else 100.0)], -1)
    told = readings(scene(STILL, Board(way, (60, 80), 0.8, seed=1)), Query.point(0, 70.0, 60.0))
    assert (told["covered"][-1, 0] > 0.9) == covered
    assert (told["depth off"][-1, 0] < -3) == covered
    assert (told["anchor cosine"][-1, 0] < 0.9) == covered


@pytest.mark.parametrize("explained", [True, False])
def test_what_was_found_again_where_a_body_brought_it(explained: bool) -> None:
    way = np.stack([20 + 4.0 * np.arange(FRAMES), np.full(FRAMES, 40.0)], -1)
    clip = scene(STILL, Board(way, (50, 40), 1.7, seed=5))
    stream = make_tracker().stream(clip.camera, [Query.point(0, 45.0, 60.0)])
    for t in range(FRAMES - 1):
        stream.step(**vars(clip.frame(t)))
    state = stream.memory.filter
    assert state is not None
    queries = state.queries
    assert queries.place.shape[1] > 1, "the board is a body"
    first = queries.place + np.array([0.3, 0.0, 0.0])
    if explained:
        first[:, 1] = queries.place[:, 1]
    stream.memory.filter = replace(state, queries=replace(queries, named_place=first, anew=np.ones(1, dtype=bool)))
    stream.step(**vars(clip.frame(FRAMES - 1)))
    off = stream.memory.filter.queries.readings[0, READINGS.index("off named")]
    assert_allclose(off, 0 if explained else 1, atol=0.01)


def test_nothing_is_told_without_depth_or_of_what_somebody_confirms() -> None:
    clip = scene(STILL, depth=False)
    assert np.isnan(readings(clip, Query.point(0, 70.0, 60.0))["lost"]).all()
    clip = scene(STILL)
    stream = make_tracker().stream(clip.camera, [Query.point(0, 70.0, 60.0, name="it")])
    for t in range(4):
        stream.step(**vars(clip.frame(t)))
    stream.confirm("it")
    assert stream.memory.filter is not None
    assert np.isnan(stream.memory.filter.queries.readings).all()


def test_what_is_asked_later_is_told_from_the_view_of_then() -> None:
    camera_m = np.linspace(0, 0.4, FRAMES)
    told = readings(scene(camera_m), Query.point(6, 80.0, 60.0))
    since_m = (camera_m - camera_m[6])[7:]
    assert_allclose(told["turn"][1:, 0], np.degrees(np.arctan2(since_m, WALL_M)), atol=0.1)
