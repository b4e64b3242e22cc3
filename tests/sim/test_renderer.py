"""What SAPIEN draws of a scene that can be computed by hand."""

from pathlib import Path

import numpy as np
import pytest

from quest.sim.annotate import project_points
from quest.sim.articulation import apply
from quest.sim.cameras import PosedCamera
from quest.sim.generate import generate_take
from quest.sim.objects import SimObject, load_object
from quest.sim.renderer import Picture, Renderer
from quest.sim.settings import TakeSettings
from quest.types import Camera
from tests.sim.small_objects import write_cabinet

pytestmark = pytest.mark.render

# Two metres before the cabinet, at half its height, looking at it along -x: x right is +y, y down is -z.
POSED = PosedCamera(
    Camera(270.0, 240.0, 99.0, 87.0, 192, 168),
    np.array([[0, 1, 0, 0], [0, 0, -1, 0.4], [-1, 0, 0, 2.0], [0, 0, 0, 1.0]]),
)


def picture(renderer: Renderer, cabinet: SimObject, position: tuple[float, float]) -> Picture:
    stage = renderer.stage(cabinet, [POSED])
    stage.pose(cabinet.articulation.poses(np.array(position, dtype=float)))
    (taken,) = stage.pictures()
    return taken


def test_depth_labels_and_pixels(renderer: Renderer, cabinet: SimObject) -> None:
    taken = picture(renderer, cabinet, (0, 0))
    poses = cabinet.articulation.poses(np.zeros(2))
    owner = {part: 1 + index for index, entity in enumerate(cabinet.entities) for part in entity.parts}
    for index, part in enumerate(cabinet.articulation.parts):
        if part.name not in ("handle-8", "door_panel-9"):
            continue
        corners = apply(poses[part.body], np.asarray(part.surface.vertices))
        face = corners[np.isclose(corners[:, 0], corners[:, 0].max())]  # the side that the camera sees
        uv, depth = project_points(face, POSED)
        (x0, y0), (x1, y1) = np.round(uv.min(axis=0)).astype(int), np.round(uv.max(axis=0)).astype(int)
        inner = (slice(y0 + 1, y1 - 1), slice(x0 + 1, x1 - 1))
        assert taken.body[inner].size > 10
        assert (taken.body[inner] == 1 + part.body).all()
        np.testing.assert_allclose(taken.depth_m[inner], depth[0], atol=1e-4)
        np.testing.assert_array_equal(taken.entity[inner], owner.get(index, 0))
        if part.name == "handle-8":  # its mask ends where its projection ends
            y, x = np.nonzero(taken.entity == owner[index])
            outer = project_points(corners, POSED)[0]
            assert (np.abs([x.min(), y.min()] - outer.min(axis=0)) <= 1).all()
            assert (np.abs([x.max() + 1, y.max() + 1] - outer.max(axis=0)) <= 1).all()


def test_bodies_move_before_nothing(renderer: Renderer, cabinet: SimObject) -> None:
    closed, opened = picture(renderer, cabinet, (0, 0)), picture(renderer, cabinet, (0.2, 0))
    assert closed.rgb.dtype == np.uint8
    for corner in (closed.depth_m[:4, :4], closed.body[:4, :4], closed.entity[:4, :4]):
        assert not corner.any()
    handle = closed.entity == 1
    assert np.median(closed.depth_m[handle]) - np.median(opened.depth_m[opened.entity == 1]) == pytest.approx(
        0.2, abs=1e-3
    )
    assert (opened.entity == 1).sum() > handle.sum()  # nearer is larger


def test_mirrored_meshes_show_their_outside_in_their_own_colour(renderer: Renderer, tmp_path: Path) -> None:
    """A door whose mesh is mirrored left to right is as far away as it was, and red if the URDF says so."""
    folder = write_cabinet(tmp_path / "cabinet")
    plain = picture(renderer, load_object(folder), (0, 0))
    urdf = folder / "mobility.urdf"
    text = urdf.read_text().replace('door-0.obj"/>', 'door-0.obj" scale="1 -1 1"/>')
    text = text.replace('<visual name="door_panel-9">', '<visual name="door_panel-9"><origin xyz="0 0.6 0"/>')
    red = '<material name="red"><color rgba="0.8 0.05 0.05 1"/></material></visual></link><joint name="joint_door"'
    urdf.write_text(text.replace('</visual></link><joint name="joint_door"', red))
    cabinet = load_object(folder)
    stage = renderer.stage(cabinet, [POSED])
    stage.scene.set_ambient_light([1.0, 1.0, 1.0])
    stage.pose(cabinet.articulation.poses(np.zeros(2)))
    (mirrored,) = stage.pictures()
    door = plain.body == 3
    assert (mirrored.body[door] == 3).mean() > 0.98
    assert np.median(np.abs(mirrored.depth_m - plain.depth_m)[door]) < 1e-3
    reds = mirrored.rgb[door].astype(float).mean(axis=0)
    assert reds[0] > 2 * max(reds[1:])


def test_shapes_without_meshes_take_materials_in_every_scene(renderer: Renderer) -> None:
    settings = TakeSettings(views=1, size=64, every=8, broad_materials=True)
    toolbox = load_object(Path(__file__).parents[2] / "examples" / "toolbox")
    pictures = [
        generate_take(toolbox, 1, seed, renderer=renderer, settings=settings).views[0].clip.rgb[0] for seed in range(4)
    ]
    assert len({picture.tobytes() for picture in pictures}) == 4
    assert all(np.ptp(picture) > 50 for picture in pictures)
