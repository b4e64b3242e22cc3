"""Lens distortion: rectified pixels lie where the pinhole model says, whatever the lens."""

from __future__ import annotations

import numpy as np
import pytest

from quest.data.registration import Distortion, Rectifier
from quest.errors import InputError
from quest.types import Camera

CAMERA = Camera(180.0, 175.0, 101.5, 76.0, 200, 150)
LENSES = {
    "plumb_bob": Distortion("plumb_bob", (-0.28, 0.09, 0.001, -0.002, 0.01)),
    "four": Distortion("plumb_bob", (-0.2, 0.05, 0.0, 0.0)),
    "rational": Distortion("rational_polynomial", (0.4, -0.2, 0.001, 0.001, 0.02, 0.6, -0.1, 0.03)),
    "fisheye": Distortion("equidistant", (-0.02, 0.01, -0.004, 0.001)),
    "fisheye without coefficients": Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)),
}


def distort(rays: np.ndarray, lens: Distortion) -> np.ndarray:
    """Pixels of rays in the distorted picture, half-integer centres; written out here, not taken from OpenCV."""
    x, y = rays[:, 0], rays[:, 1]
    k = np.zeros(8)
    k[: len(lens.coefficients)] = lens.coefficients
    r2 = x**2 + y**2
    if lens.model in ("equidistant", "fisheye"):
        theta = np.arctan(np.sqrt(r2))
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        scale = np.where(r2 > 0, bent / np.sqrt(np.maximum(r2, 1e-12)), 1.0)
        x, y = x * scale, y * scale
    else:
        top = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
        bottom = 1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3
        radial = top / bottom
        x, y = (
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2),
            y * radial + k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y,
        )
    return np.stack((CAMERA.fx * x + CAMERA.cx, CAMERA.fy * y + CAMERA.cy), axis=-1)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_dots_come_back_to_where_a_pinhole_sees_them(lens: Distortion):
    rng = np.random.default_rng(0)
    rays = rng.uniform(-0.3, 0.3, (8, 2))
    straight = rays * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    seen = distort(rays, lens)
    rectifier = Rectifier(CAMERA, lens)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    for expected, at in zip(straight, seen, strict=True):
        blob = 255 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 2.0**2))
        found = rectifier.rgb(np.repeat(blob[..., None], 3, axis=-1).astype(np.uint8))[..., 0].astype(float)
        centre = np.array([(found * x).sum(), (found * y).sum()]) / found.sum()
        np.testing.assert_allclose(centre, expected, atol=0.25)


def test_depth_keeps_its_values_and_is_missing_where_the_lens_saw_nothing():
    depth_m = np.where(np.arange(CAMERA.width) < 100, np.float32(1), np.float32(3))
    depth_m = np.tile(depth_m, (CAMERA.height, 1))
    found = Rectifier(CAMERA, LENSES["plumb_bob"]).depth(depth_m)
    assert set(np.unique(found)) <= {0.0, 1.0, 3.0}
    assert found.dtype == np.float32
    found = Rectifier(CAMERA, Distortion("plumb_bob", (0.6, 0.0, 0.0, 0.0))).depth(depth_m)
    assert (found[0, 0], found[75, 99]) == (0, 1)


@pytest.mark.parametrize("lens", [Distortion(), Distortion("plumb_bob", (0.0,) * 5), Distortion("anything", ())])
def test_no_distortion_changes_nothing(lens: Distortion):
    image = np.random.default_rng(1).integers(0, 256, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8)
    assert lens.none
    assert Rectifier(CAMERA, lens).rgb(image) is image


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("plumb_bob", (0.1, 0.2), "expected 4 or 5 coefficients, got 2"),
        ("rational_polynomial", (0.1,) * 5, "expected 8 or 12 or 14 coefficients, got 5"),
        ("omnidirectional", (0.1, 0.2), "is unknown; expected one of plumb_bob"),
        ("plumb_bob", (np.nan,) * 5, "finite"),
    ],
)
def test_bad_lenses(model: str, coefficients: tuple[float, ...], message: str):
    with pytest.raises(InputError, match=message):
        Distortion(model, coefficients)
