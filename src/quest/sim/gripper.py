"""A gripper that comes, takes hold of what is to move, moves with it, lets go and leaves: a prop of a take.

Its frame lies between the pads: x across them, y from one finger to the other, z from the fingertips back to the palm.
Sizes at scale 1 are those of common electric grippers (Franka Hand, Robotiq 2F-85): it opens to 85 mm.

How it takes hold of an entity is found by trying, on samples of the object's surface. Candidates differ in the
direction that the gripper comes from, in the angle between its fingers and in how deep it reaches. A pinch has the
entity between the pads; where nothing fits between them (a drawer's flush front), closed fingers touch it from outside,
as a suction cup would. The best candidate meets nothing of the object on its straight way in, nor while the joint
moves, pulls in the direction of the motion and has little between its fingers.

While a joint moves the gripper is fixed in the link that it holds. In the frames before and after, it goes in straight
lines along its own axis, and around the object from one link to the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import Articulation, apply
from quest.sim.entities import SimEntity
from quest.sim.motion import FRAMES_PER_S, MotionStyle, Share, minimum_jerk, share_plan
from quest.sim.objects import SimObject
from quest.sim.props import Occluder, Shape
from quest.sim.surfaces import Surface, sample_colour, sample_handle_surface

OPENING_M = 0.085
PAD_HALF_M = (0.010, 0.003, 0.012)
REACH_M = 0.044
"""From the middle of the pads back to the palm."""
LENGTH_M = 0.245
"""From the middle of the pads to the end of the wrist."""

Material = Literal["shell", "metal", "rubber"]


@dataclass(frozen=True)
class GripperPart:
    """A box, or a cylinder along z."""

    kind: Literal["box", "cylinder"]
    material: Material
    half_m: tuple[float, float, float]
    """Half extents along x, y, z."""
    centre_m: tuple[float, float, float]
    """Middle; a finger's with its jaw closed."""
    side: int = 0
    """-1 or 1 if it moves with the finger on that side along y, else 0."""


def _finger(side: int) -> tuple[GripperPart, ...]:
    x, y, z = PAD_HALF_M
    return (
        GripperPart("box", "rubber", (x, y, z), (0.0, side * y, 0.0), side),
        GripperPart("box", "metal", (0.009, 0.004, 0.028), (0.0, side * (2 * y + 0.004), 0.017), side),
        GripperPart("box", "metal", (0.012, 0.009, 0.008), (0.0, side * (2 * y + 0.007), REACH_M - 0.008), side),
    )


GRIPPER_PARTS = (
    *_finger(-1),
    *_finger(1),
    GripperPart("box", "rubber", (0.016, 0.066, 0.003), (0.0, 0.0, REACH_M + 0.003)),
    GripperPart("box", "shell", (0.026, 0.070, 0.027), (0.0, 0.0, REACH_M + 0.033)),
    GripperPart("cylinder", "metal", (0.034, 0.034, 0.010), (0.0, 0.0, REACH_M + 0.070)),
    GripperPart("cylinder", "rubber", (0.028, 0.028, 0.004), (0.0, 0.0, REACH_M + 0.084)),
    GripperPart("cylinder", "shell", (0.033, 0.033, 0.0565), (0.0, 0.0, LENGTH_M - 0.0565)),
)
"""The parts at scale 1 with closed jaws."""


@dataclass(frozen=True)
class Boxes:
    """Boxes along the axes of a gripper's frame, one a part."""

    low: Float[np.ndarray, "P 3"]
    """Smallest coordinates, metres."""
    high: Float[np.ndarray, "P 3"]
    """Largest coordinates, metres."""

    @classmethod
    def of(cls, scale: float, opening_m: float, *, shrink_m: float = 0.0) -> Boxes:
        """Those of a gripper with some distance between its pads, each smaller by ``shrink_m`` on all sides."""
        centre = scale * np.array([p.centre_m for p in GRIPPER_PARTS])
        centre[:, 1] += opening_m / 2 * np.array([p.side for p in GRIPPER_PARTS])
        half = scale * np.array([p.half_m for p in GRIPPER_PARTS]) - shrink_m
        return cls(centre - half, centre + half)

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


def sample_gripper_surfaces(rng: np.random.Generator) -> dict[Material, Surface]:
    """Draw what a gripper looks like: a shell in white, grey, black or paint, metal fingers, black rubber."""
    kind, grey = rng.choice(3, p=(0.45, 0.3, 0.25)), float(rng.uniform(0.75, 0.95))
    dark = float(rng.uniform(0.08, 0.25))
    colour = ((grey, grey, grey), (dark, dark, dark), sample_colour(rng))[int(kind)]
    shell = Surface(colour, float(rng.uniform(0.35, 0.7)), 0.0, float(rng.uniform(0.2, 0.5)))
    rubber = Surface((0.07, 0.07, 0.075), 0.9, 0.0, 0.15)
    return {"shell": shell, "metal": sample_handle_surface(rng), "rubber": rubber}


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
    """How an entity is held."""

    entity: SimEntity
    body_from_gripper: Float[np.ndarray, "4 4"]
    """Where the gripper is then."""
    width_m: float
    """Distance between its pads then; 0 if closed fingers touch."""
    open_m: float
    """Distance between its pads as it comes and goes."""
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


def find_grasp(
    sim_object: SimObject,
    entity: SimEntity,
    samples: ObjectSamples,
    motion: Float[np.ndarray, "M B 4 4"],
) -> tuple[Grasp, float]:
    """The best way to hold an entity while its joint moves, and what it costs: below 1 is good.

    ``motion`` holds poses of the bodies at some moments: when the gripper comes, while the joint moves, at its end.

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


_BEFORE, _AFTER = 8, 5
"""Frames that the gripper needs at least, to come and to go."""
_CLOSING = (3, 6)
_FASTEST_M_PER_S = 1.6
_MOMENTS = 7
_STRAYS = 0.03
"""Share of its travel by which a joint may move while nothing holds it (an engine lags behind its script)."""


@dataclass(frozen=True)
class Gripper:
    """A gripper that moves; a prop."""

    parts: tuple[Occluder, ...]
    grasps: tuple[tuple[str, int, int], ...]
    """Name of every entity that it holds, the first frame and the frame after the last."""

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene``; returns the entities that :meth:`place` moves."""
        return [part.add(scene) for part in self.parts]

    def place(self, actors: Any, frame: int) -> None:
        """Move its entities to where they are at a frame of the script."""
        for actor, part in zip(actors, self.parts, strict=True):
            part.place(actor, frame)

    def pose(self, frame: int) -> Float[np.ndarray, "P 4 4"]:
        """Where its parts are at a frame of the script."""
        return np.stack([part.world_from_shape[frame] for part in self.parts])


def plan_gripper(
    sim_object: SimObject,
    script: Float[np.ndarray, "S J"],
    moved_joints: tuple[int, ...],
    *,
    margin: tuple[int, int],
    frames_per_joint: int,
    rng: np.random.Generator,
) -> Gripper:
    """A gripper that pulls one joint after the other.

    Args:
        sim_object: the object.
        script: joint positions at every frame, as played.
        moved_joints: joints that move, in order.
        margin: frames at the start and at the end of each joint's share in which it does not move.
        frames_per_joint: length of a share.
        rng: what its looks and its ways are drawn from.

    Raises:
        ConfigError: the margins leave it no time, or joints move outside of their shares.
        ObjectError: something that moves can be grasped nowhere.
    """
    shares = share_plan(moved_joints, frames_per_joint=frames_per_joint, style=MotionStyle(margin=margin))
    _check_time(sim_object, script, shares, margin)
    poses = sim_object.articulation.poses(script)
    samples = ObjectSamples(sim_object.articulation)
    grasps = [_grasp(sim_object, share, samples, poses) for share in shares]
    surfaces, scale = sample_gripper_surfaces(rng), gripper_scale(sim_object.half_diagonal_m)
    gripper, opening = _Way(sim_object, poses, rng).through(shares, grasps)
    parts = []
    for part in GRIPPER_PARTS:
        local = np.tile(np.eye(4), (len(script), 1, 1))
        local[:, :3, 3] = scale * np.array(part.centre_m)
        local[:, 1, 3] += part.side * opening / 2
        half = scale * np.array(part.half_m)
        if part.kind == "cylinder":  # whose axis is x
            local[:, :3, :3], half = _ALONG_Z, half[[2, 0, 1]]
        parts.append(Occluder(Shape(part.kind, half, np.eye(4)), surfaces[part.material], gripper @ local))
    held = tuple((g.entity.name, s.moves - 1, s.stops) for g, s in zip(grasps, shares, strict=True))
    return Gripper(tuple(parts), held)


def _check_time(
    sim_object: SimObject, script: Float[np.ndarray, "S J"], shares: list[Share], margin: tuple[int, int]
) -> None:
    if margin[0] < _BEFORE or margin[1] < _AFTER:
        raise ConfigError(
            f"gripper: expected margins of at least {_BEFORE} and {_AFTER} frames to come and to go, got {margin}"
        )
    if len(script) < shares[-1].end:
        raise ConfigError(f"gripper: expected a script of {shares[-1].end} frames, got {len(script)}")
    for share in shares:
        path = script[:, share.joint]
        free = np.concatenate((path[: share.moves] - path[0], path[share.stops :] - path[-1]))
        if np.abs(free).max(initial=0.0) > _STRAYS * max(np.ptp(path), 1e-9):
            name = sim_object.articulation.joints[share.joint].joint.name
            raise ConfigError(
                f"gripper: expected {name} to move within frames {share.moves} to {share.stops} only, got motion "
                "outside; one gripper needs joints that move once, one after the other, with its margins"
            )


def _grasp(sim_object: SimObject, share: Share, samples: ObjectSamples, poses: Float[np.ndarray, "S B 4 4"]) -> Grasp:
    """How the best of a joint's entities is held."""
    moments = poses[np.unique(np.linspace(share.moves - 1, share.stops - 1, _MOMENTS).astype(int))]
    entities = [e for e in sim_object.entities if e.joint == share.joint and e.label != "hinge"]
    found: list[tuple[float, int, Grasp]] = []
    problem: ObjectError | None = None
    for n, entity in enumerate(entities):
        try:
            grasp, cost = find_grasp(sim_object, entity, samples, moments)
        except ObjectError as error:
            problem = error
            continue
        found.append((cost, n, grasp))
    if not found:
        name = sim_object.articulation.joints[share.joint].joint.name
        raise problem or ObjectError(
            f"{sim_object.object_id}: expected an entity on {name} for the gripper to hold, found none"
        )
    return min(found)[2]


class _Way:
    """Where the gripper is at every frame, and how far it is open; drawn from its first frame to its last."""

    def __init__(self, sim_object: SimObject, poses: Float[np.ndarray, "S B 4 4"], rng: np.random.Generator) -> None:
        self._poses, self._rng = poses, rng
        self._scale = gripper_scale(sim_object.half_diagonal_m)
        hulls = sim_object.articulation.body_hulls
        moments = poses[np.unique(np.linspace(0, len(poses) - 1, 12).astype(int))]
        swept = np.concatenate([apply(p[b], h) for p in moments for b, h in enumerate(hulls) if len(h)])
        self._low, self._high = swept.min(axis=0), swept.max(axis=0)
        self._room = 0.3 * sim_object.half_diagonal_m + LENGTH_M * self._scale
        self._gripper = np.tile(np.eye(4), (len(poses), 1, 1))
        self._opening = np.zeros(len(poses))
        self._frame, self._pose, self._open_m = 0, np.eye(4), 0.0

    def through(
        self, shares: list[Share], grasps: list[Grasp]
    ) -> tuple[Float[np.ndarray, "S 4 4"], Float[np.ndarray, " S"]]:
        """Poses of the gripper in the world, and the distance between its pads."""
        before: Grasp | None = None
        for share, grasp in zip(shares, grasps, strict=True):
            coming = share.moves - self._frame
            closing = int(np.clip(coming // 6, *_CLOSING))
            held = self._poses[share.moves - 1, grasp.entity.body] @ grasp.body_from_gripper
            fixed, ready = grasp.body_from_gripper, _back(held, grasp.back_m)
            if before is None:  # from outside of the picture, or as far away as it gets in time
                straight = (coming - closing) // 2
                self._pose = self._outside(ready, coming - closing - straight)
                self._open_m = grasp.open_m
                self._go(coming - closing - straight, ready)
            else:
                left = self._poses[self._frame - 1, before.entity.body] @ before.body_from_gripper
                cleared = _back(left, before.back_m)
                if np.sum(cleared[:3, 1] * ready[:3, 1]) < 0:  # its two sides are alike: turn by less than a quarter
                    held, ready, fixed = held @ _HALF_TURN, ready @ _HALF_TURN, fixed @ _HALF_TURN
                opening = max(2, closing - 1)
                straight = (coming - opening - closing) // 3
                self._pose = left
                self._go(opening, left, before.open_m)
                self._go(straight, cleared)
                self._go(coming - closing - opening - 2 * straight, ready, grasp.open_m, around=True)
            self._go(straight, held)
            self._go(closing, held, grasp.width_m)
            frames = slice(share.moves, share.stops)
            self._gripper[frames] = self._poses[frames, grasp.entity.body] @ fixed
            self._opening[frames] = grasp.width_m
            self._frame, before = share.stops, grasp
        self._leave(grasps[-1])
        return self._gripper, self._opening

    def _leave(self, grasp: Grasp) -> None:
        self._pose = self._gripper[self._frame - 1]
        cleared, rest = _back(self._pose, grasp.back_m), len(self._poses) - self._frame
        opening = max(2, min(4, rest // 4))
        straight = (rest - opening + 1) // 2
        self._go(opening, self._pose, grasp.open_m)
        self._go(straight, cleared)
        self._go(rest - opening - straight, self._outside(cleared, rest - opening - straight))

    def _go(
        self, frames: int, goal: Float[np.ndarray, "4 4"], open_m: float | None = None, *, around: bool = False
    ) -> None:
        """Fills some frames with a movement that reaches its goal at the last of them."""
        start, opened = self._pose, self._open_m
        self._pose, self._open_m = goal, opened if open_m is None else open_m
        if frames <= 0:
            return
        share = minimum_jerk(np.arange(1, frames + 1) / frames)
        path = (1 - share)[:, None] * start[:3, 3] + share[:, None] * goal[:3, 3]
        if around:
            path += (4 * share * (1 - share))[:, None] * self._detour(start[:3, 3], goal[:3, 3])
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack((start[:3, :3], goal[:3, :3]))))
        now = slice(self._frame, self._frame + frames)
        self._gripper[now, :3, :3] = turns(share).as_matrix()
        self._gripper[now, :3, 3] = path
        self._opening[now] = opened + share * (self._open_m - opened)
        self._frame += frames

    def _outside(self, ready: Float[np.ndarray, "4 4"], frames: int) -> Float[np.ndarray, "4 4"]:
        """Above or beside all that the object sweeps; not as far if there is no time to get there."""
        place = ready[:3, 3]
        ways = [(self._high[2] - place[2], (0.0, 0.0, 1.0)), (self._high[1] - place[1], (0.0, 1.0, 0.0))]
        ways.append((place[1] - self._low[1], (0.0, -1.0, 0.0)))
        # The shorter the likelier; a beaten path is a cue that no tracker should learn.
        lengths = np.array([max(length, 0.0) + self._room for length, _ in ways])
        weights = lengths**-3.0
        way = int(self._rng.choice(3, p=weights / weights.sum()))
        length = min(lengths[way], _FASTEST_M_PER_S * self._scale**0.5 * frames / FRAMES_PER_S)
        towards = np.array(ways[way][1]) + 0.3 * ready[:3, 2]
        pose = ready.copy()
        pose[:3, 3] += length * towards / np.linalg.norm(towards)
        pose[2, 3] = max(pose[2, 3], LENGTH_M * self._scale * 0.2)
        return pose

    def _detour(self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """By how much the middle of a straight way has to move away to stay clear of all that the object sweeps."""
        middle, margin = (start + goal) / 2, 0.05 * self._scale
        depth = np.minimum(middle - self._low, self._high - middle) + margin
        if (depth <= 0).any() or np.linalg.norm(goal - start) < 1e-6:
            return np.zeros(3)
        shift = np.zeros(3)
        # Out of the box through the front, the top or a side, whichever is nearest; not through the back or the floor.
        outs = {(0, 1): self._high[0] - middle[0], (2, 1): self._high[2] - middle[2]}
        outs[1, 1], outs[1, -1] = self._high[1] - middle[1], middle[1] - self._low[1]
        (axis, sign), length = min(outs.items(), key=lambda item: item[1])
        shift[axis] = sign * (length + margin)
        return shift


def _back(pose: Float[np.ndarray, "4 4"], length_m: float) -> Float[np.ndarray, "4 4"]:
    """A gripper that went straight back."""
    moved = pose.copy()
    moved[:3, 3] += length_m * pose[:3, 2]
    return moved


_ALONG_Z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).T
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
