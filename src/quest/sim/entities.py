"""Where the entities of an object are: points fixed in a body that a tracker can follow.

A moving body carries one entity per handle or knob; without any, the rim of what turns or the front
of what slides. What is fixed in the base and lifts the whole thing (the rim of a laptop's base, the handle of a
kettle) comes after those. Every revolute joint also has a hinge, which is reported apart and listed last.

The point of an entity lies on the *outer* surface: among surface samples that can be seen from in
front of the closed object, the one nearest to a target. The target is the part's area-weighted
centroid (handle, knob), the middle of the edge farthest from the axis (rim), or the middle of the face
that the body moves towards (front).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from quest.errors import ObjectError
from quest.sim.articulation import Articulation, apply
from quest.types import GRIPS

MOVES_AT_LEAST = 0.1
"""A joint counts as movable if an entity on it moves this far over its range, normalised units."""

HANDLE_GAP = 0.03
"""Parts named as handles that come closer than this, normalised units, are one handle."""

PLACED_WITHIN = 0.1
"""Points that somebody places lie this close to the surface of their link, normalised units."""

_LIFTED_BY_RIM = frozenset({"Laptop"})
_LIFTED_BY_HANDLE = frozenset({"Kettle", "Scissors"})
_KNOB_ON_TOP = frozenset({"Kettle"})
"""Categories whose sliding part is a lid; what one holds is not named in PartNet-Mobility."""

NAMED = re.compile("handle(?!r)|knob", re.IGNORECASE)
"""Found in the names of parts that one takes hold of: ``handle-3``, ``DoorHandle``, ``left_doorknob``."""

_SAMPLES = 600
_THIN_SAMPLES = 20_000
"""Of a base whose rim is a thin face of something large."""
# Directions towards the cameras: azimuth from the front, elevation.
_SEEN_FROM_DEG = tuple((a, e) for a in (-45, -15, 15, 45) for e in (10, 30, 50))


@dataclass(frozen=True)
class PlacedEntity:
    """An entity that somebody has pointed out."""

    where: str
    """Who says so, for messages."""
    label: str
    """``handle``, ``knob``, ``rim`` or ``front``."""
    body: int
    """The body that carries it; if there are ``parts``, these tell."""
    point: Float[np.ndarray, "3"] | None
    """Where it is in its body, metres, or None to find out."""
    parts: tuple[int, ...]
    """Indices of the parts that are it."""


@dataclass(frozen=True)
class SimEntity:
    """An entity of a simulated object."""

    name: str
    """Unique within the object, such as ``link_0/handle``."""
    label: str
    """``handle``, ``knob``, ``rim``, ``front`` or ``hinge``."""
    joint: int
    """Index of the joint that moves it, whose body is ``1 + joint``; -1 if it is fixed in the base, body 0."""
    point: Float[np.ndarray, "3"]
    """Where it is in its body, metres."""
    parts: tuple[int, ...]
    """Indices of the parts that it is made of; empty for rims, fronts and hinges."""
    travel_m: float
    """How far it gets from its place at rest when only its joint moves."""
    inside: bool
    """Whether nothing of it can be seen from the front while the object is closed."""

    @property
    def body(self) -> int:
        """Index of the body that carries it."""
        return 1 + self.joint

    @property
    def fixed(self) -> bool:
        """Whether it is fixed in the base, so that no joint moves it."""
        return self.joint < 0


def part_label(name: str) -> str | None:
    """``handle`` or ``knob`` if a part's name says so, else None."""
    match = NAMED.search(name)
    return match.group().lower() if match else None


def find_entities(
    articulation: Articulation,
    half_diagonal_m: float,
    *,
    category: str = "Unknown",
    placed: Sequence[PlacedEntity] = (),
) -> tuple[SimEntity, ...]:
    """All entities of an object, hinges last; positions as described at the top of this module.

    Args:
        articulation: the object, standing in the world with its front towards +x.
        half_diagonal_m: half the diagonal of its bounding box at rest.
        category: in PartNet-Mobility's words.
        placed: entities that somebody has pointed out; bodies that carry one get no others.

    Raises:
        ObjectError: an entity was placed away from the surface of its body.
    """
    finder = _Finder(articulation, half_diagonal_m)
    named = [e for place in placed for e in finder.placed(place)]
    taken = {e.body for e in named}
    unnamed: list[SimEntity] = []
    hinges: list[SimEntity] = []
    for j, joint in enumerate(articulation.joints):
        parts = articulation.body_parts(1 + j)
        if not parts:
            continue
        turns = joint.joint.kind == "revolute"
        if turns:
            hinges.append(finder.entity(j, "hinge", finder.hinge_point(j), False, ()))
        if 1 + j in taken:
            continue
        handles = finder.handles(j)
        named += handles
        if not handles:
            label = "rim" if turns else "knob" if category in _KNOB_ON_TOP else "front"
            target = finder.rim_target(j) if turns else finder.front_target(j)
            unnamed.append(finder.entity(j, label, *finder.outer_point(parts, target), ()))
    # A button's or turntable's face is a nuisance unless it is all that there is.
    followed = [e for e in unnamed if e.travel_m >= MOVES_AT_LEAST * half_diagonal_m]
    if not any(not e.fixed for e in named) and not followed:
        followed = unnamed
    fixed = [] if 0 in taken else finder.fixed_in_base(category)
    kept = sorted(named + followed, key=lambda e: (e.fixed, e.joint))
    return _with_unique_names(kept + fixed + hinges)


def _with_unique_names(entities: list[SimEntity]) -> tuple[SimEntity, ...]:
    named, count = [], Counter()
    for e in entities:
        count[e.name] += 1
        named.append(e if count[e.name] == 1 else replace(e, name=f"{e.name}_{count[e.name]}"))
    return tuple(named)


def _near_groups(meshes: list[trimesh.Trimesh], gap: float) -> list[list[int]]:
    """Groups of meshes that are connected by gaps below ``gap``."""
    points = [_sample(m, 300) for m in meshes]
    trees = [KDTree(p) for p in points]
    near = np.eye(len(meshes), dtype=bool)
    for a, b in combinations(range(len(meshes)), 2):
        near[b, a] = trees[b].query(points[a])[0].min() < gap
    count, group = connected_components(near, directed=False) if meshes else (0, np.zeros(0))
    return [np.flatnonzero(group == g).tolist() for g in range(count)]


def _sample(mesh: trimesh.Trimesh, count: int) -> Float[np.ndarray, "N 3"]:
    """Area-weighted surface samples; always the same."""
    rng = np.random.default_rng(0)
    area = np.asarray(mesh.area_faces)
    weights = area / area.sum() if area.sum() > 0 else np.full(len(area), 1 / len(area))
    face = rng.choice(len(area), size=count, p=weights)
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    corner = np.asarray(mesh.triangles)[face]
    return corner[:, 0] + u * (corner[:, 1] - corner[:, 0]) + v * (corner[:, 2] - corner[:, 0])


class _Finder:
    """Entities of an object, and the surfaces on which they lie, at rest, with what is seen of them from the front."""

    def __init__(self, articulation: Articulation, half_diagonal_m: float) -> None:
        self._articulation = articulation
        self._half_diagonal_m = half_diagonal_m
        self._poses = articulation.poses(articulation.rest)
        self._world = [p.surface.copy().apply_transform(self._poses[p.body]) for p in articulation.parts]
        azimuth, elevation = np.deg2rad(_SEEN_FROM_DEG).T
        self._scene, level = trimesh.util.concatenate(self._world), np.cos(elevation)
        self._towards = np.stack((np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)), axis=-1)

    def entity(
        self, joint: int, label: str, point: Float[np.ndarray, "3"], inside: bool, parts: tuple[int, ...]
    ) -> SimEntity:
        """An entity of a joint's body, with its travel."""
        name = f"{self._articulation.body_names[1 + joint]}/{label}"
        return SimEntity(name, label, joint, point, parts, self._articulation.travel_m(joint, point), inside)

    def fixed_in_base(self, category: str) -> list[SimEntity]:
        """What one lifts the whole thing by, in categories where that is known."""
        if category in _LIFTED_BY_HANDLE:
            return self.handles(-1)
        thing = self._articulation
        parts = thing.body_parts(0)
        lids = [j for j, joint in enumerate(thing.joints) if joint.joint.kind == "revolute" and joint.parent == 0]
        if category not in _LIFTED_BY_RIM or not parts or not lids:
            return []
        lid = max(lids, key=lambda j: sum(thing.parts[i].surface.area for i in thing.body_parts(1 + j)))
        # The middle of the base's edge farthest from the lid's axis.
        joint, pose = thing.joints[lid], thing.joints[lid].parent_from_joint
        target = self._far_edge(self._body_samples(-1) - pose[:3, 3], pose[:3, :3] @ joint.axis) + pose[:3, 3]
        return [self.entity(-1, "rim", *self.outer_point(parts, target, samples=_THIN_SAMPLES), ())]

    def placed(self, place: PlacedEntity) -> list[SimEntity]:
        """What somebody has pointed out."""
        if place.parts:
            by_body: dict[int, list[int]] = {}
            for i in place.parts:
                by_body.setdefault(self._articulation.parts[i].body, []).append(i)
            return [e for body, parts in sorted(by_body.items()) for e in self._of_parts(body - 1, place.label, parts)]
        parts, joint = self._articulation.body_parts(place.body), place.body - 1
        if not parts:
            raise ObjectError(f"{place.where}: its link has no visual that could be seen; use a link with meshes")
        if place.point is None:
            target = self.rim_target(joint) if place.label == "rim" else self.front_target(joint)
        else:
            target = place.point
        point, inside = self.outer_point(parts, target, samples=_THIN_SAMPLES)
        gap = float(np.linalg.norm(point - target))
        if place.point is not None and gap > PLACED_WITHIN * self._half_diagonal_m:
            raise ObjectError(
                f"{place.where}: the point lies {gap:.3f} m away from what can be seen of its link; give it in the "
                "link's frame and the URDF's units"
            )
        return [self.entity(joint, place.label, point, inside, ())]

    def handles(self, joint: int) -> list[SimEntity]:
        """Handles and knobs by the names of parts."""
        parts = self._articulation.body_parts(1 + joint)
        label_of = {i: part_label(self._articulation.parts[i].name) for i in parts}
        return [e for label in GRIPS for e in self._of_parts(joint, label, [i for i in parts if label_of[i] == label])]

    def _of_parts(self, joint: int, label: str, parts: list[int]) -> list[SimEntity]:
        """One entity for every group of parts of a body that are near each other."""
        found, surfaces = [], [self._articulation.parts[i].surface for i in parts]
        for group in _near_groups(surfaces, HANDLE_GAP * self._half_diagonal_m):
            area = np.concatenate([surfaces[i].area_faces for i in group])
            centres = np.concatenate([surfaces[i].triangles_center for i in group])
            target = np.average(centres, axis=0, weights=area) if area.sum() > 0 else centres.mean(axis=0)
            members = [parts[i] for i in group]
            found.append(self.entity(joint, label, *self.outer_point(members, target), tuple(members)))
        return found

    def outer_point(
        self, parts: list[int], target: Float[np.ndarray, "3"], *, samples: int = 2 * _SAMPLES
    ) -> tuple[Float[np.ndarray, "3"], bool]:
        """The outer surface sample of some parts that is nearest to a target, both in their body's frame.

        Also tells whether it is inside: whether nothing near the target can be seen from the front.
        """
        body = self._articulation.parts[parts[0]].body
        area = np.array([max(self._world[i].area, 1e-12) for i in parts])
        counts = np.maximum(20, np.ceil(samples * area / area.sum())).astype(int)
        points = np.concatenate([_sample(self._world[i], int(n)) for i, n in zip(parts, counts, strict=True)])
        goal = apply(self._poses[body], target)
        # Rays are cast for the samples nearest to the target only: they decide.
        points = points[np.argsort(np.linalg.norm(points - goal, axis=1), kind="stable")[:_SAMPLES]]
        seen = self._seen_share(points, self._scene)
        inside = bool(seen.max() == 0)
        if inside:  # the closed object: judge the body alone, as it will look when pulled out
            own = [self._world[i] for i in self._articulation.body_parts(body)]
            seen = self._seen_share(points, trimesh.util.concatenate(own))
        points = points[seen >= 0.5 * seen.max()]
        nearest = points[np.argmin(np.linalg.norm(points - goal, axis=1))]
        return apply(np.linalg.inv(self._poses[body]), nearest), inside

    def _seen_share(self, points: Float[np.ndarray, "N 3"], mesh: Any) -> Float[np.ndarray, " N"]:
        """From which share of the directions towards the cameras nothing of a mesh is in front of each point."""
        origin = points[:, None] + 2e-3 * self._half_diagonal_m * self._towards
        direction = np.broadcast_to(self._towards, origin.shape)
        hit = mesh.ray.intersects_any(origin.reshape(-1, 3), direction.reshape(-1, 3))
        return 1.0 - np.asarray(hit).reshape(len(points), -1).mean(axis=1)

    def _body_samples(self, joint: int) -> Float[np.ndarray, "N 3"]:
        parts = self._articulation.body_parts(1 + joint)
        vertices = self._articulation.body_points[1 + joint]
        return np.concatenate([vertices, *(_sample(self._articulation.parts[i].surface, 200) for i in parts)])

    def rim_target(self, joint: int) -> Float[np.ndarray, "3"]:
        """Middle of the edge farthest from the axis, in the body's frame (whose origin lies on the axis)."""
        return self._far_edge(self._body_samples(joint), self._articulation.joints[joint].axis)

    def _far_edge(self, points: Float[np.ndarray, "N 3"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Middle of the edge of points that is farthest from an axis through the origin."""
        along = points @ axis
        radial = points - along[:, None] * axis
        radius = np.linalg.norm(radial, axis=1)
        edge = radius >= radius.max() - 0.03 * self._half_diagonal_m
        middle = (along[edge].min() + along[edge].max()) / 2
        return np.median(radial[edge], axis=0) + middle * axis

    def front_target(self, joint: int) -> Float[np.ndarray, "3"]:
        """Middle of the face that the body moves towards, in the body's frame."""
        points = self._body_samples(joint)
        moving = self._articulation.joints[joint]
        towards = moving.axis if moving.opening() >= 0 else -moving.axis
        along = points @ towards
        face = points[along >= along.max() - 0.05 * self._half_diagonal_m]
        middle = (face.min(axis=0) + face.max(axis=0)) / 2
        return middle + (along.max() - middle @ towards) * towards

    def hinge_point(self, joint: int) -> Float[np.ndarray, "3"]:
        """Middle of the body's extent along the axis, on the axis, in the body's frame."""
        axis = self._articulation.joints[joint].axis
        along = self._articulation.body_points[1 + joint] @ axis
        return (along.min() + along.max()) / 2 * axis
