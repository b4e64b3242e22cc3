"""How a tool takes hold of an entity, found by trying, on samples of the object's surface.

A tool is what pulls in a take: a gripper, or a hand in one of its grips. Its frame lies where it holds: x across what
holds, y from one finger to the other, z from the fingertips back to the palm.

Candidates differ in the direction that the tool comes from, in the angle between its fingers and in how deep it
reaches. A pinch has the entity between the fingers; where nothing fits between them (a drawer's flush front), their
tips touch it from outside, as a suction cup would. The best candidate meets nothing of the object on its straight way
in, nor while the joint moves, pulls in the direction of the motion and has little between its fingers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int

from quest.errors import ObjectError
from quest.sim.articulation import Articulation, apply
from quest.sim.entities import SimEntity
from quest.sim.objects import SimObject


@dataclass(frozen=True)
class Boxes:
    """Boxes along the axes of a gripper's frame."""

    low: Float[np.ndarray, "P 3"]
    """Smallest coordinates, metres."""
    high: Float[np.ndarray, "P 3"]
    """Largest coordinates, metres."""

    def swept(self, back_m: float) -> Boxes:
        """What they pass on a straight way back, along z."""
        high = self.high.copy()
        high[:, 2] += back_m
        return Boxes(self.low, high)

    def hit(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " M"]:
        """Indices of the points that lie inside."""
        about = np.flatnonzero(((points > self.low.min(axis=0)) & (points < self.high.max(axis=0))).all(axis=1))
        near = points[about, None]
        inside = ((near > self.low) & (near < self.high)).all(axis=2)
        return about[np.logical_or.reduce(inside, axis=1)]

    @property
    def corners(self) -> Float[np.ndarray, "N 3"]:
        """All their corners."""
        pick = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
        bounds = np.stack((self.low, self.high))
        return np.concatenate([bounds[pick[:, axis], :, axis].reshape(-1, 1) for axis in range(3)], axis=1)


CLEARANCE_M = 0.014
"""Between an open finger and what it will pinch, at scale 1."""


@dataclass(frozen=True)
class Tool(ABC):
    """What the search and the ways have to know of what pulls. Lengths are those at scale 1."""

    noun: str
    """What messages call it."""
    scale: float
    """Its size for an object."""
    pad_half_m: tuple[float, float, float]
    """Half extents of what touches, along x, y, z."""
    span_share: float
    """Least share of the pads' length along x that an entity has to span to be pinched."""
    opening_m: float
    """Largest distance between its fingers."""
    length_m: float
    """From where it holds to its far end."""
    reaches_m: tuple[float, ...]
    """How far behind the entity's nearest point it may hold, the best first; empty if it does not pinch."""
    touches: bool
    """Whether it may touch from outside."""
    touch_open_m: float
    """Distance between its fingers as it comes to touch and goes, at its own scale."""
    turns: tuple[float, ...]
    """Angles about z that it may hold at, radians; the first ones of half a turn if its sides are alike."""
    touch_turns: int
    """How many of them it may touch at."""
    sides_alike: bool
    """Whether it is the same after half a turn about z."""
    exits: tuple[tuple[int, int], ...]
    """World axis and sign of the ways on which it may leave the picture."""
    exit_back: float
    """How far it moves back along z on such a way, for each metre aside."""

    @abstractmethod
    def boxes(
        self, world_from_gripper: Float[np.ndarray, "4 4"], width_m: float, opening_m: float, *, shrink_m: float = 0.0
    ) -> Boxes:
        """Boxes that it fills, in its frame, each smaller by ``shrink_m`` on all sides.

        ``width_m`` is the distance between its fingers when it holds, ``opening_m`` the distance now.
        """

    def aversion(self, world_from_gripper: Float[np.ndarray, "M 4 4"], entity: SimEntity) -> float:
        """What speaks against holding an entity so, beside all that holds for every tool; 0 for no matter.

        Where the tool is at some moments tells how the entity takes it along.
        """
        return 0.0


_SAMPLES = 40000
_OWN_SAMPLES = 3000
_BLOCKED_CM2 = 5.0
"""With so much of the object's surface in the way of a tool of full size, a grasp is none."""
_TOUCH_COST = 0.7
_COST_PER_CM2 = 0.1
_FLOOR_CM2 = 8.0
"""A tool that meets the floor is worth as much as this in its way."""
_WAY_IN_M = 0.3
"""The straight way that has to be free."""
_SIDES = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 1], [1, 1, 0], [1, -1, 0]], dtype=float)


@dataclass(frozen=True)
class Grasp:
    """How an entity is held."""

    entity: SimEntity
    tool: Tool
    """What holds it."""
    body_from_gripper: Float[np.ndarray, "4 4"]
    """Where the tool is then."""
    width_m: float
    """Distance between its fingers then; 0 if they touch from outside."""
    open_m: float
    """Distance between its fingers as it comes and goes."""
    back_m: float
    """How far it goes straight back to be clear of the object."""


class ObjectSamples:
    """Points on the surface of an object, per body; always the same."""

    def __init__(self, articulation: Articulation) -> None:
        self._articulation = articulation
        area = np.array([sum(p.surface.area for p in self._parts(b)) for b in range(len(articulation.body_names))])
        counts = np.maximum(400, _SAMPLES * area / max(area.sum(), 1e-12)).astype(int)
        self.bodies = [self._sample(self._parts(b), int(n)) for b, n in enumerate(counts)]
        self._area_m2 = [a / max(len(points), 1) for a, points in zip(area, self.bodies, strict=True)]

    def of(self, entity: SimEntity) -> Float[np.ndarray, "N 3"]:
        """Points on an entity's own parts, in its body; on the whole body if it has none."""
        parts = [self._articulation.parts[i] for i in entity.parts] or self._parts(entity.body)
        return self._sample(parts, _OWN_SAMPLES if entity.parts else 4 * _OWN_SAMPLES)

    def world(self, poses: Float[np.ndarray, "B 4 4"], *, without: int | None = None) -> Float[np.ndarray, "N 3"]:
        """Points on all bodies, or on all but one."""
        kept = [apply(poses[b], points) for b, points in enumerate(self.bodies) if b != without]
        return np.concatenate([np.zeros((0, 3)), *kept])

    def area_m2(self, *, without: int | None = None) -> Float[np.ndarray, " N"]:
        """How much of the surface each of the points of :meth:`world` stands for."""
        kept = [np.full(len(points), self._area_m2[b]) for b, points in enumerate(self.bodies) if b != without]
        return np.concatenate([np.zeros(0), *kept])

    def _parts(self, body: int) -> list:
        return [self._articulation.parts[i] for i in self._articulation.body_parts(body)]

    @staticmethod
    def _sample(parts: list, count: int) -> Float[np.ndarray, "N 3"]:
        meshes = [p.surface for p in parts if p.surface.area > 0]
        if not meshes:
            return np.concatenate([np.zeros((0, 3)), *(np.asarray(p.surface.vertices) for p in parts)])
        return np.asarray(trimesh.sample.sample_surface(trimesh.util.concatenate(meshes), count, seed=0)[0])


def search_grasp(
    tool: Tool,
    sim_object: SimObject,
    entity: SimEntity,
    samples: ObjectSamples,
    motion: Float[np.ndarray, "M B 4 4"],
) -> tuple[Grasp, float]:
    """The best way to hold an entity while its joint moves, and what it costs: below 1 is good.

    ``motion`` holds poses of the bodies at some moments: when the tool comes, while the joint moves, at its end.

    Raises:
        ObjectError: everything that was tried is blocked by the object itself.
    """
    search = _Search(tool, sim_object, entity, samples, motion)
    best: tuple[float, _Candidate] | None = None
    for least, candidate in sorted(((search.least_cost(c), c) for c in search.candidates()), key=lambda pair: pair[0]):
        if best is not None and least >= best[0]:
            break
        cost = least + _COST_PER_CM2 * search.in_the_way(candidate, np.inf if best is None else best[0] - least)
        if best is None or cost < best[0]:
            best = (cost, candidate)
    if best is None or search.in_the_way(best[1]) > _BLOCKED_CM2:
        raise ObjectError(
            f"{sim_object.object_id}: expected {entity.name} within a {tool.noun}'s reach, found every way to it "
            f"blocked by the object itself; let another joint move first, or leave the {tool.noun} away"
        )
    return search.grasp(best[1]), best[0]


@dataclass(frozen=True)
class _Candidate:
    world_from_gripper: Float[np.ndarray, "4 4"]
    width_m: float
    open_m: float
    reach: float
    touches: bool


class _Search:
    """Everything that the candidates for one entity have in common."""

    def __init__(
        self,
        tool: Tool,
        sim_object: SimObject,
        entity: SimEntity,
        samples: ObjectSamples,
        motion: Float[np.ndarray, "M B 4 4"],
    ) -> None:
        self._tool, self._scale = tool, tool.scale
        self._entity, self._motion = entity, motion
        start, body = motion[0], entity.body
        self._point = apply(start[body], entity.point)
        path = np.array([apply(pose[body], entity.point) for pose in motion])
        self._taken = motion[:, body] @ np.linalg.inv(start[body])
        self._pull = unit(path[1:] - path[0])
        self._own = apply(start[body], samples.of(entity)) - self._point
        joint = sim_object.articulation.joints[entity.joint]
        line = sim_object.articulation.axes(start)[entity.joint]
        self._axis, self._radial = line[3:], None
        if joint.joint.kind == "revolute":
            arm = self._point - line[:3]
            self._radial = unit([arm - (arm @ line[3:]) * line[3:]])
        self._extent = samples.world(start)
        self._all = self._near(self._extent, samples.area_m2())
        # What does not move along must not be in the way later.
        area_m2 = samples.area_m2(without=body)
        self._others = []
        for poses in motion[1 :: max(1, (len(motion) - 1) // 5)]:
            back = start[body] @ np.linalg.inv(poses[body])
            self._others.append(self._near(apply(back, samples.world(poses, without=body)), area_m2))
        self._wanted = self._preferred()

    def _near(
        self, points: Float[np.ndarray, "N 3"], area_m2: Float[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, " M"]]:
        """Those that the tool might meet, with areas in cm^2 for a tool of full size."""
        far = self._scale * (self._tool.length_m + _WAY_IN_M + self._tool.opening_m)
        near = ((points - self._point) ** 2).sum(axis=1) < far**2
        return points[near], 1e4 / self._scale**2 * area_m2[near]

    def _preferred(self) -> list[Float[np.ndarray, "3"]]:
        """Where the tool should come from: where the entity is pulled to, or the free side of an edge.

        Knobs are turned from the front.
        """
        front = np.array([1.0, 0.0, 0.0])
        if self._radial is None:
            return [self._pull]
        if self._entity.label == "knob":
            along = self._axis * np.sign(self._axis @ front)
            return [unit([along if np.abs(self._axis @ front) > 0.3 else front])]
        return [self._pull, self._radial] if self._entity.label == "rim" else [self._pull]

    def _directions(self) -> list[Float[np.ndarray, "3"]]:
        """Unit vectors from the entity towards where the tool comes from."""
        wanted = [*self._wanted, self._pull, *_SIDES]
        if self._radial is not None:
            wanted += [self._radial, self._radial + self._pull, self._axis, -self._axis]
        found: list[np.ndarray] = []
        for vector in wanted:
            towards = unit([vector])
            if np.linalg.norm(towards) > 0.5 and all(towards @ other < 0.98 for other in found):
                found.append(towards)
        return found

    def candidates(self) -> Iterator[_Candidate]:
        for outward in self._directions():
            for finger in self._finger_axes(outward):
                yield from self._pinches(outward, finger)
            if self._tool.touches:
                for finger in self._finger_axes(outward)[: self._tool.touch_turns]:
                    yield self._touch(outward, finger)

    def _finger_axes(self, outward: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "3"]]:
        """Directions between the fingers: in steps, from the narrow side of what is there."""
        near = self._own[np.linalg.norm(self._own, axis=1) < 0.06 * self._scale]
        flat = near - np.outer(near @ outward, outward)
        _, _, axes = np.linalg.svd(flat - flat.mean(axis=0) if len(flat) > 3 else np.eye(3), full_matrices=False)
        first = axes[0] - (axes[0] @ outward) * outward
        if np.linalg.norm(first) < 1e-6:
            first = np.cross(outward, np.eye(3)[np.abs(outward).argmin()])
        first = unit([first])
        second = np.cross(outward, first)
        return [np.cos(a) * first + np.sin(a) * second for a in self._tool.turns]

    def _pinches(self, outward: Float[np.ndarray, "3"], finger: Float[np.ndarray, "3"]) -> Iterator[_Candidate]:
        s = self._scale
        rotation = np.stack((np.cross(finger, outward), finger, outward), axis=1)
        local = self._own @ rotation
        half_x, _, half_z = (s * v for v in self._tool.pad_half_m)
        near = (np.abs(local[:, 0]) < half_x) & (np.abs(local[:, 1]) < 0.6 * s * self._tool.opening_m)
        local = local[near & (np.abs(local[:, 2]) < 0.6 * s * self._tool.opening_m)]
        if len(local) < 4 or np.ptp(local[:, 0]) < 2 * half_x * self._tool.span_share:
            return
        top = local[:, 2].max()
        for reach in self._tool.reaches_m:
            middle = top - s * reach
            held = local[np.abs(local[:, 2] - middle) < half_z, 1]
            if len(held) < 4:
                continue
            low, high = float(held.min()), float(held.max())
            if high - low > 0.85 * s * self._tool.opening_m:
                continue
            pose = np.eye(4)
            pose[:3, :3] = rotation
            pose[:3, 3] = self._point + rotation @ [0.0, (low + high) / 2, middle]
            width = high - low
            opened = min(width + 2 * s * CLEARANCE_M, s * self._tool.opening_m)
            yield _Candidate(pose, width, opened, reach / self._tool.reaches_m[0], touches=False)

    def _touch(self, outward: Float[np.ndarray, "3"], finger: Float[np.ndarray, "3"]) -> _Candidate:
        pose = np.eye(4)
        pose[:3, :3] = np.stack((np.cross(finger, outward), finger, outward), axis=1)
        pose[:3, 3] = self._point + (self._scale * self._tool.pad_half_m[2] + 0.0005) * outward
        return _Candidate(pose, 0.0, self._tool.touch_open_m, 0.0, touches=True)

    def least_cost(self, candidate: _Candidate) -> float:
        """What speaks against a candidate, if nothing is in its way."""
        outward = candidate.world_from_gripper[:3, 2]
        aligned = max(float(outward @ wanted) for wanted in self._wanted)
        cost = 1.0 * (1 - aligned) + 0.25 * (1 - outward[0]) - 0.3 * candidate.reach
        cost += self._tool.aversion(self._taken @ candidate.world_from_gripper, self._entity)
        if not candidate.touches:
            return cost + candidate.width_m / (self._scale * self._tool.opening_m)
        return cost if self._entity.label == "front" else cost + _TOUCH_COST

    def in_the_way(self, candidate: _Candidate, enough: float = np.inf) -> float:
        """Surface that a tool of full size would meet, coming, holding and moving, cm^2; more if it meets the floor.

        Stops counting where its cost exceeds ``enough``.
        """
        pose, shrink = candidate.world_from_gripper, 0.0015 * self._scale
        inverse, width = np.linalg.inv(pose), candidate.width_m
        coming = self._tool.boxes(pose, width, candidate.open_m, shrink_m=shrink).swept(_WAY_IN_M * self._scale)
        met = _FLOOR_CM2 if apply(pose, coming.corners)[:, 2].min() < -0.002 else 0.0
        boxes = self._tool.boxes(pose, width, width, shrink_m=shrink)
        looks = [(coming, *self._all, 1.0), (boxes, *self._all, 1.0)]
        looks += [(boxes, *others, 1 / len(self._others)) for others in self._others]
        for volume, points, area_cm2, weight in looks:
            if _COST_PER_CM2 * met > enough:
                break
            met += weight * float(area_cm2[volume.hit(apply(inverse, points))].sum())
        return met

    def grasp(self, candidate: _Candidate) -> Grasp:
        """The chosen candidate, fixed in the entity's body."""
        pose = candidate.world_from_gripper
        ahead = apply(np.linalg.inv(pose), self._extent)[:, 2].max()
        back = float(np.clip(ahead, 0.0, 0.8)) + 0.06 * self._scale
        return Grasp(
            self._entity,
            self._tool,
            np.linalg.inv(self._motion[0][self._entity.body]) @ pose,
            candidate.width_m,
            candidate.open_m,
            max(back, 0.12 * self._scale),
        )


def unit(vectors: Float[np.ndarray, "N 3"] | list) -> Float[np.ndarray, "3"]:
    """Direction of the first of some vectors that has one; zero if none has."""
    for vector in np.asarray(vectors, float):
        length = np.linalg.norm(vector)
        if length > 1e-9:
            return vector / length
    return np.zeros(3)
