"""How a scene looks, drawn at random and put into a SAPIEN scene: light, surroundings, distractors, materials.

::

    appearance = sample_appearance(rng, randomize_materials=True)
    region = Region.around(swept_points)                # world points that the object reaches while it moves
    add_lights(scene, appearance, region)
    add_surroundings(scene, appearance, region)         # floor, wall, distractors
    paint_object(appearance, render_bodies, procedural=True)

or, in one call, :func:`apply_appearance`. The world is z up with the object's front towards +x. Nothing that is
added can come between the object and a camera whose azimuth is at most :data:`CAMERA_AZIMUTH_DEG` off the front.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from quest.sim import surfaces
from quest.sim.cameras import CAMERA_AZIMUTH_DEG
from quest.sim.entities import NAMED
from quest.sim.surfaces import TILE_M, Colour, Surface, TextureKind, make_material, sample_surface, triple

_FLOORS: tuple[TextureKind, ...] = ("noise", "checker", "planks", "tiles", "speckle", "stripes")
_WALLS: tuple[TextureKind, ...] = ("noise", "stripes", "tiles", "planks", "speckle")
_MORE_FOR_ROOMS: tuple[TextureKind, ...] = ("bricks", "concrete", "marble", "weave")
_MORE_FOR_OBJECTS: tuple[TextureKind, ...] = ("marble", "scratched", "stickers", "weave", "concrete")


@dataclass(frozen=True)
class Light:
    """One light."""

    kind: Literal["directional", "point"]
    """``directional`` or ``point``."""
    towards_light: tuple[float, float, float]
    """Unit vector from the object to the light, z up, front +x."""
    distance: float
    """Of a point light from the region's centre, in half diagonals of the region."""
    strength: Colour
    """Linear red, green, blue."""


@dataclass(frozen=True)
class Distractor:
    """A thing that has nothing to do with the object."""

    kind: Literal["box", "sphere", "cylinder"]
    """Its shape."""
    size: tuple[float, float, float]
    """Half extents in half diagonals of the region (sphere: the first; cylinder: the first two)."""
    side: int
    """-1, 0 or 1: behind the object and to its right, straight behind it, or to its left."""
    along: float
    """Where it stands along the line behind which it must stay, in half diagonals from the middle."""
    behind: float
    """Gap to that line, in half diagonals."""
    turn_rad: float
    """Turn about the vertical."""
    surface: Surface
    """Its material."""


@dataclass(frozen=True)
class ObjectLook:
    """Materials of the object."""

    repaint_original: bool
    """Whether objects that come with materials of their own lose them."""
    surfaces: tuple[Surface, ...]
    """Materials that parts which are no handles choose from; the first one is the body's."""
    handle: Surface
    """Material of handles and knobs."""
    per_link: bool
    """Whether every link chooses for itself rather than every kind of part."""
    seed: int
    """Seed of who wears what."""


@dataclass(frozen=True)
class Appearance:
    """Everything random about how a scene looks."""

    ambient: Colour
    """Linear colour of the light from everywhere."""
    lights: tuple[Light, ...]
    """One to three lights."""
    shadows: bool
    """Whether the first directional light casts shadows."""
    floor: Surface
    """Material of the floor."""
    wall: Surface | None
    """Material of the wall behind the object, or None for no wall."""
    wall_gap: float
    """Its distance behind the distractors, in half diagonals."""
    distractors: tuple[Distractor, ...]
    """Things around."""
    look: ObjectLook | None
    """Materials of the object; None leaves every material as it came."""


@dataclass(frozen=True)
class Region:
    """The box that the object sweeps while its joints move."""

    low: Float[np.ndarray, "3"]
    """Smallest world coordinates, metres; ``low[2]`` is the ground."""
    high: Float[np.ndarray, "3"]
    """Largest world coordinates, metres."""

    @classmethod
    def around(cls, points: Float[np.ndarray, "N 3"]) -> Region:
        """The smallest region that holds some world points."""
        return cls(np.min(points, axis=0), np.max(points, axis=0))

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Middle of the box."""
        return (self.low + self.high) / 2

    @property
    def half_diagonal_m(self) -> float:
        """Half the length of the box's diagonal."""
        return float(np.linalg.norm(self.high - self.low)) / 2


def sample_appearance(rng: np.random.Generator, *, randomize_materials: bool, broad: bool = False) -> Appearance:
    """Draw how a scene looks.

    Args:
        rng: source of randomness.
        randomize_materials: whether the object gets new materials: always if it is procedural, in four of ten
            takes if it has its own (see :attr:`ObjectLook.repaint_original`).
        broad: whether textures are drawn from all there are rather than from the usual ones.
    """
    look = _sample_look(rng, _MORE_FOR_OBJECTS if broad else ()) if randomize_materials else None
    level = float(rng.uniform(0.22, 0.5))
    tint = rng.uniform(0.92, 1.08, 3)
    lights = [_sample_light(rng, "directional", level)]
    for _ in range(int(rng.choice([0, 1, 2], p=[0.45, 0.4, 0.15]))):
        lights.append(_sample_light(rng, "point" if rng.random() < 0.5 else "directional", level))
    count = int(rng.choice([0, 1, 2, 3, 4], p=[0.35, 0.2, 0.2, 0.15, 0.1]))
    more = _MORE_FOR_ROOMS if broad else ()
    return Appearance(
        ambient=triple(level * tint),
        lights=tuple(lights),
        shadows=bool(rng.random() < 0.4),
        floor=sample_surface(rng, kinds=(*_FLOORS, *more), textured=0.65),
        wall=sample_surface(rng, kinds=(*_WALLS, *more), textured=0.5) if rng.random() < 0.85 else None,
        wall_gap=float(rng.uniform(0.03, 0.8)),
        distractors=tuple(_sample_distractor(rng) for _ in range(count)),
        look=look,
    )


def _sample_light(rng: np.random.Generator, kind: Literal["directional", "point"], ambient: float) -> Light:
    azimuth, elevation = np.deg2rad(rng.uniform(-85, 85)), np.deg2rad(rng.uniform(15, 75))
    towards = (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation))
    warmth = float(rng.normal(0, 0.06))
    power = float(rng.uniform(0.7, 1.7)) * (1.3 - ambient)
    strength = power * np.clip([1 + warmth, 1.0, 1 - warmth], 0.7, 1.3)
    return Light(kind, triple(np.asarray(towards)), float(rng.uniform(2.5, 5.0)), triple(strength))


def _sample_look(rng: np.random.Generator, more: tuple[TextureKind, ...]) -> ObjectLook:
    # Wood is named four times because furniture mostly is.
    kinds: tuple[TextureKind, ...] = (
        "wood", "wood", "wood", "wood", "noise", "noise", "speckle", "brushed", "stripes", "checker", *more,
    )  # fmt: skip
    main = sample_surface(rng, kinds=kinds, textured=0.6)
    others = tuple(sample_surface(rng, kinds=kinds, textured=0.5) for _ in range(3))
    alike = rng.random() < 0.35
    return ObjectLook(
        repaint_original=bool(rng.random() < 0.4),
        surfaces=(main,) if alike else (main, *others),
        handle=surfaces.sample_handle_surface(rng),
        per_link=bool(rng.random() < 0.15),
        seed=int(rng.integers(2**31)),
    )


def _sample_distractor(rng: np.random.Generator) -> Distractor:
    kind: Literal["box", "sphere", "cylinder"] = ("box", "sphere", "cylinder")[int(rng.integers(3))]
    size = rng.uniform(0.06, 0.4, 3)
    size[2] *= rng.uniform(0.8, 2.2)
    return Distractor(
        kind=kind,
        size=triple(size),
        side=int(rng.choice([-1, 0, 1])),
        along=float(rng.uniform(-1.6, 1.6)),
        behind=float(rng.uniform(0.02, 0.5)),
        turn_rad=float(rng.uniform(0, np.pi)),
        surface=sample_surface(rng, textured=0.5),
    )


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
