"""What stands out of a plane is found with its middle and size; planes, noise and missing depth are nothing."""

from __future__ import annotations

import numpy as np
import pytest

from quest.model.pieces import MEASURES, Protrusion, find_protrusions

SIDE = 160
FOCAL = 200.0


def scene(*boxes: tuple[slice, slice, float], tilt: float = 0.3, noise: float = 0.0) -> np.ndarray:
    """A tilted front a unit away, and boxes (rows, columns, height) before it: what every pixel shows."""
    across, down = np.meshgrid((np.arange(SIDE) + 0.5 - SIDE / 2) / FOCAL, (np.arange(SIDE) + 0.5 - SIDE / 2) / FOCAL)
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    rays = np.stack((across, down, np.ones_like(across)), axis=-1)
    height = np.zeros((SIDE, SIDE))
    for rows, columns, high in boxes:
        height[rows, columns] = high
    depth = (height - np.cos(tilt)) / (rays @ normal)
    depth += noise * np.random.default_rng(0).standard_normal(depth.shape)
    return rays * depth[..., None]


BAR = (slice(78, 82), slice(40, 120), 0.04)
KNOB = (slice(30, 36), slice(60, 66), 0.03)


def measure(piece: Protrusion, name: str) -> float:
    return float(piece.measures[MEASURES.index(name)])


def test_a_bar_and_a_knob_are_found_in_their_middles():
    image = scene(BAR, KNOB)
    knob, bar = sorted(find_protrusions(image), key=lambda piece: len(piece.rows))
    assert knob.uv_px == pytest.approx((63, 33), abs=1)
    # A bar that recedes shows more of its length per pixel at its far end: its middle lies beside that of its pixels.
    ends = image[80, [40, 119]]
    assert np.linalg.norm(image[int(bar.uv_px[1]), int(bar.uv_px[0])] - ends.mean(axis=0)) < 0.01
    assert np.exp(measure(bar, "length")) == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=0.05)
    assert measure(bar, "height") == pytest.approx(0.04, abs=0.003)
    assert measure(bar, "ring") == pytest.approx(1.0)
    assert measure(bar, "facing") == pytest.approx(np.cos(0.3), abs=0.05)


def test_the_same_image_gives_the_same_pieces():
    one, other = find_protrusions(scene(BAR, KNOB)), find_protrusions(scene(BAR, KNOB))
    assert [piece.uv_px for piece in one] == [piece.uv_px for piece in other]
    np.testing.assert_array_equal(one[0].measures, other[0].measures)


@pytest.mark.parametrize("high", [0.0, 0.004, 0.3], ids=["plane", "paint", "a shelf far before it"])
def test_what_does_not_stand_out_like_a_handle_is_none(high: float):
    assert find_protrusions(scene((BAR[0], BAR[1], high))) == []


def test_noise_is_no_piece_and_hides_none():
    assert find_protrusions(scene(noise=0.002)) == []
    bar = find_protrusions(scene(BAR, noise=0.002))[0]  # before the largest plane
    assert bar.uv_px == pytest.approx((80, 80), abs=4)
    assert len(bar.rows) == 320
    assert measure(bar, "spread") == pytest.approx(0.002, rel=0.1)


@pytest.mark.parametrize("known", [0, 100], ids=["no depth", "specks"])
def test_without_depth_there_are_no_pieces(known: int):
    image = scene(BAR)
    keep = np.zeros((SIDE, SIDE), dtype=bool)
    keep.flat[np.linspace(0, keep.size - 1, known).astype(int)] = True
    assert find_protrusions(np.where(keep[..., None], image, 0.0)) == []


def test_missing_pixels_are_not_taken_for_places():
    image = scene(BAR)
    image[:, :30] = 0.0
    image[100:110, 60:70] = 0.0
    (bar,) = find_protrusions(image)
    assert bar.uv_px[1] == pytest.approx(80, abs=2)
    assert np.isfinite(bar.measures).all()
