"""Putting an appearance into a SAPIEN scene: lights, floor, wall, distractors, the object's materials.

::

    appearance = sample_appearance(rng, randomize_materials=True)
    region = Region.around(swept_points)                # world points that the object reaches while it moves
    add_lights(scene, appearance, region)
    add_surroundings(scene, appearance, region)         # floor, wall, distractors
    paint_object(appearance, render_bodies, procedural=True)

or, in one call, :func:`apply_appearance`. The world is z up with the object's front towards +x. Nothing that is
added can come between the object and a camera whose azimuth is at most
:data:`quest.sim.appearance.CAMERA_AZIMUTH_DEG` off the front.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.sim import surfaces
from quest.sim.appearance import CAMERA_AZIMUTH_DEG, Appearance, Distractor, ObjectLook, Region
from quest.sim.entities import NAMED
from quest.sim.surfaces import TILE_M, Surface, make_material

_ROLE = re.compile(r"^(.*?)-?\d*$")
_PANE = re.compile(r"(?:glass|window)(?:-|$)")


def apply_appearance(
    scene: Any, appearance: Appearance, region: Region, bodies: Sequence[Any], *, procedural: bool, wide: bool = False
) -> None:
    """Lights, surroundings and materials in one call.

    Args:
        scene: a ``sapien.Scene`` in which the object stands with its front towards +x.
        appearance: how it shall look.
        region: what the object sweeps.
        bodies: the object's ``RenderBodyComponent``s; see :func:`paint_object`.
        procedural: whether the object came without materials worth keeping.
        wide: see :func:`add_surroundings`.
    """
    add_lights(scene, appearance, region)
    add_surroundings(scene, appearance, region, wide=wide)
    paint_object(appearance, bodies, procedural=procedural)


def add_lights(scene: Any, appearance: Appearance, region: Region) -> None:
    """Put the lights into a scene.

    Args:
        scene: a ``sapien.Scene``.
        appearance: how it shall look.
        region: what the object sweeps; point lights keep off it.
    """
    scene.set_ambient_light(list(appearance.ambient))
    size = region.half_diagonal_m
    for index, light in enumerate(appearance.lights):
        towards = np.asarray(light.towards_light)
        if light.kind == "directional":
            shadow = appearance.shadows and index == 0
            # The shadow map covers the region and what stands around it.
            scene.add_directional_light(
                -towards, list(light.strength), position=region.centre + 4 * size * towards, shadow=shadow,
                shadow_scale=2.5 * size, shadow_near=0.1 * size, shadow_far=9 * size, shadow_map_size=1024,
            )  # fmt: skip
        else:
            reach = light.distance * size
            power = np.asarray(light.strength) * reach**2  # falls off with the square of the distance
            scene.add_point_light((region.centre + reach * towards).tolist(), power.tolist(), shadow=False)


def add_surroundings(scene: Any, appearance: Appearance, region: Region, *, wide: bool = False) -> list[Any]:
    """Put floor, wall and distractors into a scene.

    Args:
        scene: a ``sapien.Scene``.
        appearance: how it shall look.
        region: what the object sweeps; the floor lies under it, the wall and the distractors stand behind it.
        wide: whether floor and wall reach far, for cameras that turn.

    Returns:
        The entities that were added.
    """
    size, ground = region.half_diagonal_m, float(region.low[2]) - 1e-3
    added = []
    back = float(region.low[0])
    for distractor in appearance.distractors:
        centre, reach = distractor_place(distractor, region)
        back = min(back, float(centre[0]) - reach)
        added.append(_add_distractor(scene, distractor, centre, size))
    extent = (80 if wide else 14) * size
    square = extent * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    floor = square + region.centre[:2]
    added.append(_add_quad(scene, np.column_stack([floor, np.full(4, ground)]), floor, appearance.floor))
    if appearance.wall is not None:
        x = back - appearance.wall_gap * size
        wall = square + np.array([region.centre[1], ground + extent])
        added.append(_add_quad(scene, np.column_stack([np.full(4, x), wall]), wall, appearance.wall))
    return added


def distractor_place(distractor: Distractor, region: Region) -> tuple[Float[np.ndarray, "3"], float]:
    """Where a distractor stands.

    The object lies before a vertical plane that the distractor stays behind. Its normal is turned from the front by
    no more than a right angle less :data:`CAMERA_AZIMUTH_DEG`, so that every camera within that azimuth lies before
    the plane too, and with it every ray from such a camera to the object.

    Returns:
        Its centre in the world, and the radius of a vertical cylinder around that holds it, metres.
    """
    size = region.half_diagonal_m
    turn = distractor.side * np.deg2rad(90.0 - CAMERA_AZIMUTH_DEG)
    normal, along = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    low, high = region.low[:2], region.high[:2]
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    half = np.asarray(distractor.size) * size
    reach = float(np.hypot(half[0], half[1])) if distractor.kind == "box" else float(half[0])
    # A turned plane touches the object at the back corner of the other side, from where it leads away from it.
    offset = (corners @ normal).min() - distractor.behind * size - reach
    shift = distractor.along * size - distractor.side * 0.5 * size
    place = offset * normal + (shift + region.centre[:2] @ along) * along
    height = {"box": half[2], "sphere": half[0], "cylinder": half[1]}[distractor.kind]
    return np.array([place[0], place[1], region.low[2] + height]), reach


def _add_distractor(scene: Any, distractor: Distractor, centre: Float[np.ndarray, "3"], size: float) -> Any:
    import sapien

    half = np.asarray(distractor.size, dtype=np.float32) * size
    material = make_material(distractor.surface)
    turn = [float(np.cos(distractor.turn_rad / 2)), 0.0, 0.0, float(np.sin(distractor.turn_rad / 2))]
    if distractor.kind == "box":
        shape: Any = sapien.render.RenderShapeBox(half.tolist(), material)
    elif distractor.kind == "sphere":
        shape = sapien.render.RenderShapeSphere(float(half[0]), material)
    else:
        shape = sapien.render.RenderShapeCylinder(float(half[0]), float(half[1]), material)
        turn = [0.5**0.5, 0.0, -(0.5**0.5), 0.0]  # SAPIEN's cylinders lie along x
    return _add_shape(scene, shape, sapien.Pose(centre.tolist(), turn))


def _add_quad(
    scene: Any, corners: Float[np.ndarray, "4 3"], plane_m: Float[np.ndarray, "4 2"], surface: Surface
) -> Any:
    """A rectangle with its corners counter-clockwise as seen; textures repeat every :data:`TILE_M` metres."""
    import sapien

    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normals = np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
    shape = sapien.render.RenderShapeTriangleMesh(
        corners.astype(np.float32), faces, normals, (plane_m / TILE_M).astype(np.float32), make_material(surface)
    )
    return _add_shape(scene, shape, sapien.Pose())


def _add_shape(scene: Any, shape: Any, pose: Any) -> Any:
    import sapien

    component = sapien.render.RenderBodyComponent()
    component.attach(shape)
    entity = sapien.Entity()
    entity.add_component(component)
    entity.set_pose(pose)
    scene.add_entity(entity)
    return entity


def paint_object(appearance: Appearance, bodies: Sequence[Any], *, procedural: bool) -> None:
    """Give the object its materials.

    Parts are told apart by the names of their shapes (``shape.name``), which should be the names of the URDF's visuals
    (``handle-3``, ``drawer_front-1``); parts of one kind look alike unless the appearance says that links differ.
    Does nothing if the appearance has no look, or if the object has materials of its own and keeps them.

    Args:
        appearance: how it shall look.
        bodies: the object's ``RenderBodyComponent``s, always in the same order.
        procedural: whether the object came without materials worth keeping.
    """
    look = appearance.look
    if look is None or not (procedural or look.repaint_original):
        return
    textures = {surface: surfaces.make_texture(surface) for surface in {*look.surfaces, look.handle}}
    for index, body in enumerate(bodies):
        for shape in body.render_shapes:
            surface = choose_surface(look, shape.name, index)
            for part in shape.parts:
                if surface.texture is not None:
                    surfaces.ensure_uv(part, np.asarray(getattr(shape, "scale", np.ones(3))))
                surfaces.wear(part.material, surface, textures.get(surface))


def choose_surface(look: ObjectLook, name: str, link: int) -> Surface:
    """The material of a part: handles have theirs, every other kind of part (or link) draws one from the look's.

    Args:
        look: materials to choose from.
        name: name of the part's visual, such as ``drawer_front-3``.
        link: index of the link.
    """
    if NAMED.search(name):
        return look.handle
    if _PANE.match(name):
        return surfaces.sample_glass_surface(np.random.default_rng(look.seed))
    match = _ROLE.match(name)
    role = match.group(1) if match else name
    key = f"link {link}" if look.per_link else role
    if not look.per_link and role in ("frame", "base", "leg", ""):
        return look.surfaces[0]
    rng = np.random.default_rng([look.seed, *key.encode()])
    return look.surfaces[int(rng.integers(len(look.surfaces)))]
