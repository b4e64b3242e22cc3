"""Ground truth of pictures that are made by hand: a wall of one body with another body before it."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from quest.geometry import project
from quest.sim.annotate import MASK_RADIUS, VISIBLE_WITHIN, entity_mask, project_points, visible_entities
from quest.sim.cameras import PosedCamera
from quest.sim.entities import SimEntity
from quest.sim.renderer import Picture
from quest.types import Camera

POSED = PosedCamera(Camera(50.0, 50.0, 20.0, 15.0, 40, 30), np.eye(4))
UNIT_M = 0.5


def wall(depth_m: float = 2.0) -> Picture:
    """Body 0 everywhere, body 1 nearer by a metre in the left half; its upper left corner is entity 0's mesh."""
    depth = np.full((30, 40), depth_m, np.float32)
    body = np.ones((30, 40), np.uint8)
    depth[:, :20], body[:, :20] = depth_m - 1, 2
    entity = np.zeros((30, 40), np.uint8)
    entity[:5, :5] = 1
    return Picture(np.zeros((30, 40, 3), np.uint8), depth, body, entity)


def seen(uv: tuple[float, float], depth_m: float, body: int) -> bool:
    (visible,) = visible_entities(wall(), np.array([uv]), np.array([depth_m]), [body], half_diagonal_m=UNIT_M)
    return bool(visible)


@given(st.lists(st.tuples(*[st.floats(-5, 5)] * 3), min_size=1, max_size=8), st.floats(-3, 3))
def test_projection_is_that_of_geometry(points: list[tuple[float, float, float]], turn: float) -> None:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = [0.3, -0.2, 1.5]
    uv, depth = project_points(np.array(points), PosedCamera(POSED.camera, pose))
    in_camera = np.array(points) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(uv, project(torch.from_numpy(in_camera), POSED.camera).numpy(), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(depth, in_camera[:, 2])


@pytest.mark.parametrize(
    ("uv", "depth_m", "body", "visible"),
    [
        ((30.0, 10.0), 2.0, 0, True),
        ((30.0, 10.0), 2.0 + 0.99 * VISIBLE_WITHIN * UNIT_M, 0, True),
        ((30.0, 10.0), 2.0 + 1.5 * VISIBLE_WITHIN * UNIT_M, 0, False),  # behind the surface
        ((30.0, 10.0), 2.0, 1, False),  # another body is there
        ((10.0, 10.0), 2.0, 0, False),  # hidden
        ((10.0, 10.0), 1.0, 1, True),
        ((20.2, 10.0), 1.0, 1, True),  # a rim: the pixel that holds it shows what is behind, its neighbour does not
        ((21.2, 10.0), 1.0, 1, False),
        ((-0.1, 10.0), 1.0, 1, False),
        ((39.9, 29.9), 2.0, 0, True),
        ((40.0, 10.0), 2.0, 0, False),
        ((np.nan, np.nan), -1.0, 0, False),
    ],
)
def test_visible(uv: tuple[float, float], depth_m: float, body: int, visible: bool) -> None:
    assert seen(uv, depth_m, body) is visible


def test_mask_of_rims_is_a_ball_on_their_own_body() -> None:
    def entity(label: str, joint: int, parts: tuple[int, ...] = ()) -> SimEntity:
        return SimEntity(f"x/{label}", label, joint, np.zeros(3), parts, 1.0, False)

    entities = (entity("handle", 0, (0,)), entity("rim", 0), entity("hinge", 0), entity("front", 0))
    # The rim lies on the edge of body 1, the front outside the image.
    points = np.array([[-0.4, -0.3, 1.0], [0.0, 0.0, 1.0], [-0.2, 0.0, 1.0], [0.0, 9.0, 1.0]])
    picture = wall()
    mask = entity_mask(picture, entities, points, POSED, half_diagonal_m=4 * UNIT_M)
    assert set(np.unique(mask)) == {0, 1, 2}
    np.testing.assert_array_equal(mask == 1, picture.entity == 1)
    assert (picture.body[mask == 2] == 2).all()
    y, x = np.nonzero(mask == 2)
    radius_px = MASK_RADIUS * 4 * UNIT_M * 50 / 1.0
    assert np.hypot(x + 0.5 - 20, y + 0.5 - 15).max() <= radius_px + 1e-6
    assert len(y) == pytest.approx(np.pi * radius_px**2 / 2, rel=0.35)  # half a disc: the other half is not its body
