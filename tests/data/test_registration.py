"""Depth registered to colour: a scene of planes whose depth both cameras know, and what must change nothing.

Rectified pixels lie where the pinhole model says, whatever the lens.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from quest.data.registration import Distortion, Rectifier, Rig, register_depth
from quest.errors import InputError
from quest.types import Camera

COLOUR = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)
SMALL = Camera(140.0, 140.0, 81.0, 59.0, 160, 120)
LARGE = Camera(620.0, 620.0, 322.0, 239.0, 640, 480)


def box_and_plane(camera: Camera, depth_from_colour: np.ndarray) -> np.ndarray:
    """Depth of a wall 2 m away, slanted, and of a board 1 m away, in a camera placed anywhere; rays cut with planes.

    The scene is fixed to the colour camera.
    """
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack(((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)), axis=-1)
    back = np.linalg.inv(depth_from_colour)
    origin, rays = back[:3, 3], rays @ back[:3, :3].T  # one unit along a ray is one metre of depth
    depth_m = np.full(x.shape, np.inf)
    for normal, point, half in (
        (np.array([0.2, 0.1, -1.0]), np.array([0.0, 0.0, 2.0]), None),
        (np.array([0.0, 0.0, -1.0]), np.array([0.05, 0.0, 1.0]), 0.15),
    ):
        along = ((point - origin) @ normal) / (rays @ normal)
        hit = origin + along[..., None] * rays
        inside = along > 0
        if half is not None:
            inside &= (np.abs(hit[..., :2] - point[:2]) <= half).all(axis=-1)
        depth_m = np.where(inside, np.minimum(depth_m, along), depth_m)
    return np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)


def transform(degrees: tuple[float, float, float], metres: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    matrix[:3, 3] = metres
    return matrix


@pytest.mark.parametrize("camera", [SMALL, COLOUR, LARGE], ids=["small", "same", "large"])
def test_known_scene(camera: Camera):
    colour_from_depth = transform((0.5, -1.0, 0.8), (0.03, -0.002, 0.004))
    depth_m = box_and_plane(camera, np.linalg.inv(colour_from_depth))
    truth = box_and_plane(COLOUR, np.eye(4))
    found = register_depth(depth_m, camera, COLOUR, colour_from_depth)
    inner = np.s_[20:-20, 20:-30]
    seen = found[inner] > 0
    assert seen.mean() > 0.95  # what the board hides from the depth camera is missing
    off = np.abs(found - truth)[inner][seen]
    assert np.quantile(off, 0.95) < 0.01
    assert (off > 0.05).mean() < 0.04  # on the outline of the board, which the nearer side wins
    board = (truth < 1.01) & (truth > 0)
    assert (np.abs(found[board] - 1.0) < 0.02).mean() > 0.98, "the wall must not shine through"


def test_magnification_leaves_no_holes_and_the_nearer_of_two_wins():
    depth_m = np.full((SMALL.height, SMALL.width), 1.5, np.float32)
    found = register_depth(depth_m, SMALL, COLOUR, transform((0, 0, 0), (0.02, 0, 0)))
    assert (found[10:-10, 20:-20] == np.float32(1.5)).all()
    depth_m = np.zeros((COLOUR.height, COLOUR.width), np.float32)
    depth_m[120, 160], depth_m[120, 175] = 2.0, 1.0
    # 0.1 m to the left: 15 pixels at 2 m, 30 at 1 m, so both fall on one pixel.
    found = register_depth(depth_m, COLOUR, COLOUR, transform((0, 0, 0), (-0.1, 0, 0)))
    assert found[120, 145] == 1.0
    for away in ((0, 0, -2), (9, 0, 0)):  # behind and outside
        assert (register_depth(np.ones_like(depth_m), COLOUR, COLOUR, transform((0, 0, 0), away)) == 0).all()


@given(
    depth_m=hnp.arrays(np.float32, (9, 12), elements=st.floats(0, 20, width=32).map(lambda z: z if z > 0.01 else 0.0)),
    fx=st.floats(5, 500),
    fy=st.floats(5, 500),
    cx=st.floats(0, 12),
    cy=st.floats(0, 9),
)
def test_same_camera_same_place_changes_nothing(depth_m: np.ndarray, fx: float, fy: float, cx: float, cy: float):
    camera = Camera(fx, fy, cx, cy, 12, 9)
    np.testing.assert_array_equal(register_depth(depth_m, camera, camera, np.eye(4)), depth_m)


def test_rig_passes_aligned_depth_through():
    depth_m = np.random.default_rng(0).uniform(0.5, 2, (COLOUR.height, COLOUR.width)).astype(np.float32)
    assert Rig(COLOUR).depth(depth_m) is depth_m
    assert Rig(COLOUR, depth_camera=COLOUR).aligned
    assert Rig(COLOUR, Distortion("plumb_bob", (0.0,) * 5), COLOUR).aligned
    assert not Rig(COLOUR, Distortion("plumb_bob", (0.1,) * 5), COLOUR).aligned
    moved = Rig(COLOUR, depth_camera=COLOUR, colour_from_depth=transform((0, 0, 0), (0.02, 0, 0)))
    assert not moved.aligned


def test_rig_rectifies_depth_before_it_registers():
    rig = Rig(COLOUR, depth_camera=SMALL, depth_distortion=Distortion("plumb_bob", (-0.3, 0.1, 0.0, 0.0)))
    found = rig.depth(np.full((SMALL.height, SMALL.width), 2.0, np.float32))
    assert found.shape == (COLOUR.height, COLOUR.width)
    assert (found[60:-60, 60:-60] == 2.0).all()
    with pytest.raises(InputError, match="depth: 320 x 240, but the camera is for 160 x 120"):
        rig.depth(np.ones((240, 320), np.float32))
    with pytest.raises(InputError, match="colours: 160 x 120"):
        rig.rgb(np.zeros((120, 160, 3), np.uint8))


BENT = Camera(180.0, 175.0, 101.5, 76.0, 200, 150)
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
    return np.stack((BENT.fx * x + BENT.cx, BENT.fy * y + BENT.cy), axis=-1)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_dots_come_back_to_where_a_pinhole_sees_them(lens: Distortion):
    rng = np.random.default_rng(0)
    rays = rng.uniform(-0.3, 0.3, (8, 2))
    straight = rays * [BENT.fx, BENT.fy] + [BENT.cx, BENT.cy]
    seen = distort(rays, lens)
    rectifier = Rectifier(BENT, lens)
    y, x = np.mgrid[: BENT.height, : BENT.width] + 0.5
    for expected, at in zip(straight, seen, strict=True):
        blob = 255 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 2.0**2))
        found = rectifier.rgb(np.repeat(blob[..., None], 3, axis=-1).astype(np.uint8))[..., 0].astype(float)
        centre = np.array([(found * x).sum(), (found * y).sum()]) / found.sum()
        np.testing.assert_allclose(centre, expected, atol=0.25)


def test_depth_keeps_its_values_and_is_missing_where_the_lens_saw_nothing():
    depth_m = np.where(np.arange(BENT.width) < 100, np.float32(1), np.float32(3))
    depth_m = np.tile(depth_m, (BENT.height, 1))
    found = Rectifier(BENT, LENSES["plumb_bob"]).depth(depth_m)
    assert set(np.unique(found)) <= {0.0, 1.0, 3.0}
    assert found.dtype == np.float32
    found = Rectifier(BENT, Distortion("plumb_bob", (0.6, 0.0, 0.0, 0.0))).depth(depth_m)
    assert (found[0, 0], found[75, 99]) == (0, 1)


@pytest.mark.parametrize("lens", [Distortion(), Distortion("plumb_bob", (0.0,) * 5), Distortion("anything", ())])
def test_no_distortion_changes_nothing(lens: Distortion):
    image = np.random.default_rng(1).integers(0, 256, (BENT.height, BENT.width, 3)).astype(np.uint8)
    assert lens.none
    assert Rectifier(BENT, lens).rgb(image) is image


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
