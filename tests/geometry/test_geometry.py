"""Projection, lifting and rigid motion: properties that hold for every camera and motion."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from quest.geometry import invert, lift, lift_depth, project, scale_camera, transform
from quest.types import Camera
from tests.tolerances import DOUBLE

CAMERA = Camera(fx=310.0, fy=290.0, cx=170.0, cy=110.0, width=320, height=240)


def real(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.integers(16, 2000)), draw(st.integers(16, 2000))
    return Camera(
        draw(real(20, 3000)), draw(real(20, 3000)), draw(real(0, width)), draw(real(0, height)), width, height
    )


@st.composite
def motions(draw: st.DrawFn) -> Tensor:
    """Rigid motions from a rotation vector and a translation."""
    x, y, z = (draw(real(-3, 3)) for _ in range(3))
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.linalg.matrix_exp(skew)
    matrix[:3, 3] = torch.tensor([draw(real(-10, 10)) for _ in range(3)], dtype=torch.float64)
    return matrix


points = st.lists(st.tuples(real(-5, 5), real(-5, 5), real(0.05, 50)), min_size=1, max_size=5).map(
    lambda p: torch.tensor(p, dtype=torch.float64)
)


@given(cameras(), points)
def test_lift_undoes_project(camera: Camera, point: Tensor):
    torch.testing.assert_close(lift(project(point, camera), point[:, 2], camera), point, **DOUBLE)


@given(cameras(), points)
def test_project_agrees_with_the_matrix(camera: Camera, point: Tensor):
    homogeneous = point @ torch.from_numpy(camera.matrix).T
    torch.testing.assert_close(project(point, camera), homogeneous[:, :2] / homogeneous[:, 2:])


@given(motions(), points)
def test_inverse_undoes_a_motion(motion: Tensor, point: Tensor):
    torch.testing.assert_close(transform(invert(motion), transform(motion, point)), point, **DOUBLE)
    torch.testing.assert_close(invert(motion) @ motion, torch.eye(4, dtype=torch.float64), **DOUBLE)
    torch.testing.assert_close(invert(invert(motion)), motion, **DOUBLE)


@given(motions(), motions(), points)
def test_motions_compose(second: Tensor, first: Tensor, point: Tensor):
    together = transform(second @ first, point)
    torch.testing.assert_close(transform(second, transform(first, point)), together, **DOUBLE)
    torch.testing.assert_close(invert(second @ first), invert(first) @ invert(second), **DOUBLE)


@given(motions(), points)
def test_motions_keep_distances(motion: Tensor, point: Tensor):
    torch.testing.assert_close(
        torch.cdist(transform(motion, point), transform(motion, point)), torch.cdist(point, point)
    )


def test_transform_broadcasts_and_keeps_batches_apart():
    motion = torch.eye(4, dtype=torch.float64).repeat(2, 3, 1, 1, 1)
    motion[..., :3, 3] = torch.arange(6.0).reshape(2, 3, 1, 1)
    point = torch.zeros(2, 3, 5, 3, dtype=torch.float64)
    expected = torch.arange(6.0, dtype=torch.float64).reshape(2, 3, 1, 1).expand_as(point)
    torch.testing.assert_close(transform(motion, point), expected)


@given(cameras(), points, real(0.05, 4), real(0, 50), real(0, 50))
def test_scaled_camera_sees_scaled_pixels(camera: Camera, point: Tensor, scale: float, left: float, top: float):
    width, height = math.ceil(camera.width * scale + left) + 1, math.ceil(camera.height * scale + top) + 1
    scaled = scale_camera(camera, scale=scale, pad_left_px=left, pad_top_px=top, width=width, height=height)
    expected = project(point, camera) * scale + torch.tensor([left, top], dtype=torch.float64)
    torch.testing.assert_close(project(point, scaled), expected, **DOUBLE)


@pytest.mark.parametrize("z", [0.0, -1.0, -1e-9, math.nan])
def test_no_pixel_behind_the_camera(z: float):
    assert project(torch.tensor([[0.1, 0.2, z]]), CAMERA).isnan().all()


@pytest.mark.parametrize("z", [0.0, -1.0, math.nan, math.inf])
def test_no_point_without_depth(z: float):
    assert lift(torch.tensor([[10.0, 20.0]]), torch.tensor([z]), CAMERA).isnan().all()


def test_a_missing_point_leaves_its_neighbours_alone():
    point = torch.tensor([[0.1, 0.2, 1.0], [0.1, 0.2, -1.0], [0.3, 0.1, 2.0]])
    uv = project(point, CAMERA)
    assert uv.isnan().any(-1).tolist() == [False, True, False]


def test_depth_image_lifts_pixel_centres():
    depth_m = torch.rand(2, 3, 4) + 0.5
    depth_m[0, 1, 2] = 0
    lifted = lift_depth(depth_m, CAMERA)
    for b in range(2):
        for y in range(3):
            for x in range(4):
                expected = lift(torch.tensor([x + 0.5, y + 0.5]), depth_m[b, y, x], CAMERA)
                torch.testing.assert_close(lifted[b, y, x], expected, equal_nan=True)
    assert lifted[0, 1, 2].isnan().all()


def test_what_is_missing_does_not_spoil_the_gradient():
    point = torch.tensor([[0.1, 0.2, 1.0], [0.1, 0.2, -1.0]], requires_grad=True)
    project(point, CAMERA)[0].sum().backward()
    uv = torch.tensor([[10.0, 20.0], [30.0, 40.0]], requires_grad=True)
    lift(uv, torch.tensor([1.0, 0.0]), CAMERA)[0].sum().backward()
    for tensor in (point, uv):
        assert tensor.grad is not None
        assert tensor.grad[0].any()
        assert (tensor.grad[1] == 0).all()
