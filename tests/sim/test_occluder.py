"""Occluders hide what they shall, stand before the object, hide no more than they may, and come from outside."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from quest.sim.articulation import apply
from quest.sim.cameras import PosedCamera
from quest.sim.props import fit_shape, slide_in
from quest.types import Camera

POSED = PosedCamera(
    Camera(110.0, 110.0, 48.0, 48.0, 96, 96),
    np.array([[0, 1, 0, 0], [0, 0, -1, 0.4], [-1, 0, 0, 2.0], [0, 0, 0, 1.0]]),
)
seeds = st.integers(0, 2**31 - 1)
places = st.floats(-0.3, 0.3)
extents = st.floats(0.05, 0.1)


def square(u: float, v: float, a: float, b: float) -> np.ndarray:
    return np.array([[u - a, v - b], [u + a, v - b], [u + a, v + b], [u - a, v + b]])


@given(seeds, places, places, extents, extents)
def test_a_shape_hides_all_rays_from_before_the_object(seed: int, u: float, v: float, a: float, b: float) -> None:
    rays = square(u, v, a, b)
    shape = fit_shape(rays, POSED, 0.8, np.random.default_rng(seed))
    if shape is None:
        return
    assert shape.hides(rays).all()
    assert shape.hides(rays.mean(axis=0, keepdims=True)).all()
    depth = shape.vertices[:, 2]
    assert depth.min() > 0
    assert depth.max() < 0.8
    assert shape.outline.volume < 0.5 * (96 / 110) ** 2
    assert not shape.hides(np.array([[u + 1.5, v]])).any()


def test_most_places_can_be_hidden_and_shapes_differ() -> None:
    rays = square(0.1, -0.1, 0.08, 0.06)
    shapes = [fit_shape(rays, POSED, 1.0, np.random.default_rng(seed)) for seed in range(30)]
    found = [shape for shape in shapes if shape is not None]
    assert len(found) > 20
    assert {shape.kind for shape in found} == {"box", "cylinder"}
    assert len({shape.half_m.tobytes() for shape in found}) == len(found)


def test_too_much_to_hide() -> None:
    assert fit_shape(square(0.0, 0.0, 0.4, 0.4), POSED, 1.0, np.random.default_rng(0)) is None


@given(seeds)
def test_it_comes_from_outside_the_image_and_stands_still_in_its_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = fit_shape(square(0.1, 0.0, 0.08, 0.08), POSED, 1.0, rng)
    if shape is None:
        return
    away = np.array([1.0, 1 - 1e-9, 0.5, 0.0, 0.0])
    poses = POSED.cam_from_world @ slide_in(shape, POSED, away, rng)
    np.testing.assert_allclose(poses[3:], np.tile(shape.cam_from_shape, (2, 1, 1)), atol=1e-9)
    local = apply(np.linalg.inv(shape.cam_from_shape), shape.vertices)
    outside = apply(poses[1], local)
    uv = outside[:, :2] / outside[:, 2:] * 110 + 48
    assert (uv < 0).all(axis=0).any() or (uv > 96).all(axis=0).any()
    np.testing.assert_allclose(poses[2, 2, 3], shape.cam_from_shape[2, 3])  # parallel to the image
    gone = apply(np.linalg.inv(POSED.cam_from_world), apply(poses[0], local))
    assert gone[:, 2].max() < -10  # below the ground, where it casts no shadow
