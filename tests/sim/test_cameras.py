"""Cameras see everything that they are asked to see, from in front, from different sides."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from quest.sim.annotate import project_points
from quest.sim.cameras import AZIMUTH_DEG, ELEVATION_DEG, FLAT_ELEVATION_DEG, CameraStyle, sample_cameras

seeds = st.integers(0, 2**31 - 1)
sizes = st.tuples(st.integers(48, 640), st.integers(48, 640))


def cloud(seed: int) -> np.ndarray:
    """Points of an object between a stapler and a wardrobe that stands on the origin."""
    rng = np.random.default_rng(seed)
    extent = rng.uniform(0.02, 1.0, 3) * rng.uniform(0.1, 2.0)
    return rng.uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0), (50, 3)) * extent


@given(seeds, st.integers(1, 5), sizes)
def test_every_point_is_inside_every_image(seed: int, count: int, size: tuple[int, int]) -> None:
    width, height = size
    points = cloud(seed)
    cameras = sample_cameras(points, count, np.random.default_rng(seed), width=width, height=height)
    assert len(cameras) == count
    for posed in cameras:
        rotation = posed.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        uv, depth = project_points(points, posed)
        assert (depth > 0).all()
        assert (uv >= 0).all()
        assert (uv <= [width, height]).all()
        # and they fill a good part of the image, along one axis at least
        assert (np.ptp(uv, axis=0) / [width, height]).max() > 0.4


@given(seeds)
def test_cameras_stand_in_front_and_apart(seed: int) -> None:
    points = cloud(seed)
    cameras = sample_cameras(points, 3, np.random.default_rng(seed), width=224, height=224)
    towards = np.stack([-c.cam_from_world[2, :3] for c in cameras])
    azimuth = np.rad2deg(np.arctan2(towards[:, 1], towards[:, 0]))
    elevation = np.rad2deg(np.arcsin(towards[:, 2]))
    assert (azimuth >= AZIMUTH_DEG[0] - 1e-6).all()
    assert (azimuth <= AZIMUTH_DEG[1] + 1e-6).all()
    assert elevation.min() >= ELEVATION_DEG[0] - 1e-6
    assert elevation.max() <= FLAT_ELEVATION_DEG[1] + 1e-6
    between = towards @ towards.T - 2 * np.eye(3)
    assert between.max() < np.cos(np.deg2rad(8))


def test_cameras_in_one_direction_only() -> None:
    style = CameraStyle(azimuth_deg=(20.0, 20.0), elevation_deg=(30.0, 30.0))
    cameras = sample_cameras(cloud(0), 3, np.random.default_rng(0), width=64, height=48, style=style)
    assert len(cameras) == 3


def test_same_generator_same_cameras() -> None:
    first, again, other = (
        sample_cameras(cloud(0), 3, np.random.default_rng(seed), width=64, height=48) for seed in (1, 1, 2)
    )
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
        assert not np.array_equal(a.cam_from_world, c.cam_from_world)
        assert a.camera == b.camera
