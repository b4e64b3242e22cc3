"""An object in a room: furniture beside it, cupboards above, things on top, a wall behind, all as one object.

The object keeps its place in the split, its unit of length and its joints, which alone move. What stands around it is
procedural, drawn from the seeds of the same part of the split; its handles are entities that stand still. A row may
repeat one piece of furniture, or the object itself, so that a neighbour's handle looks like its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from quest.data.split import object_split, part_of_object
from quest.errors import ObjectError
from quest.sim.appearance import ROOM, THINGS
from quest.sim.articulation import Articulation, Part, apply
from quest.sim.objects import SimObject, find_things, load_thing
from quest.sim.procedural.catalogue import make_object
from quest.sim.procedural.clutter import things_on
from quest.sim.procedural.model import Dice, as_visual
from quest.sim.procedural.model import Part as ModelPart
from quest.sim.procedural.shapes import Mesh, box
from quest.sim.surfaces import triple

_SMALLEST_M = 0.15
"""Half diagonal; what is smaller cannot be seen from where a room can."""
_ON_TOP_M = (0.65, 0.65, 0.5)
"""Depth, width and height up to which an object stands on furniture instead of the floor."""
_LOW_M = 1.1
"""Furniture up to this height has cupboards above and things on top."""
_COUNTER_M = (0.7, 1.0)
"""Heights of furniture that goes below a counter."""
_TALLEST_M = 0.6
"""Of things on top."""
_HUNG_FROM_M = (1.35, 1.55)
_WALL_M = (3.0, 4.0)
"""Height of the wall, and how far it goes beyond the furniture."""
_MOST_JOINTS, _MOST_ENTITIES = 120, 180
_STANDING = {
    "base_cabinet": 4, "long_base_cabinet": 2, "sink_cabinet": 2, "dishwasher": 2, "range": 2, "washing_machine": 1,
    "chest": 2, "cabinet": 2, "long_cabinet": 1, "bare_cabinet": 1, "sideboard": 1, "refrigerator": 1,
    "french_refrigerator": 1, "filing_cabinet": 1, "wall_unit": 1,
}  # fmt: skip
"""How often each kind of furniture stands beside an object."""
_CARRYING = ("base_cabinet", "long_base_cabinet", "sideboard", "dishwasher")
_HUNG = ("wall_cabinet", "long_wall_cabinet")


@dataclass(frozen=True)
class _Piece:
    """A piece of furniture where it stands."""

    name: str
    sim_object: SimObject
    low: Float[np.ndarray, "3"]
    """Least world coordinates of its bounding box, metres; it faces +x."""

    @property
    def size(self) -> Float[np.ndarray, "3"]:
        return self.sim_object.articulation.extent_m

    @property
    def high(self) -> Float[np.ndarray, "3"]:
        return self.low + self.size

    @property
    def shift(self) -> Float[np.ndarray, "4 4"]:
        """From where it stands alone, about the origin on the floor, to where it stands in the room."""
        matrix = np.eye(4)
        matrix[:3, 3] = self.low + self.size * (0.5, 0.5, 0.0)
        return matrix


def furnished(sim_object: SimObject, rng: Dice, *, things: str | None = None) -> tuple[SimObject, tuple[str, ...]]:
    """The object in a room of its own, and the ids of the furniture around it.

    It stands about the origin as before; what would stand on a table stands on a piece of furniture. ``things`` is a
    folder of things that stand on the furniture; without it these are plain bottles and boxes.

    Raises:
        ObjectError: it is too small for a room, or there are no things in the folder.
    """
    if sim_object.half_diagonal_m < _SMALLEST_M:
        raise ObjectError(
            f"{sim_object.object_id}: expected half a diagonal of at least {_SMALLEST_M} m for a room, got "
            f"{sim_object.half_diagonal_m:.2f} m; make it without a room"
        )
    room = _Room(sim_object, rng, () if things is None else find_things(Path(things)))
    joined = _joined(room.own, room.pieces, (*room.still, *room.things), room.view_m())
    return joined, tuple(piece.sim_object.object_id for piece in room.pieces)


class _Room:
    """Draws what stands where: x to the front, y along the wall, all backs at one x."""

    def __init__(self, sim_object: SimObject, rng: Dice, shelf: Sequence[Path]) -> None:
        self._rng, self._shelf = rng, shelf
        part = part_of_object(sim_object.source, sim_object.object_id) or "train"
        self._seeds = object_split().procedural_seeds[part]
        size = sim_object.articulation.extent_m
        self.pieces: list[_Piece] = []
        self.still: list[Part] = []
        self.things: list[Part] = []
        self._back, height = -size[0] / 2, 0.0
        on_top = bool((size <= _ON_TOP_M).all())
        if on_top:
            self._back -= rng.real(0.01, 0.1)
            carrying = self._made(rng.pick(_CARRYING))
            while (carrying.articulation.extent_m[:2] < size[:2]).any():
                carrying = self._made(rng.pick(_CARRYING))
            self.pieces.append(_Piece("below", carrying, self._beside(carrying, 0.0)))
            height = self.pieces[0].size[2]
        self.own = _Piece("", sim_object, np.array([-size[0] / 2, -size[1] / 2, height]))
        first = self.pieces[0] if on_top else self.own
        self._counter = 0.0  # height that all low furniture is brought to, or 0 for none
        if not rng.chance(0.4):
            own = float(first.size[2])
            self._counter = own if _COUNTER_M[0] <= own <= _COUNTER_M[1] else rng.real(0.86, 0.98)
        for side, name in ((-1, "right"), (1, "left")):
            self._row(first, side, name)
        standing = [self.own, *self.pieces]
        self._hang(standing)
        for piece in standing[2:] if on_top else standing:
            self._cover(piece)
        self._wall(standing)

    def view_m(self) -> Float[np.ndarray, "2 3"]:
        """The box that is filmed: around all that the object reaches, with more or less of the room beside it."""
        alone, articulation = self.own.sim_object, self.own.sim_object.articulation
        points = np.concatenate([articulation.world_points(position) for position in articulation.each_opened])
        low, high = np.stack((points.min(axis=0), points.max(axis=0))) + self.own.shift[:3, 3]
        room = 2.5 * alone.half_diagonal_m * self._rng.real(0, 1) ** 1.5 * np.array([0.2, 1.0, 0.6])
        low, high = low - room, high + room
        return np.stack((np.maximum(low, (self._back, -np.inf, 0.0)), np.minimum(high, (np.inf, np.inf, _WALL_M[0]))))

    def _made(self, category: str) -> SimObject:
        first, last = self._seeds
        return make_object(category, self._rng.whole(first, last + 1))

    def _beside(self, sim_object: SimObject, y: float, z: float = 0.0) -> Float[np.ndarray, "3"]:
        """Low corner of something with its middle at ``y``."""
        return np.array([self._back, y - sim_object.articulation.extent_m[1] / 2, z])

    def _row(self, first: _Piece, side: int, name: str) -> None:
        """Furniture from the object to one side."""
        rng, edge = self._rng, float(first.high[1] if side > 0 else -first.low[1])
        alike, twin = rng.chance(0.45), rng.chance(0.3)
        total = sum(_STANDING.values())
        drawn: SimObject | None = first.sim_object if twin else None
        for n in range(rng.whole(1, 4)):
            if drawn is None or not (alike or (twin and n == 0)):
                drawn = self._made(rng.pick(list(_STANDING), [weight / total for weight in _STANDING.values()]))
            if not self._fits(drawn):
                return
            width, height = drawn.articulation.extent_m[1:]
            gap = rng.real(0.002, 0.01) if rng.chance(0.75) else rng.real(0.03, 0.4)
            lift = self._counter - height if _COUNTER_M[0] <= height <= self._counter else 0.0
            piece = _Piece(f"{name}-{n}", drawn, self._beside(drawn, side * (edge + gap + width / 2), float(lift)))
            if lift > 0.005:
                low, high = piece.low.copy(), piece.high.copy()
                low[2], high[2], high[0] = 0.0, lift, high[0] - min(0.05, 0.2 * piece.size[0])
                self._add("plinth", box(triple(low), triple(high)))
            self.pieces.append(piece)
            edge += gap + width

    def _fits(self, sim_object: SimObject) -> bool:
        """Whether masks can tell all links and entities apart with one more object."""
        things = [self.own.sim_object, *(piece.sim_object for piece in self.pieces), sim_object]
        joints = sum(len(thing.articulation.joints) for thing in things)
        return joints <= _MOST_JOINTS and sum(len(thing.entities) for thing in things) <= _MOST_ENTITIES

    def _hang(self, standing: list[_Piece]) -> None:
        """Cupboards of one kind in a row on the wall, where nothing tall stands."""
        rng = self._rng
        if not rng.chance(0.6):
            return
        hung, z = self._made(rng.pick(_HUNG)), rng.real(*_HUNG_FROM_M)
        width = float(hung.articulation.extent_m[1])
        y, right = min(float(p.low[1]) for p in standing), max(float(p.high[1]) for p in standing)
        n = 0
        while y + width <= right:
            tall = any(p.high[2] > z - 0.05 and p.low[1] < y + width and p.high[1] > y for p in standing)
            if not tall and rng.chance(0.8) and self._fits(hung):
                self.pieces.append(_Piece(f"above-{n}", hung, np.array([self._back, y, z])))
                n += 1
            y += width + 0.004

    def _cover(self, piece: _Piece) -> None:
        """A counter on a low piece, and things on top."""
        if piece.high[2] > _LOW_M:
            return
        low, high = piece.low.copy(), piece.high.copy()
        if piece is not self.own and abs(high[2] - self._counter) < 1e-6:
            slab = np.array([high[0] + 0.02, high[1] + 0.004, high[2] + 0.035])
            self._add("counter", box((low[0], low[1] - 0.004, high[2]), triple(slab)))
            high[2] = slab[2]
        if not self._shelf:
            for part in things_on(low, high, self._rng):
                self._add(part.role, part.mesh, part.surface)
            return
        # None to four of the things of the shelf, beside each other.
        rng, taken = self._rng, float(low[1])
        for _ in range(rng.whole(0, 5)):
            parts = load_thing(rng.pick(self._shelf))
            bounds = np.array([part.surface.bounds for part in parts])
            least, most = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
            room = np.array([high[0] - low[0], high[1] - taken, _TALLEST_M]) - (most - least)
            if (room < 0).any():
                continue
            place = np.array([low[0] + rng.real(0, 1) * room[0], taken + rng.real(0, 0.5) * room[1], high[2]])
            shift = np.eye(4)
            shift[:3, 3] = place - least
            self.things += [replace(_moved(part, shift), name=f"{THINGS}/{part.name}") for part in parts]
            taken = float(place[1] + (most - least)[1]) + 0.01

    def _wall(self, standing: list[_Piece]) -> None:
        """The wall behind, and pictures or plates on it."""
        rng, (height, beyond) = self._rng, _WALL_M
        low, high = min(p.low[1] for p in standing) - beyond, max(p.high[1] for p in standing) + beyond
        face = self._back - rng.real(0.0, 0.03)
        self._add("wall", box((face - 0.05, low, 0.0), (face, high, height)))
        for _ in range(rng.whole(0, 4)):
            half = np.array([rng.real(0.04, 0.4), rng.real(0.04, 0.3)])
            y, z = rng.real(low + beyond / 2, high - beyond / 2), rng.real(1.0, 1.9)
            thick = rng.real(0.005, 0.03)
            self._add("picture", box((face, y - half[0], z - half[1]), (face + thick, y + half[0], z + half[1])))

    def _add(self, role: str, mesh: Mesh, surface: str = "body") -> None:
        visual = as_visual(ModelPart(role, mesh, surface), len(self.still))
        name, one = f"{ROOM}/{visual.name}", (1.0, 1.0, 1.0)
        geometry = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        self.still.append(Part(name, name, 0, np.eye(4), visual.mesh, one, one, "mesh", None, geometry))


def _joined(
    own: _Piece, pieces: Sequence[_Piece], still: Sequence[Part], view_m: Float[np.ndarray, "2 3"]
) -> SimObject:
    """All pieces as one object: the first one's bodies first, everything that never moves in body 0."""
    alone = own.sim_object.articulation
    root = own.shift @ alone.world_from_root
    names, joints = list(alone.body_names), list(alone.joints)
    # The first slash of a name ends that of its piece, which is empty for the object itself.
    parts = [replace(part, name=f"{own.name}/{part.name}") for part in alone.parts]
    entities = list(own.sim_object.entities)
    from_world = np.linalg.inv(root)
    parts += [_moved(part, from_world) for part in still]
    for piece in pieces:
        other = piece.sim_object.articulation
        base = from_world @ piece.shift @ other.world_from_root
        first_part, first_joint = len(parts), len(joints)
        for part in other.parts:
            named = replace(part, name=f"{piece.name}/{part.name}", visual=f"{piece.name}/{part.visual}")
            parts.append(replace(named, body=part.body + first_joint) if part.body else _moved(named, base))
        for joint in other.joints:
            record = replace(joint.joint, name=f"{piece.name}/{joint.joint.name}")
            parent = joint.parent and joint.parent + first_joint
            pose = joint.parent_from_joint if parent else base @ joint.parent_from_joint
            joints.append(replace(joint, joint=record, parent=parent, parent_from_joint=pose))
        names += [f"{piece.name}/{name}" for name in other.body_names[1:]]
        for e in piece.sim_object.entities:
            own_parts = tuple(i + first_part for i in e.parts)
            point, joint = (apply(base, e.point), -1) if e.fixed else (e.point, e.joint + first_joint)
            entities.append(replace(e, name=f"{piece.name}/{e.name}", joint=joint, point=point, parts=own_parts))
    return replace(
        own.sim_object,
        articulation=Articulation(tuple(names), tuple(parts), tuple(joints), root),
        entities=tuple(sorted(entities, key=lambda e: e.label == "hinge")),
        movers=tuple(range(len(alone.joints))),
        view_m=view_m,
    )


def _moved(part: Part, pose: Float[np.ndarray, "4 4"]) -> Part:
    return replace(part, body_from_part=pose @ part.body_from_part, surface=part.surface.copy().apply_transform(pose))
