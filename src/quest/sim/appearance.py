"""How a scene looks: light, surroundings, distractors and the object's materials, drawn at random.

:func:`sample_appearance` draws an :class:`Appearance`, which is plain data; :mod:`quest.sim.dressing` puts it into a
scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from quest.sim import surfaces
from quest.sim.surfaces import Surface, sample_surface, triple
from quest.sim.textures import Colour, TextureKind

CAMERA_AZIMUTH_DEG = 70.0
"""Cameras up to this far to either side of the front see past every distractor."""

_FLOORS: tuple[TextureKind, ...] = ("noise", "checker", "planks", "tiles", "speckle", "stripes")
_WALLS: tuple[TextureKind, ...] = ("noise", "stripes", "tiles", "planks", "speckle")
_MORE_FOR_ROOMS: tuple[TextureKind, ...] = ("bricks", "concrete", "marble", "weave")
_MORE_FOR_OBJECTS: tuple[TextureKind, ...] = ("marble", "scratched", "stickers", "weave", "concrete")


@dataclass(frozen=True)
class Light:
    """One light.

    Attributes:
        kind: ``directional`` or ``point``.
        towards_light: unit vector from the object to the light, z up, front +x.
        distance: of a point light from the region's centre, in half diagonals of the region.
        strength: linear red, green, blue.
    """

    kind: Literal["directional", "point"]
    towards_light: tuple[float, float, float]
    distance: float
    strength: Colour


@dataclass(frozen=True)
class Distractor:
    """A thing that has nothing to do with the object.

    Attributes:
        kind: its shape.
        size: half extents in half diagonals of the region (sphere: the first; cylinder: the first two).
        side: -1, 0 or 1: behind the object and to its right, straight behind it, or to its left.
        along: where it stands along the line behind which it must stay, in half diagonals from the middle.
        behind: gap to that line, in half diagonals.
        turn_rad: turn about the vertical.
        surface: its material.
    """

    kind: Literal["box", "sphere", "cylinder"]
    size: tuple[float, float, float]
    side: int
    along: float
    behind: float
    turn_rad: float
    surface: Surface


@dataclass(frozen=True)
class ObjectLook:
    """Materials of the object.

    Attributes:
        repaint_original: whether objects that come with materials of their own lose them.
        surfaces: materials that parts which are no handles choose from; the first one is the body's.
        handle: material of handles and knobs.
        per_link: whether every link chooses for itself rather than every kind of part.
        seed: seed of who wears what.
    """

    repaint_original: bool
    surfaces: tuple[Surface, ...]
    handle: Surface
    per_link: bool
    seed: int


@dataclass(frozen=True)
class Appearance:
    """Everything random about how a scene looks.

    Attributes:
        ambient: linear colour of the light from everywhere.
        lights: one to three lights.
        shadows: whether the first directional light casts shadows.
        floor: material of the floor.
        wall: material of the wall behind the object, or None for no wall.
        wall_gap: its distance behind the distractors, in half diagonals.
        distractors: things around.
        look: materials of the object; None leaves every material as it came.
    """

    ambient: Colour
    lights: tuple[Light, ...]
    shadows: bool
    floor: Surface
    wall: Surface | None
    wall_gap: float
    distractors: tuple[Distractor, ...]
    look: ObjectLook | None


@dataclass(frozen=True)
class Region:
    """The box that the object sweeps while its joints move.

    Attributes:
        low: smallest world coordinates, metres; ``low[2]`` is the ground.
        high: largest world coordinates, metres.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

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
