"""How a scene looks, drawn at random and put into a SAPIEN scene: light, surroundings, distractors, materials.

The world is z up with the object's front towards +x. Nothing that is added can come between the object and a camera
whose azimuth is at most :data:`CAMERA_AZIMUTH_DEG` off the front.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from quest.sim.cameras import CAMERA_AZIMUTH_DEG
from quest.sim.entities import NAMED
from quest.sim.surfaces import (
    TEXTURE_KINDS,
    TILE_M,
    Colour,
    Surface,
    Texture,
    TextureKind,
    ensure_uv,
    make_material,
    make_texture,
    sample_glass_surface,
    sample_handle_surface,
    sample_surface,
    triple,
    wear,
)

ROOM = "room"
"""First word of the names of parts that belong to no piece of furniture, such as ``room/wall-0``."""
THINGS = "things"
"""The same of things that keep their own materials."""
_FLOORS: tuple[TextureKind, ...] = ("noise", "checker", "planks", "tiles", "speckle", "stripes")
_WALLS: tuple[TextureKind, ...] = ("noise", "stripes", "tiles", "planks", "speckle")
_MORE_FOR_ROOMS: tuple[TextureKind, ...] = ("bricks", "concrete", "marble", "weave")
_MORE_FOR_OBJECTS: tuple[TextureKind, ...] = ("marble", "scratched", "stickers", "weave", "concrete")


_Shape = Literal["box", "sphere", "cylinder"]
_SHAPES: tuple[_Shape, ...] = get_args(_Shape)
_ODD_KINDS: tuple[TextureKind, ...] = ("checker", "stripes", "tiles", "speckle", "noise")
_ROLE = re.compile(r"^(.*?)-?\d*$")
_PANE = re.compile(r"(?:glass|window)(?:-|$)")


@dataclass(frozen=True)
class Light:
    """One light."""

    kind: Literal["directional", "point"]
    towards_light: tuple[float, float, float]
    """Unit vector from the object to the light, z up, front +x."""
    distance: float
    """Of a point light from the region's centre, in half diagonals of the region."""
    strength: Colour
    """Linear red, green, blue."""


@dataclass(frozen=True)
class Distractor:
    """A thing that has nothing to do with the object."""

    kind: _Shape
    size: tuple[float, float, float]
    """Half extents in half diagonals of the region (sphere: the first; cylinder: the first two)."""
    side: int
    """-1, 0 or 1: behind the object and to its right, straight behind it, or to its left."""
    along: float
    """Where it stands along the line behind which it must stay, in half diagonals from the middle."""
    behind: float
    """Gap to that line, in half diagonals."""
    turn_rad: float
    surface: Surface


@dataclass(frozen=True)
class ObjectLook:
    """Materials of the object."""

    repaint_original: bool
    """Whether objects that come with materials of their own lose them."""
    surfaces: tuple[Surface, ...]
    """Materials that parts which are no handles choose from; the first one is the body's."""
    handle: Surface
    per_link: bool
    """Whether every link chooses for itself rather than every kind of part."""
    seed: int
    """Of who wears what."""


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
    wall: Surface | None
    """Of the wall behind the object, or None for no wall."""
    wall_gap: float
    """Its distance behind the distractors, in half diagonals."""
    distractors: tuple[Distractor, ...]
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

    With ``randomize_materials`` the object gets new ones: always if it is procedural, in four of ten takes if it has
    its own (:attr:`ObjectLook.repaint_original`). ``broad`` draws from all textures rather than the usual ones.
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
        handle=sample_handle_surface(rng),
        per_link=bool(rng.random() < 0.15),
        seed=int(rng.integers(2**31)),
    )


def _sample_distractor(rng: np.random.Generator) -> Distractor:
    kind = _SHAPES[int(rng.integers(3))]
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


def odd_appearance(appearance: Appearance, rng: np.random.Generator) -> Appearance:
    """The same scene in materials that no room has: strong colours, coarse patterns, on everything, the object too."""
    distractors = tuple(replace(d, surface=_odd(rng)) for d in appearance.distractors)
    look = ObjectLook(True, tuple(_odd(rng) for _ in range(3)), _odd(rng), bool(rng.random() < 0.5), 0)
    wall = None if appearance.wall is None else _odd(rng)
    return replace(appearance, floor=_odd(rng), wall=wall, distractors=distractors, look=look)


def _odd(rng: np.random.Generator) -> Surface:
    first = triple(rng.uniform(0.0, 1.0, 3) ** 0.5)
    second = triple(rng.uniform(0.0, 1.0, 3) ** 2)
    kind = _ODD_KINDS[int(rng.integers(len(_ODD_KINDS)))]
    texture = Texture(kind, first, second, int(rng.integers(1, 5)), int(rng.integers(2**31)))
    return Surface(first, float(rng.uniform(0.2, 1.0)), 0.0, float(rng.uniform(0.0, 0.6)), texture)


def apply_appearance(
    scene: Any,
    appearance: Appearance,
    region: Region,
    bodies: Sequence[Any],
    *,
    procedural: bool,
    wide: bool = False,
    room: bool = False,
) -> None:
    """Puts lights, floor, wall and distractors into a scene, and gives the object its materials.

    Args:
        scene: a ``sapien.Scene`` in which the object stands with its front towards +x.
        appearance: how it shall look.
        region: what the object sweeps; the floor lies under it, all else keeps off it.
        bodies: the object's ``RenderBodyComponent``s; names of their shapes (``handle-3``, ``drawer_front-1``) tell
            parts apart.
        procedural: whether the object came without materials worth keeping.
        wide: whether floor and wall reach far, for cameras that turn.
        room: whether the names begin with the piece of furniture and a slash, as those of a room do
            (:mod:`quest.sim.room`).
    """
    size = region.half_diagonal_m
    scene.set_ambient_light(list(appearance.ambient))
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
    back, ground = float(region.low[0]), float(region.low[2]) - 1e-3
    for distractor in appearance.distractors:
        centre, reach = distractor_place(distractor, region)
        back = min(back, float(centre[0]) - reach)
        _add_distractor(scene, distractor, centre, size)
    extent = (80 if wide else 14) * size
    square = extent * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    floor = square + region.centre[:2]
    _add_quad(scene, np.column_stack([floor, np.full(4, ground)]), floor, appearance.floor)
    if appearance.wall is not None:
        x = back - appearance.wall_gap * size
        wall = square + np.array([region.centre[1], ground + extent])
        _add_quad(scene, np.column_stack([np.full(4, x), wall]), wall, appearance.wall)
    if appearance.look is not None:
        _paint(appearance.look, bodies, own=procedural or appearance.look.repaint_original, room=room)


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
    corners = np.array([[x, y] for x in (region.low[0], region.high[0]) for y in (region.low[1], region.high[1])])
    half = np.asarray(distractor.size) * size
    reach = float(np.hypot(half[0], half[1])) if distractor.kind == "box" else float(half[0])
    # A turned plane touches the object at the back corner of the other side, from where it leads away from it.
    offset = (corners @ normal).min() - distractor.behind * size - reach
    shift = distractor.along * size - distractor.side * 0.5 * size
    place = offset * normal + (shift + region.centre[:2] @ along) * along
    height = {"box": half[2], "sphere": half[0], "cylinder": half[1]}[distractor.kind]
    return np.array([place[0], place[1], region.low[2] + height]), reach


def _add_distractor(scene: Any, distractor: Distractor, centre: Float[np.ndarray, "3"], size: float) -> None:
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
    add_shape(scene, shape, sapien.Pose(centre.tolist(), turn))


def _add_quad(
    scene: Any, corners: Float[np.ndarray, "4 3"], plane_m: Float[np.ndarray, "4 2"], surface: Surface
) -> None:
    """A rectangle with its corners counter-clockwise as seen; textures repeat every :data:`TILE_M` metres."""
    import sapien

    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normals = np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)
    shape = sapien.render.RenderShapeTriangleMesh(
        corners.astype(np.float32), faces, normals, (plane_m / TILE_M).astype(np.float32), make_material(surface)
    )
    add_shape(scene, shape)


def add_shape(scene: Any, shape: Any, pose: Any = None) -> Any:
    """A SAPIEN entity of its own for a shape."""
    import sapien

    component = sapien.render.RenderBodyComponent()
    component.attach(shape)
    entity = sapien.Entity()
    entity.add_component(component)
    scene.add_entity(entity)
    if pose is not None:
        entity.set_pose(pose)
    return entity


def _paint(look: ObjectLook, bodies: Sequence[Any], *, own: bool, room: bool) -> None:
    """Parts of one kind look alike unless the look says that links differ.

    Neighbours have looks of their own, or that of the object; without ``own`` the object itself keeps its materials.
    """
    texture_of = cache(make_texture)
    for index, body in enumerate(bodies):
        for shape in body.render_shapes:
            piece, _, name = shape.name.partition("/") if room else ("", "", shape.name)
            if piece == THINGS:
                continue
            if piece == ROOM:
                surface = _room_surface(look.seed, name)
            elif piece or own:
                surface = choose_surface(_look_of(look, piece), name, index)
            else:
                continue
            for part in shape.parts:
                if surface.texture is not None:
                    ensure_uv(part, np.asarray(getattr(shape, "scale", np.ones(3))))
                wear(part.material, surface, texture_of(surface))


def _look_of(look: ObjectLook, piece: str) -> ObjectLook:
    """Materials of a piece of furniture: half of the rooms are of one make, in the others each has its own."""
    if not piece or np.random.default_rng(look.seed).random() < 0.5:
        return look
    row = piece.partition("-")[0]  # those above the others are of one make
    alike = row if row == "above" else piece
    return _sample_look(np.random.default_rng([look.seed, *alike.encode()]), _MORE_FOR_OBJECTS)


def _room_surface(seed: int, name: str) -> Surface:
    """What a part of the room wears: walls and pictures what walls do, things on top anything."""
    kinds = (*_WALLS, *_MORE_FOR_ROOMS) if name.startswith("wall") else TEXTURE_KINDS
    return sample_surface(np.random.default_rng([seed, *name.encode()]), kinds=kinds, textured=0.5)


def choose_surface(look: ObjectLook, name: str, link: int) -> Surface:
    """The material of a part by its name: handles have theirs, every other kind of part (or link) draws one."""
    if NAMED.search(name):
        return look.handle
    if _PANE.match(name):
        return sample_glass_surface(np.random.default_rng(look.seed))
    match = _ROLE.match(name)
    role = match.group(1) if match else name
    key = f"link {link}" if look.per_link else role
    if not look.per_link and role in ("frame", "base", "leg", ""):
        return look.surfaces[0]
    rng = np.random.default_rng([look.seed, *key.encode()])
    return look.surfaces[int(rng.integers(len(look.surfaces)))]
