"""Frames of any shape on the network's canvas, and answers back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from quest.geometry import lift, project
from quest.geometry.letterbox import Letterbox
from quest.types import Camera


def box(width: int, height: int, size: int = 64) -> Letterbox:
    return Letterbox(Camera(1.2 * width, 1.2 * width, 0.48 * width, 0.53 * height, width, height), size)


sizes = st.tuples(st.integers(8, 2000), st.integers(8, 2000))


@given(sizes, st.floats(0, 1), st.floats(0, 1))
def test_pixels_there_and_back(size: tuple[int, int], x: float, y: float):
    letterbox = box(*size)
    uv = np.array([[x * size[0], y * size[1]]])
    canvas = letterbox.to_canvas(uv)
    np.testing.assert_allclose(letterbox.to_source(canvas), uv, atol=1e-9 * max(size))
    assert (canvas >= -1e-6).all()
    assert (canvas <= letterbox.size + 1e-6).all()


@given(sizes)
def test_the_canvas_has_the_camera_of_its_pixels(size: tuple[int, int]):
    letterbox = box(*size)
    point = torch.tensor([[0.1, -0.05, 1.3], [-0.2, 0.1, 0.7]], dtype=torch.float64)
    source, canvas = project(point, letterbox.source), project(point, letterbox.camera)
    np.testing.assert_allclose(letterbox.to_canvas(source.numpy()), canvas.numpy(), atol=1e-6 * max(size))
    torch.testing.assert_close(lift(canvas, point[:, 2], letterbox.camera), point)


@pytest.mark.parametrize(
    ("width", "height"), [(64, 64), (32, 32), (128, 128), (160, 40), (30, 90), (100, 3), (641, 427)]
)
def test_a_dot_lands_where_its_pixel_says(width: int, height: int):
    letterbox = box(width, height)
    image = np.zeros((height, width, 3), np.uint8)
    y0, x0 = height // 3, width // 2
    thick = max(1, int(2 / letterbox.scale))
    image[max(0, y0 - thick) : y0 + thick, max(0, x0 - thick) : x0 + thick] = 255
    rows, columns = np.nonzero(image[..., 0])
    centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    placed = letterbox.rgb(image)[..., 0].astype(float)
    y, x = np.mgrid[:64, :64] + 0.5
    found = np.array([(placed * x).sum(), (placed * y).sum()]) / placed.sum()
    np.testing.assert_allclose(found, letterbox.to_canvas(centre), atol=0.5)


@pytest.mark.parametrize(("width", "height"), [(100, 3), (3, 100), (101, 37), (2000, 8), (64, 64), (640, 480)])
def test_the_corners_of_the_image_are_where_its_pixels_end(width: int, height: int):
    letterbox = box(width, height)
    seen = letterbox.rgb(np.full((height, width, 3), 255, np.uint8))[..., 0] > 0
    rows, columns = np.nonzero(seen)
    corners = letterbox.to_canvas(np.array([[0.0, 0.0], [width, height]]))
    found = [[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]]
    np.testing.assert_allclose(corners, found, atol=1e-6)


def test_square_frames_have_one_scale():
    letterbox = box(333, 333)
    assert letterbox.scale_xy == (letterbox.scale, letterbox.scale)
    assert letterbox.camera.fx == letterbox.source.fx * letterbox.scale


def test_a_square_frame_of_the_right_size_stays_as_it_is():
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    assert (box(64, 64).rgb(image) == image).all()


def test_padding_is_black_and_without_depth():
    letterbox = box(64, 32)
    left, top = letterbox.pad_px
    assert (left, top) == (0, 16)
    rgb = letterbox.rgb(np.full((32, 64, 3), 200, np.uint8))
    depth = letterbox.depth(np.full((32, 64), 2.0, np.float32))
    for canvas in (rgb.max(axis=-1) > 0, depth > 0):
        assert canvas[16:48].all()
        assert not canvas[:16].any()
        assert not canvas[48:].any()


def test_bad_depth_is_missing_depth():
    depth_m = np.full((64, 64), 2.0, np.float32)
    depth_m[0, :4] = [np.nan, np.inf, -1.0, -np.inf]
    placed = box(64, 64).depth(depth_m)
    assert (placed[0, :4] == 0).all()
    assert (placed[0, 4:] == 2).all()


@pytest.mark.parametrize("width", [192, 320, 224, 24])
def test_depth_is_never_mixed_and_comes_from_the_middle(width: int):
    """A step between two surfaces stays one, and stays where it is."""
    letterbox = box(width, width)
    depth_m = np.full((width, width), 1.0, np.float32)
    depth_m[:, width // 2 :] = 3.0
    placed = letterbox.depth(depth_m)
    assert set(np.unique(placed)) == {np.float32(1.0), np.float32(3.0)}
    assert (placed == 1.0).sum() == 32 * 64
    ramp = np.broadcast_to(np.arange(width, dtype=np.float32) + 0.5, (width, width)).copy()
    source_x = letterbox.to_source(np.stack([np.arange(64) + 0.5, np.full(64, 0.5)], axis=-1))[:, 0]
    assert np.abs(letterbox.depth(ramp)[0] - source_x).max() <= 0.5 + 1e-6
