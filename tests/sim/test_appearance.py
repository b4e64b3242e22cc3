"""Appearances: same generator same look, nothing between camera and object, textures that tile."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quest.sim import appearance
from quest.sim.appearance import (
    CAMERA_AZIMUTH_DEG,
    Region,
    apply_appearance,
    choose_surface,
    distractor_place,
    sample_appearance,
)
from quest.sim.renderer import Renderer
from quest.sim.surfaces import TEXTURE_KINDS, Texture, paint

seeds = st.integers(0, 2**31 - 1)


def test_looks_are_those_of_their_generator_and_four_of_ten_repaint_originals() -> None:
    one, same = (np.random.default_rng(1) for _ in range(2))
    appearances = [sample_appearance(one, randomize_materials=True) for _ in range(300)]
    assert appearances == [sample_appearance(same, randomize_materials=True) for _ in range(300)]
    assert 0.3 < np.mean([a.look is not None and a.look.repaint_original for a in appearances]) < 0.5
    assert sample_appearance(one, randomize_materials=False).look is None


@given(seeds, st.floats(-1, 1), st.floats(0.5, 4))
@settings(max_examples=60, deadline=None)
def test_no_distractor_stands_between_a_camera_and_the_object(seed: int, turn: float, far: float) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-1.5, -0.1, 3)
    region = Region(low, low + rng.uniform(0.2, 2.0, 3))
    azimuth = turn * np.deg2rad(CAMERA_AZIMUTH_DEG)
    camera = region.centre[:2] + (1 + far) * region.half_diagonal_m * np.array([np.cos(azimuth), np.sin(azimuth)])
    targets = rng.uniform(region.low[:2], region.high[:2], (40, 2))
    for distractor in sample_appearance(rng, randomize_materials=False).distractors:
        centre, reach = distractor_place(distractor, region)
        along = np.linspace(0, 1, 60)[:, None, None]
        rays = camera + along * (targets - camera)
        assert np.linalg.norm(rays - centre[:2], axis=-1).min() > reach
        assert centre[2] > region.low[2]


@pytest.mark.parametrize("kind", TEXTURE_KINDS)
def test_texture_is_an_opaque_image_with_contrast_that_tiles(kind: str) -> None:
    texture = Texture(kind, (0.8, 0.6, 0.4), (0.2, 0.2, 0.3), 2, 5)  # type: ignore[arg-type]
    image = paint(texture, size=64)
    assert image.shape == (64, 64, 4)
    assert image.dtype == np.uint8
    assert (image[..., 3] == 255).all()
    assert image[..., :3].astype(float).std() > 2
    np.testing.assert_array_equal(image, paint(texture, size=64))
    # Across the border neighbours differ no more than the worst pair of neighbours inside.
    values = image[..., 0].astype(float)
    assert np.abs(values[:, 0] - values[:, -1]).max() <= np.abs(np.diff(values, axis=1)).max() + 25
    assert np.abs(values[0] - values[-1]).max() <= np.abs(np.diff(values, axis=0)).max() + 25


def test_handles_have_a_material_of_their_own() -> None:
    look = sample_appearance(np.random.default_rng(3), randomize_materials=True).look
    assert look is not None
    assert choose_surface(look, "handle-4", 1) is choose_surface(look, "knob-12", 2) is look.handle
    assert choose_surface(look, "drawer_front-1", 1) in look.surfaces
    assert choose_surface(look, "drawer_front-1", 1) == choose_surface(look, "drawer_front-9", 1)


@pytest.mark.slow
@pytest.mark.render
def test_apply_appearance_renders_something_lit(renderer: Renderer) -> None:
    sapien = pytest.importorskip("sapien", reason="SAPIEN is not installed")
    scene = sapien.Scene()
    body = sapien.render.RenderBodyComponent()
    shape = sapien.render.RenderShapeBox(np.full(3, 0.5, dtype=np.float32), sapien.render.RenderMaterial())
    shape.set_name("frame-0")
    body.attach(shape)
    box = sapien.Entity()
    box.add_component(body)
    scene.add_entity(box)
    region = Region(np.full(3, -0.5), np.full(3, 0.5))
    appearance = sample_appearance(np.random.default_rng(5), randomize_materials=True)
    apply_appearance(scene, appearance, region, [body], procedural=True)
    camera = scene.add_camera("camera", 48, 48, 0.9, 0.05, 50.0)
    camera.entity.set_pose(sapien.Pose([3.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]))
    scene.update_render()
    camera.take_picture()
    colour = camera.get_picture("Color")[..., :3]
    assert np.isfinite(colour).all()
    assert 0.02 < colour.mean() < 0.98
    assert colour.std() > 0.01
    ids = camera.get_picture("Segmentation")[..., 1]
    assert (ids[20:28, 20:28] == box.per_scene_id).all()


@pytest.mark.parametrize(("room", "worn"), [(False, 3), (True, 1)])
def test_a_slash_in_a_name_means_something_in_rooms_only(
    monkeypatch: pytest.MonkeyPatch, room: bool, worn: int
) -> None:
    """Objects of users may call their parts ``things/door``."""
    dressed: list[str] = []
    monkeypatch.setattr(appearance, "make_texture", lambda surface: None)
    monkeypatch.setattr(appearance, "ensure_uv", lambda part, scale: None)
    monkeypatch.setattr(appearance, "wear", lambda material, surface, texture: dressed.append(material))
    names = ("things/door", "/things/door", "things/a/b") if room else ("things/door", "room/door", "left-0/door")
    shapes = [SimpleNamespace(name=name, parts=[SimpleNamespace(material=name)]) for name in names]
    drawn = sample_appearance(np.random.default_rng(0), randomize_materials=True)
    assert drawn.look is not None
    appearance._paint(drawn.look, [SimpleNamespace(render_shapes=shapes)], own=True, room=room)
    assert len(dressed) == worn
