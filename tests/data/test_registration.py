"""Depth registered to colour: a scene of planes whose depth both cameras know, and what must change nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from quest.data.registration import Distortion, Rig, register_depth
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
