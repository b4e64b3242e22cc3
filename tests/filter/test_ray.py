"""How deep a query lies, told by the depths of all frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quest.filter.noise import Noise
from quest.filter.ray import ALONG_M, depths_told, most_probable
from quest.types import Query
from tests.filter.scenes import follow, scene

NOISE = Noise()
ONE = np.ones(1)


def told(*measured_m: float, seen: float = 6.0) -> np.ndarray:
    """What depths say of a query that the first depth put at one metre, straight ahead."""
    each = (depths_told(ONE, ONE, 0 * ONE, m * ONE, seen * ONE, -9 * ONE, NOISE) for m in measured_m)
    return sum(each, np.zeros((1, len(ALONG_M))))


def test_most_depths_tell_where_a_thin_handle_is_before_its_door() -> None:
    handle_and_door = [0.92, 0.92, 1.0, 0.92, 0.93, 0.91, 1.0, 0.92]
    np.testing.assert_allclose(most_probable(told(*handle_and_door), NOISE), [-0.08], atol=0.005)


def test_what_passes_in_front_tells_nothing() -> None:
    np.testing.assert_allclose(np.ptp(told(0.5)), 0, atol=1e-9)
    np.testing.assert_allclose(most_probable(told(), NOISE), [0], atol=1e-9)


def test_what_does_not_look_like_it_draws_it_nowhere_and_it_is_not_before_it() -> None:
    np.testing.assert_allclose(most_probable(told(*[0.9] * 9, seen=-6.0), NOISE), [0], atol=0.005)
    np.testing.assert_allclose(most_probable(told(*[0.9] * 9), NOISE), [-0.1], atol=0.005)
    assert most_probable(told(*[1.1] * 9, seen=-6.0), NOISE) > 0.02


def test_a_first_depth_that_was_wrong_is_mended_by_later_ones() -> None:
    clip = scene(np.zeros(30))
    assert clip.depth_m is not None
    depth_m = clip.depth_m + np.random.default_rng(0).normal(0, 0.002, clip.depth_m.shape).astype(np.float32)
    depth_m[0, 55:65, 65:75] = 2.1
    tracks = follow(replace(clip, depth_m=depth_m), [Query.point(0, 70.0, 60.0)])
    np.testing.assert_allclose(tracks.point_world[[0, -1], 0, 2], [2.1, 2.0], atol=0.01)
    np.testing.assert_allclose(tracks.uv_px[:, 0], np.tile([70.0, 60.0], (30, 1)), atol=0.5)
