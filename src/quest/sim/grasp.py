"""How a parallel-jaw gripper takes hold of an entity: found by trying, on samples of the object's surface.

Candidates differ in the direction that the gripper comes from, in the angle between its fingers and in how deep it
reaches. A pinch has the entity between the pads; where nothing fits between them (a drawer's flush front), closed
fingers touch it from outside, as a suction cup would. The best candidate meets nothing of the object on its straight
way in, nor while the joint moves, pulls in the direction of the motion and has little between its fingers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float

from quest.errors import ObjectError
from quest.sim.articulation import Articulation, apply
from quest.sim.entities import SimEntity
from quest.sim.gripper_shape import LENGTH_M, OPENING_M, PAD_HALF_M, Boxes
from quest.sim.objects import SimObject

_FULL_SIZE_M = 0.3
"""Objects with at least this half diagonal meet a gripper of full size, smaller ones a smaller one."""
_SMALLEST = 0.2
_SAMPLES = 40000
_OWN_SAMPLES = 3000
_REACHES_M = (0.016, 0.009, 0.003)
_ANGLES = 8
_CLEARANCE_M = 0.014
"""Between an open finger and what it will pinch."""
_BLOCKED_CM2 = 5.0
"""With so much of the object's surface in the way of a gripper of full size, a grasp is none."""
_TOUCH_COST = 0.7
_COST_PER_CM2 = 0.1
_FLOOR_CM2 = 8.0
"""A gripper that meets the floor is worth as much as this in its way."""
_WAY_IN_M = 0.3
"""The straight way that has to be free."""
_SIDES = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, -1, 0], [1, 0, 1], [1, 1, 0], [1, -1, 0]], dtype=float)


def gripper_scale(half_diagonal_m: float) -> float:
    """Size of the gripper for an object: 1 for furniture, less for what is small."""
    return float(np.clip(half_diagonal_m / _FULL_SIZE_M, _SMALLEST, 1.0))


@dataclass(frozen=True)
class Grasp:
    """How an entity is held.

    Attributes:
        entity: what is held.
        body_from_gripper: where the gripper is then.
        width_m: distance between its pads then; 0 if closed fingers touch.
        open_m: distance between its pads as it comes and goes.
        back_m: how far it goes straight back to be clear of the object.
    """

    entity: SimEntity
    body_from_gripper: Float[np.ndarray, "4 4"]
    width_m: float
    open_m: float
    back_m: float


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


def find_grasp(
    sim_object: SimObject,
    entity: SimEntity,
    samples: ObjectSamples,
    motion: Float[np.ndarray, "M B 4 4"],
) -> tuple[Grasp, float]:
    """The best way to hold an entity while its joint moves, and what it costs: below 1 is good.

    Args:
        sim_object: the object.
        entity: what to hold.
        samples: of the object's surface.
        motion: poses of the bodies at some moments: when the gripper comes, while the joint moves, at its end.

    Raises:
        ObjectError: everything that was tried is blocked by the object itself.
    """
    search = _Search(sim_object, entity, samples, motion)
    best: tuple[float, _Candidate] | None = None
    for least, candidate in sorted(((search.least_cost(c), c) for c in search.candidates()), key=lambda pair: pair[0]):
        if best is not None and least >= best[0]:
            break
        cost = least + _COST_PER_CM2 * search.in_the_way(candidate, np.inf if best is None else best[0] - least)
        if best is None or cost < best[0]:
            best = (cost, candidate)
    if best is None or search.in_the_way(best[1]) > _BLOCKED_CM2:
        raise ObjectError(
            f"{sim_object.object_id}: expected {entity.name} within a gripper's reach, found every way to it blocked "
            "by the object itself; let another joint move first, or leave the gripper away"
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
        self, sim_object: SimObject, entity: SimEntity, samples: ObjectSamples, motion: Float[np.ndarray, "M B 4 4"]
    ) -> None:
        self._scale = gripper_scale(sim_object.half_diagonal_m)
        self._entity, self._motion = entity, motion
        start, body = motion[0], entity.body
        self._point = apply(start[body], entity.point)
        path = np.array([apply(pose[body], entity.point) for pose in motion])
        self._pull = _unit(path[1:] - path[0])
        self._own = apply(start[body], samples.of(entity)) - self._point
        joint = sim_object.articulation.joints[entity.joint]
        line = sim_object.articulation.axes(start)[entity.joint]
        self._axis, self._radial = line[3:], None
        if joint.joint.kind == "revolute":
            arm = self._point - line[:3]
            self._radial = _unit([arm - (arm @ line[3:]) * line[3:]])
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
        """Those that the gripper might meet, with areas in cm^2 for a gripper of full size."""
        far = self._scale * (LENGTH_M + _WAY_IN_M + OPENING_M)
        near = ((points - self._point) ** 2).sum(axis=1) < far**2
        return points[near], 1e4 / self._scale**2 * area_m2[near]

    def _preferred(self) -> list[Float[np.ndarray, "3"]]:
        """Where the gripper should come from: where the entity is pulled to, or the free side of an edge.

        Knobs are turned from the front.
        """
        front = np.array([1.0, 0.0, 0.0])
        if self._radial is None:
            return [self._pull]
        if self._entity.label == "knob":
            along = self._axis * np.sign(self._axis @ front)
            return [_unit([along if np.abs(self._axis @ front) > 0.3 else front])]
        return [self._pull, self._radial] if self._entity.label == "rim" else [self._pull]

    def _directions(self) -> list[Float[np.ndarray, "3"]]:
        """Unit vectors from the entity towards where the gripper comes from."""
        wanted = [*self._wanted, self._pull, *_SIDES]
        if self._radial is not None:
            wanted += [self._radial, self._radial + self._pull, self._axis, -self._axis]
        found: list[np.ndarray] = []
        for vector in wanted:
            unit = _unit([vector])
            if np.linalg.norm(unit) > 0.5 and all(unit @ other < 0.98 for other in found):
                found.append(unit)
        return found

    def candidates(self) -> Iterator[_Candidate]:
        for outward in self._directions():
            for finger in self._finger_axes(outward):
                yield from self._pinches(outward, finger)
            yield self._touch(outward)

    def _finger_axes(self, outward: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "3"]]:
        """Directions across the gripper: half a turn in steps, from the narrow side of what is there."""
        near = self._own[np.linalg.norm(self._own, axis=1) < 0.06 * self._scale]
        flat = near - np.outer(near @ outward, outward)
        _, _, axes = np.linalg.svd(flat - flat.mean(axis=0) if len(flat) > 3 else np.eye(3), full_matrices=False)
        first = axes[0] - (axes[0] @ outward) * outward
        if np.linalg.norm(first) < 1e-6:
            first = np.cross(outward, np.eye(3)[np.abs(outward).argmin()])
        first = _unit([first])
        second = np.cross(outward, first)
        angles = np.pi * np.arange(_ANGLES) / _ANGLES
        return [np.cos(a) * first + np.sin(a) * second for a in angles]

    def _pinches(self, outward: Float[np.ndarray, "3"], finger: Float[np.ndarray, "3"]) -> Iterator[_Candidate]:
        s = self._scale
        rotation = np.stack((np.cross(finger, outward), finger, outward), axis=1)
        local = self._own @ rotation
        half_x, _, half_z = (s * v for v in PAD_HALF_M)
        near = (np.abs(local[:, 0]) < half_x) & (np.abs(local[:, 1]) < 0.6 * s * OPENING_M)
        local = local[near & (np.abs(local[:, 2]) < 0.6 * s * OPENING_M)]
        if len(local) < 4:
            return
        top = local[:, 2].max()
        for reach in _REACHES_M:
            middle = top - s * reach
            held = local[np.abs(local[:, 2] - middle) < half_z, 1]
            if len(held) < 4:
                continue
            low, high = float(held.min()), float(held.max())
            if high - low > 0.85 * s * OPENING_M:
                continue
            pose = np.eye(4)
            pose[:3, :3] = rotation
            pose[:3, 3] = self._point + rotation @ [0.0, (low + high) / 2, middle]
            width = high - low
            opened = min(width + 2 * s * _CLEARANCE_M, s * OPENING_M)
            yield _Candidate(pose, width, opened, reach / _REACHES_M[0], touches=False)

    def _touch(self, outward: Float[np.ndarray, "3"]) -> _Candidate:
        finger = self._finger_axes(outward)[0]
        pose = np.eye(4)
        pose[:3, :3] = np.stack((np.cross(finger, outward), finger, outward), axis=1)
        pose[:3, 3] = self._point + (self._scale * PAD_HALF_M[2] + 0.0005) * outward
        return _Candidate(pose, 0.0, 0.0, 0.0, touches=True)

    def least_cost(self, candidate: _Candidate) -> float:
        """What speaks against a candidate, if nothing is in its way."""
        outward = candidate.world_from_gripper[:3, 2]
        aligned = max(float(outward @ wanted) for wanted in self._wanted)
        cost = 1.0 * (1 - aligned) + 0.25 * (1 - outward[0]) - 0.3 * candidate.reach
        if not candidate.touches:
            return cost + candidate.width_m / (self._scale * OPENING_M)
        return cost if self._entity.label == "front" else cost + _TOUCH_COST

    def in_the_way(self, candidate: _Candidate, enough: float = np.inf) -> float:
        """Surface that a gripper of full size would meet, coming, holding and moving, cm^2; more if it meets the floor.

        Stops counting where its cost exceeds ``enough``.
        """
        inverse, shrink = np.linalg.inv(candidate.world_from_gripper), 0.0015 * self._scale
        coming = Boxes.of(self._scale, candidate.open_m, shrink_m=shrink).swept(_WAY_IN_M * self._scale)
        met = _FLOOR_CM2 if apply(candidate.world_from_gripper, coming.corners)[:, 2].min() < -0.002 else 0.0
        boxes = Boxes.of(self._scale, candidate.width_m, shrink_m=shrink)
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
            np.linalg.inv(self._motion[0][self._entity.body]) @ pose,
            candidate.width_m,
            candidate.open_m,
            max(back, 0.12 * self._scale),
        )


def _unit(vectors: Float[np.ndarray, "N 3"] | list) -> Float[np.ndarray, "3"]:
    """Direction of the first of some vectors that has one; zero if none has."""
    for vector in np.asarray(vectors, float):
        length = np.linalg.norm(vector)
        if length > 1e-9:
            return vector / length
    return np.zeros(3)
