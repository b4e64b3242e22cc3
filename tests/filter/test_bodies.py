"""Rigid bodies: what moves together, along which joint, and what rides on it while it is occluded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quest.filter.bodies import Bodies, go_on, on_joint, screw, twist, update
from quest.filter.camera_motion import stands_still
from quest.filter.noise import Noise
from quest.filter.rigid_motion import Seen, Surface, common_motion, fit, misfit
from quest.filter.surfaces import (
    Surfaces,
    depth_error,
    depth_growth,
    depth_ratio,
    in_front,
    measure,
    sow_surfaces,
)
from quest.filter.view import View, move, move_back
from quest.types import Query
from tests.filter.scenes import SIZE, Board, follow, scene

MATRIX = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
VIEW = View(MATRIX, np.eye(4), np.full((240, 320), 2.0, np.float32))
NOISE = Noise()
STILL = np.zeros(6), np.zeros((6, 6))
NOTHING = Surface(np.zeros((0, 3)), np.zeros((0, 3)))


def door(angle: float) -> np.ndarray:
    """A turn about an upright axis through (0.3, 0, 2)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, angle, 0]).as_matrix()
    axis = np.array([0.3, 0, 2.0])
    pose[:3, 3] = axis - pose[:3, :3] @ axis
    return pose


def points(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.3, 0.3, count), rng.uniform(-0.3, 0.3, count), rng.uniform(1.9, 2.1, count)])


def seen_at(point: np.ndarray, view: View = VIEW) -> Seen:
    uv_px, depth_m = view.project(point)
    count = len(point)
    return Seen(uv_px, depth_m, np.tile(0.5 * np.eye(2), (count, 1, 1)), np.full(count, 0.02))


def test_twist_is_the_logarithm_of_a_rigid_motion() -> None:
    for angle in (0.0, 1e-8, 0.3, 2.0):
        pose = door(angle)
        np.testing.assert_allclose(screw(twist(pose)), pose, atol=1e-12)
        np.testing.assert_allclose(move_back(pose, move(pose, points(5))), points(5), atol=1e-12)
    np.testing.assert_allclose(twist(door(0.8)) / 0.8, twist(door(0.2)) / 0.2, atol=1e-12)


def test_a_pose_is_fitted_and_what_disagrees_is_left_out() -> None:
    place = points(40)
    seen = seen_at(move(door(0.2), place))
    astray = seen.uv_px.copy()
    astray[:10] += 25.0
    middle = place.mean(axis=0)
    seen, nowhere = replace(seen, uv_px=astray), 1e-6 * np.eye(6)
    pose, told = fit(place, seen, NOTHING, VIEW, np.eye(4), middle, nowhere, STILL, NOISE)
    np.testing.assert_allclose(pose, door(0.2), atol=2e-3)
    assert np.linalg.eigvalsh(told).min() > 0
    off = misfit(move(pose, place), seen, VIEW)
    assert (off[10:] < 1).all()
    assert (off[:10] > 100).all()


def test_an_unexplained_motion_is_found_among_others() -> None:
    place = points(30)
    there = move(door(0.3), place)
    there[20:] += np.random.default_rng(1).uniform(-0.3, 0.3, (10, 3))
    found = common_motion(place, seen_at(there), VIEW, NOISE)
    assert found is not None
    np.testing.assert_allclose(found[0], door(0.3), atol=5e-3)
    assert found[1][:20].all()
    assert not found[1][20:].any()
    assert common_motion(place[:4], seen_at(there[:4]), VIEW, NOISE) is None


def test_a_body_goes_on_at_its_speed_and_learns_its_joint() -> None:
    bodies = Bodies.world().with_one(door(0.02), np.array([0, 0, 2.0]), NOISE)
    sure = np.diag([1e6] * 6)
    for angle in np.arange(0.04, 0.6, 0.02):
        bodies = update(go_on(bodies, 1 / 30, NOISE), 1, door(angle), sure, 1 / 30, NOISE)
    assert bodies.velocity[1, 1] == pytest.approx(0.6, rel=0.1)
    predicted = go_on(bodies, 1 / 30, NOISE)
    assert twist(predicted.pose[1])[1] == pytest.approx(0.6, abs=0.01)
    np.testing.assert_array_equal(predicted.pose[0], np.eye(4))
    lifted = predicted.pose.copy()
    lifted[1, 1, 3] += 0.05
    back, hold = on_joint(replace(predicted, pose=lifted), 1, NOISE)
    assert back[4] == pytest.approx(-0.05, abs=0.01)
    tangent = np.concatenate([[0, 1, 0], np.cross([0, 1, 0], predicted.middle[1] - np.array([0.3, 0, 2.0]))])
    assert tangent @ hold @ tangent < 0.01 * hold[4, 4]


def test_depth_says_which_body_a_surface_is_on() -> None:
    surfaces = sow_surfaces(Surfaces.none(), np.eye(4)[None], VIEW).with_one()
    away = np.stack([np.eye(4), np.eye(4)])
    away[1, 2, 3] = 0.3
    behind = replace(VIEW, depth_m=np.full((240, 320), 2.3, np.float32))
    even = np.full((len(surfaces.place), 2), 0.5)
    for _ in range(10):
        surfaces = measure(surfaces, away, even[: len(surfaces.place)], behind, 0.1, NOISE)
    assert len(surfaces.place)
    assert (surfaces.body == 1).all()


def test_depth_ratio_speaks_for_against_and_not_at_all() -> None:
    ratio = depth_ratio(np.array([0.0, 0.3, -0.3, np.nan]), np.full(4, 0.02), NOISE)
    assert ratio[0] > 1
    assert ratio[1] < -2
    np.testing.assert_array_equal(ratio[2:], 0)


def test_what_is_in_front_is_told_by_degrees() -> None:
    off_m = np.array([0.1, 0.0, -0.04, -0.08, -0.5, np.nan])
    front = in_front(off_m, np.full(6, 0.03), NOISE)
    assert (np.diff(front[:5]) > 0).all()
    assert front[1] < 0.1
    assert 0.1 < front[2] < 0.5
    assert front[3] > 0.8
    assert front[4] > 0.999
    assert front[5] == 0


@pytest.mark.parametrize("grows", [0.0, 0.002, 0.008])
def test_the_noise_of_depth_is_measured_on_a_frame(grows: float) -> None:
    """A floor and a wall, seen by a camera that errs in disparity, with holes."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:240, :320]
    inverse = np.maximum(0.2, 0.1 + row / 300 + column / 3000) + rng.normal(0, 1, (240, 320)) * grows
    depth_m = np.where(rng.random((240, 320)) < 0.2, 0, 1 / inverse)
    assert depth_growth(depth_m) == pytest.approx(grows, rel=0.05, abs=1e-4)
    measured = replace(NOISE, depth_grows=grows)
    assert depth_error(np.array([4.0]), measured) == pytest.approx(max(0.04, 16 * grows))
    assert depth_growth(np.where(row < 4, depth_m, 0)) is None


def test_a_camera_stands_still_until_points_say_otherwise() -> None:
    place = points(60)
    moved = np.eye(4)
    moved[0, 3] = 0.02
    after = replace(VIEW, cam_from_world=moved)
    jitter = np.random.default_rng(0).normal(0, 0.3, (60, 2))
    assert stands_still(place, VIEW.project(place)[0] + jitter, VIEW, after)
    assert not stands_still(place, after.project(place)[0] + jitter, VIEW, after)


@pytest.mark.xfail(
    reason="where most points are on one body, the world's own error seems as large as its motion: it is found late"
)
def test_an_occluded_entity_rides_on_its_body() -> None:
    """A board slides, before a known camera; a smaller one, nearer, hides the entity while the board goes on."""
    frames = np.arange(36)
    way = np.stack([10 + 2 * np.maximum(frames - 4, 0), np.full(36, 20)], axis=-1)
    cover = np.stack([way[:, 0] + 30 + np.where(frames < 14, -200, 0), np.full(36, 60)], axis=-1)
    clip = scene(np.linspace(0, 1e-3, 36), Board(way, (70, 80), 1.7, seed=5), Board(cover, (24, 24), 1.2, seed=6))
    tracks = follow(clip, [Query.point(0, 52.0, 72.0)])
    there = way + np.array([42, 52])
    inside = there[:, 0] < SIZE[0] - 12
    off = np.linalg.norm(tracks.uv_px[:, 0] - there, axis=-1)
    assert off[inside].max() < 3.0
    hidden = inside & (frames >= 18)
    assert not tracks.visible[hidden, 0].any()
