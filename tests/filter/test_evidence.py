"""Each kind of evidence by itself: local motion, camera motion, and the motion of a patch."""

from __future__ import annotations

import numpy as np
import pytest

from quest.filter.camera_motion import LEAST, estimate_pose, picture_motion
from quest.filter.local_motion import corners, follow
from quest.filter.patches import GRID_PX, patch_motion, tile_motion, tiles
from quest.filter.rigid_motion import Seen, misfit_unsure, predicted_spread
from quest.filter.view import View
from tests.filter.scenes import SIZE, plain, shifted, texture

WIDE = texture(3 * SIZE[0], 3 * SIZE[1], seed=1)
PLACES = np.array([[40.0, 40.0], [80.5, 60.5], [120.0, 90.0]])


def test_points_are_followed_to_a_tenth_of_a_pixel() -> None:
    one, other = shifted(WIDE, 100, 100), shifted(WIDE, 103.3, 97.9)
    motion = follow(plain(one), plain(other), PLACES, PLACES)
    assert motion.found.all()
    np.testing.assert_allclose(motion.uv_px - PLACES, np.tile([-3.3, 2.1], (3, 1)), atol=0.1)


def test_what_leaves_the_picture_is_not_found_and_stays_where_it_is_expected() -> None:
    one, other = shifted(WIDE, 100, 100), shifted(WIDE, 150, 100)
    motion = follow(plain(one), plain(other), PLACES, PLACES - [50, 0])
    assert motion.found.tolist() == [False, True, True]
    np.testing.assert_array_equal(motion.uv_px[0], PLACES[0] - [50, 0])


def test_a_plain_patch_says_less_than_a_textured_one() -> None:
    grey = shifted(WIDE, 100, 100)
    grey[:, 80:] = 128
    picture = plain(grey)
    covariance = follow(picture, picture, np.array([[40.0, 60.0], [130.0, 60.0]]), PLACES[:2]).covariance
    assert np.trace(covariance[1]) > 100 * np.trace(covariance[0])


def test_corners_keep_apart_and_stay_where_they_are_wanted() -> None:
    picture, allowed = plain(shifted(WIDE, 100, 100)), np.zeros(SIZE[::-1], bool)
    allowed[:, :80] = True
    found = corners(picture, allowed, cell_px=15, count=20)
    assert 5 < len(found) <= 20
    assert (found[:, 0] <= 80).all()
    apart = np.linalg.norm(found[:, None] - found, axis=-1) + 1e3 * np.eye(len(found))
    assert apart.min() >= 14
    assert corners(picture, allowed, cell_px=15, count=0).shape == (0, 2)


def test_a_pose_is_found_among_outliers() -> None:
    rng = np.random.default_rng(2)
    matrix = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (60, 3))
    pose = np.eye(4)
    pose[:3, 3] = [0.1, -0.05, 0.2]
    uv_px, _ = View(matrix, pose, None).project(points)
    uv_px[:15] += 30
    estimated = estimate_pose(points, uv_px, matrix, np.eye(4))
    assert estimated is not None
    np.testing.assert_allclose(estimated[0], pose, atol=1e-3)
    assert estimated[1].tolist() == [False] * 15 + [True] * 45
    assert estimate_pose(points[: LEAST - 1], uv_px[: LEAST - 1], matrix, np.eye(4)) is None


def test_points_before_or_behind_the_camera_are_on_no_body() -> None:
    matrix = np.array([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]])
    places = np.array([[0.0, 0, 2], [1e9, 1e9, -1], [3.0, 1, 0]])
    seen = Seen(np.full((3, 2), [80.0, 60.0]), np.full(3, 2.0), np.tile(np.eye(2), (3, 1, 1)), np.full(3, 0.01))
    view, singular = View(matrix, np.eye(4), None), False
    for size in 10.0 ** np.arange(-6, 12):  # how well the pose is known
        spread = seen.spread + predicted_spread(places, np.zeros(3), size * np.eye(6), np.zeros((3, 3)), view)
        singular |= bool((np.linalg.det(spread) == 0).any())
        off = misfit_unsure(places, np.zeros(3), size * np.eye(6), np.zeros((3, 3)), seen, view)
        assert off[0] < 1e-6
    assert singular, "the test tries what it is for"


def test_without_depth_the_picture_moves_by_a_homography() -> None:
    here = np.random.default_rng(3).uniform(0, 100, (40, 2))
    np.testing.assert_allclose(picture_motion(here, here + np.array([4.0, -2.0]))[:2, 2], [4, -2], atol=1e-3)
    np.testing.assert_array_equal(picture_motion(here[:3], here[:3]), np.eye(3))


@pytest.mark.parametrize("side", [-1, 1])
def test_at_a_seam_the_layer_under_the_query_counts(side: int) -> None:
    """The left half moves, the right half stays."""
    one = shifted(WIDE, 100, 100)
    other = one.copy()
    other[:, 4:84] = one[:, :80]
    at = np.array([[80.0 + 18 * side, 60.0]])
    motion = patch_motion(plain(one), plain(other), at, at)
    assert np.isfinite(motion.variance).all()
    np.testing.assert_allclose(motion.step_px, [[4.0 if side < 0 else 0.0, 0.0]], atol=0.3)
    if side > 0:  # points that do not belong to it do not move it
        right = (GRID_PX[:, 0] > 4).astype(float)[None]
        motion = patch_motion(plain(one), plain(other), at - [8, 0], at - [8, 0], right)
        np.testing.assert_allclose(motion.step_px, [[0, 0]], atol=0.3)
        assert np.isinf(patch_motion(plain(one), plain(other), at, at, 0 * right).variance).all()


def test_tiles_are_found_again_each_by_itself() -> None:
    """Two queries of two frames, each moved its own way."""
    here, there = np.array([[60.0, 60.0], [90.0, 50.0]]), np.array([[63.0, 58.0], [86.5, 51.5]])
    now = plain(shifted(WIDE, 100, 100))
    tile = np.concatenate(
        [tiles(plain(shifted(WIDE, 100 + dx, 100 + dy)), here[i : i + 1]) for i, (dx, dy) in enumerate(there - here)]
    )
    np.testing.assert_allclose(tile_motion(tile, now, here).step_px, there - here, atol=0.1)
