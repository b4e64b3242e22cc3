"""What pulls in a take: how it takes hold of what is to move, and how it comes, moves along, lets go and leaves.

A tool is what pulls: a gripper, or a hand in one of its grips. Its frame lies where it holds: x across what holds, y
from one finger to the other, z from the fingertips back to the palm.

How it takes hold is found by trying, on samples of the object's surface. Candidates differ in the direction that the
tool comes from, in the angle between its fingers and in how deep it reaches. A pinch has the entity between the
fingers; where nothing fits between them (a drawer's flush front), their tips touch it from outside, as a suction cup
would. The best candidate meets nothing of the object on its straight way in, nor while the joint moves, pulls in the
direction of the motion and has little between its fingers.

While a joint moves, the tool is fixed in the link that it holds. In the frames earlier and later it goes in straight
lines along its own axis, and around the object from one link to the next.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from quest.errors import ConfigError, ObjectError
from quest.sim.annotate import entity_points
from quest.sim.articulation import Articulation, Part, apply
from quest.sim.entities import SimEntity
from quest.sim.motion import FRAMES_PER_S, MotionStyle, Share, minimum_jerk, share_plan
from quest.sim.objects import SimObject
from quest.sim.props import Prop

CLEARANCE_M = 0.014
"""Between an open finger and what it will pinch, at scale 1."""

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

_BEFORE, _AFTER = 8, 5
"""Frames that a tool needs at least, to come and to go."""
_CLOSING = (3, 6)
_FASTEST_M_PER_S = 1.6
_MOMENTS = 7
_STRAYS = 0.03
"""Share of its travel by which a joint may move while nothing holds it (an engine lags behind its script)."""
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])

Boxes = Float[np.ndarray, "P 2 3"]
"""Least and greatest coordinates of boxes along the axes of a tool's frame, metres."""


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


@dataclass(frozen=True)
class Grasp:
    """How an entity is held."""

    entity: SimEntity
    tool: Tool
    body_from_gripper: Float[np.ndarray, "4 4"]
    """Where the tool is then."""
    width_m: float
    """Distance between its fingers then; 0 if they touch from outside."""
    open_m: float
    """Distance between its fingers as it comes and goes."""
    back_m: float
    """How far it goes straight back to be clear of the object."""


@dataclass(frozen=True)
class Pull:
    """Where a tool is at every frame of a script."""

    world_from_gripper: Float[np.ndarray, "S 4 4"]
    opening_m: Float[np.ndarray, " S"]
    """Distance between its fingers."""
    turn: Float[np.ndarray, " S"]
    """Index of the grasp that it is set to; between two of them on its way from one to the next."""
    grasps: tuple[Grasp, ...]
    """How it holds one entity after the other."""
    held: tuple[tuple[str, int, int], ...]
    """Name of every entity that it holds, the first frame and the frame after the last."""


@dataclass(frozen=True)
class Puller:
    """What is seen of what pulls."""

    parts: Sequence[Prop]
    grasps: tuple[tuple[str, int, int], ...]
    """Name of every entity that it holds, the first frame and the frame after the last."""


FindTools = Callable[[Float[np.ndarray, "M 3"]], Sequence[Tool]]
"""The tools that may hold an entity which takes a path through the world."""


@dataclass(frozen=True)
class Task:
    """What is to be pulled, and when."""

    sim_object: SimObject
    script: Float[np.ndarray, "S J"]
    """Joint positions at every frame, as played."""
    joints: tuple[int, ...]
    """Joints that move, in order."""
    margin: tuple[int, int]
    """Frames at the start and at the end of each joint's share in which it does not move."""
    frames_per_joint: int
    """Length of a share."""

    @cached_property
    def poses(self) -> Float[np.ndarray, "S B 4 4"]:
        """``world_from_body`` at every frame."""
        return self.sim_object.articulation.poses(self.script)

    def shares(self, noun: str) -> list[Share]:
        """When which joint moves.

        Raises:
            ConfigError: the margins leave a tool no time, or joints move outside of their shares.
        """
        style = MotionStyle(margin=self.margin)
        shares = share_plan(self.joints, frames_per_joint=self.frames_per_joint, style=style)
        if self.margin[0] < _BEFORE or self.margin[1] < _AFTER:
            raise ConfigError(
                f"{noun}: expected margins of at least {_BEFORE} and {_AFTER} frames to come and to go, "
                f"got {self.margin}"
            )
        if len(self.script) < shares[-1].end:
            raise ConfigError(f"{noun}: expected a script of {shares[-1].end} frames, got {len(self.script)}")
        for share in shares:
            path = self.script[:, share.joint]
            free = np.concatenate((path[: share.moves] - path[0], path[share.stops :] - path[-1]))
            if np.abs(free).max(initial=0.0) > _STRAYS * max(np.ptp(path), 1e-9):
                name = self.sim_object.articulation.joints[share.joint].joint.name
                raise ConfigError(
                    f"{noun}: expected {name} to move within frames {share.moves} to {share.stops} only, got motion "
                    f"outside; one {noun} needs joints that move once, one after the other, with its margins"
                )
        return shares


def plan_pull(task: Task, rng: np.random.Generator, noun: str, tools: FindTools) -> Pull:
    """How the best of some tools, which messages call by a noun, pulls one joint after the other.

    Its ways are drawn from ``rng``.

    Raises:
        ConfigError: the margins leave it no time, or joints move outside of their shares.
        ObjectError: something that moves can be grasped nowhere.
    """
    shares, samples = task.shares(noun), ObjectSamples(task.sim_object.articulation)
    grasps = tuple(_best_grasp(task, share, samples, noun, tools) for share in shares)
    way = _Way(task, rng, grasps)
    way.go_through(shares)
    held = tuple((g.entity.name, s.moves - 1, s.stops) for g, s in zip(grasps, shares, strict=True))
    return Pull(way.gripper, way.opening, way.turn, grasps, held)


def _best_grasp(task: Task, share: Share, samples: ObjectSamples, noun: str, tools: FindTools) -> Grasp:
    """How the best of a joint's entities is held, with the best tool."""
    sim_object = task.sim_object
    moments = task.poses[np.unique(np.linspace(share.moves - 1, share.stops - 1, _MOMENTS).astype(int))]
    found: list[tuple[float, int, Grasp]] = []
    problem: ObjectError | None = None
    for entity in sim_object.entities:
        if entity.joint != share.joint or entity.label == "hinge":
            continue
        for tool in tools(entity_points([entity], moments)[:, 0]):
            try:
                grasp, cost = search_grasp(tool, sim_object, entity, samples, moments)
            except ObjectError as error:
                problem = error
                continue
            found.append((cost, len(found), grasp))
    if not found:
        name = sim_object.articulation.joints[share.joint].joint.name
        raise problem or ObjectError(
            f"{sim_object.object_id}: expected an entity on {name} for the {noun} to hold, found none"
        )
    return min(found)[2]


class ObjectSamples:
    """Points on the surface of an object, per body; always the same."""

    def __init__(self, articulation: Articulation) -> None:
        self._parts = articulation.parts
        by_body = [[self._parts[i] for i in articulation.body_parts(b)] for b in range(len(articulation.body_names))]
        area = np.array([sum(p.surface.area for p in parts) for parts in by_body])
        counts = np.maximum(400, _SAMPLES * area / max(area.sum(), 1e-12)).astype(int)
        self._bodies = [_sampled(parts, int(n)) for parts, n in zip(by_body, counts, strict=True)]
        self._area_m2 = [a / max(len(points), 1) for a, points in zip(area, self._bodies, strict=True)]

    def of(self, entity: SimEntity) -> Float[np.ndarray, "N 3"]:
        """Points on an entity's own parts, in its body; on the whole body if it has none."""
        if entity.parts:
            return _sampled([self._parts[i] for i in entity.parts], _OWN_SAMPLES)
        return _sampled([p for p in self._parts if p.body == entity.body], 4 * _OWN_SAMPLES)

    def world(
        self, poses: Float[np.ndarray, "B 4 4"], *, without: int | None = None
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """Points on all bodies, or on all but one, and how much of the surface each stands for, m^2."""
        kept = [b for b in range(len(self._bodies)) if b != without]
        points = np.concatenate([np.zeros((0, 3)), *(apply(poses[b], self._bodies[b]) for b in kept)])
        return points, np.repeat([self._area_m2[b] for b in kept], [len(self._bodies[b]) for b in kept])


def _sampled(parts: Sequence[Part], count: int) -> Float[np.ndarray, "N 3"]:
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
        self._tool, self._entity, self._start = tool, entity, motion[0, entity.body]
        start, body = motion[0], entity.body
        path = entity_points([entity], motion)[:, 0]
        self._point = path[0]
        self._taken = motion[:, body] @ np.linalg.inv(start[body])
        self._own = apply(start[body], samples.of(entity)) - self._point
        self._extent, area_m2 = samples.world(start)
        self._all = self._near(self._extent, area_m2)
        # What does not move along must not be in the way later.
        self._others = []
        for poses in motion[1 :: max(1, (len(motion) - 1) // 5)]:
            points, area_m2 = samples.world(poses, without=body)
            self._others.append(self._near(apply(start[body] @ np.linalg.inv(poses[body]), points), area_m2))
        self._wanted, self._directions = self._where_from(sim_object.articulation, start, unit(path[1:] - path[0]))

    def _near(
        self, points: Float[np.ndarray, "N 3"], area_m2: Float[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, " M"]]:
        """Those that the tool might meet, with areas in cm^2 for a tool of full size."""
        far = self._tool.scale * (self._tool.length_m + _WAY_IN_M + self._tool.opening_m)
        near = ((points - self._point) ** 2).sum(axis=1) < far**2
        return points[near], 1e4 / self._tool.scale**2 * area_m2[near]

    def _where_from(
        self, articulation: Articulation, start: Float[np.ndarray, "B 4 4"], pull: Float[np.ndarray, "3"]
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Unit vectors towards where the tool should come from, and towards where it may come from.

        It should come from where the entity is pulled to, or from the free side of an edge; knobs are turned from the
        front.
        """
        line = articulation.axes(start)[self._entity.joint]
        wanted, more = [pull], []
        if articulation.joints[self._entity.joint].joint.kind == "revolute":
            axis, arm, front = line[3:], self._point - line[:3], np.array([1.0, 0.0, 0.0])
            radial = unit([arm - (arm @ axis) * axis])
            more = [radial, radial + pull, axis, -axis]
            if self._entity.label == "knob":
                wanted = [unit([axis * np.sign(axis @ front) if np.abs(axis @ front) > 0.3 else front])]
            elif self._entity.label == "rim":
                wanted = [pull, radial]
        found: list[np.ndarray] = []
        for vector in [*wanted, pull, *_SIDES, *more]:
            towards = unit([vector])
            if np.linalg.norm(towards) > 0.5 and all(towards @ other < 0.98 for other in found):
                found.append(towards)
        return wanted, found

    def candidates(self) -> Iterator[_Candidate]:
        for outward in self._directions:
            fingers = self._finger_axes(outward)
            for finger in fingers:
                yield from self._pinches(outward, finger)
            if self._tool.touches:
                for finger in fingers[: self._tool.touch_turns]:
                    yield self._touch(outward, finger)

    def _finger_axes(self, outward: Float[np.ndarray, "3"]) -> list[Float[np.ndarray, "3"]]:
        """Directions between the fingers: in steps, from the narrow side of what is there."""
        near = self._own[np.linalg.norm(self._own, axis=1) < 0.06 * self._tool.scale]
        flat = near - np.outer(near @ outward, outward)
        _, _, axes = np.linalg.svd(flat - flat.mean(axis=0) if len(flat) > 3 else np.eye(3), full_matrices=False)
        first = axes[0] - (axes[0] @ outward) * outward
        if np.linalg.norm(first) < 1e-6:
            first = np.cross(outward, np.eye(3)[np.abs(outward).argmin()])
        first = unit([first])
        second = np.cross(outward, first)
        return [np.cos(a) * first + np.sin(a) * second for a in self._tool.turns]

    def _pinches(self, outward: Float[np.ndarray, "3"], finger: Float[np.ndarray, "3"]) -> Iterator[_Candidate]:
        tool, s = self._tool, self._tool.scale
        pose = np.eye(4)
        pose[:3, :3] = rotation = np.stack((np.cross(finger, outward), finger, outward), axis=1)
        local = self._own @ rotation
        half_x, _, half_z = (s * v for v in tool.pad_half_m)
        near = (np.abs(local[:, 0]) < half_x) & (np.abs(local[:, 1:]) < 0.6 * s * tool.opening_m).all(axis=1)
        local = local[near]
        if len(local) < 4 or np.ptp(local[:, 0]) < 2 * half_x * tool.span_share:
            return
        top = local[:, 2].max()
        for reach in tool.reaches_m:
            middle = top - s * reach
            held = local[np.abs(local[:, 2] - middle) < half_z, 1]
            if len(held) < 4:
                continue
            low, high = float(held.min()), float(held.max())
            width = high - low
            if width > 0.85 * s * tool.opening_m:
                continue
            at = pose.copy()
            at[:3, 3] = self._point + rotation @ [0.0, (low + high) / 2, middle]
            opened = min(width + 2 * s * CLEARANCE_M, s * tool.opening_m)
            yield _Candidate(at, width, opened, reach / tool.reaches_m[0], touches=False)

    def _touch(self, outward: Float[np.ndarray, "3"], finger: Float[np.ndarray, "3"]) -> _Candidate:
        pose = np.eye(4)
        pose[:3, :3] = np.stack((np.cross(finger, outward), finger, outward), axis=1)
        pose[:3, 3] = self._point + (self._tool.scale * self._tool.pad_half_m[2] + 0.0005) * outward
        return _Candidate(pose, 0.0, self._tool.touch_open_m, 0.0, touches=True)

    def least_cost(self, candidate: _Candidate) -> float:
        """What speaks against a candidate, if nothing is in its way."""
        outward = candidate.world_from_gripper[:3, 2]
        aligned = max(float(outward @ wanted) for wanted in self._wanted)
        cost = 1.0 * (1 - aligned) + 0.25 * (1 - outward[0]) - 0.3 * candidate.reach
        cost += self._tool.aversion(self._taken @ candidate.world_from_gripper, self._entity)
        if not candidate.touches:
            return cost + candidate.width_m / (self._tool.scale * self._tool.opening_m)
        return cost if self._entity.label == "front" else cost + _TOUCH_COST

    def in_the_way(self, candidate: _Candidate, enough: float = np.inf) -> float:
        """Surface that a tool of full size would meet, coming, holding and moving, cm^2; more if it meets the floor.

        Stops counting where its cost exceeds ``enough``.
        """
        pose, shrink = candidate.world_from_gripper, 0.0015 * self._tool.scale
        inverse, width = np.linalg.inv(pose), candidate.width_m
        coming = self._tool.boxes(pose, width, candidate.open_m, shrink_m=shrink)
        coming[:, 1, 2] += _WAY_IN_M * self._tool.scale
        corners = np.concatenate([trimesh.bounds.corners(box) for box in coming])
        met = _FLOOR_CM2 if apply(pose, corners)[:, 2].min() < -0.002 else 0.0
        boxes = self._tool.boxes(pose, width, width, shrink_m=shrink)
        looks = [(coming, *self._all, 1.0), (boxes, *self._all, 1.0)]
        looks += [(boxes, *others, 1 / len(self._others)) for others in self._others]
        for volume, points, area_cm2, weight in looks:
            if _COST_PER_CM2 * met > enough:
                break
            met += weight * float(area_cm2[_inside(volume, apply(inverse, points))].sum())
        return met

    def grasp(self, candidate: _Candidate) -> Grasp:
        """The chosen candidate, fixed in the entity's body."""
        pose, scale = candidate.world_from_gripper, self._tool.scale
        ahead = apply(np.linalg.inv(pose), self._extent)[:, 2].max()
        back = max(float(np.clip(ahead, 0.0, 0.8)) + 0.06 * scale, 0.12 * scale)
        fixed = np.linalg.inv(self._start) @ pose
        return Grasp(self._entity, self._tool, fixed, candidate.width_m, candidate.open_m, back)


def _inside(boxes: Boxes, points: Float[np.ndarray, "N 3"]) -> np.ndarray:
    """Indices of the points that lie in any of some boxes."""
    low, high = boxes[:, 0], boxes[:, 1]
    about = np.flatnonzero(((points > low.min(axis=0)) & (points < high.max(axis=0))).all(axis=1))
    near = points[about, None]
    return about[np.logical_or.reduce(((near > low) & (near < high)).all(axis=2), axis=1)]


def unit(vectors: Float[np.ndarray, "N 3"] | list) -> Float[np.ndarray, "3"]:
    """Direction of the first of some vectors that has one; zero if none has."""
    for vector in np.asarray(vectors, float):
        length = np.linalg.norm(vector)
        if length > 1e-9:
            return vector / length
    return np.zeros(3)


class _Way:
    """Where the tool is at every frame, and how far it is open; drawn from its first frame to its last."""

    def __init__(self, task: Task, rng: np.random.Generator, grasps: tuple[Grasp, ...]) -> None:
        self._poses, self._rng, self._grasps = task.poses, rng, grasps
        swept = task.sim_object.articulation.swept(task.poses, moments=12)
        self._low, self._high = swept.min(axis=0), swept.max(axis=0)
        self._half_diagonal_m, frames = task.sim_object.half_diagonal_m, len(task.poses)
        self.gripper = np.tile(np.eye(4), (frames, 1, 1))
        self.opening, self.turn = np.zeros(frames), np.zeros(frames)
        self._frame, self._pose, self._open_m, self._turn = 0, np.eye(4), 0.0, 0

    def go_through(self, shares: list[Share]) -> None:
        """Fills in poses, openings and turns: one grasp after the other, and the ways between."""
        before: Grasp | None = None
        for n, (share, grasp) in enumerate(zip(shares, self._grasps, strict=True)):
            coming = share.moves - self._frame
            closing = int(np.clip(coming // 6, *_CLOSING))
            held = self._poses[share.moves - 1, grasp.entity.body] @ grasp.body_from_gripper
            fixed, ready = grasp.body_from_gripper, _back(held, grasp.back_m)
            if before is None:  # from outside of the picture, or as far away as it gets in time
                straight = (coming - closing) // 2
                self._pose = self._outside(grasp.tool, ready, coming - closing - straight)
                self._open_m = grasp.open_m
                self._go(coming - closing - straight, ready)
            else:
                self._pose = left = self._poses[self._frame - 1, before.entity.body] @ before.body_from_gripper
                cleared = _back(left, before.back_m)
                # If its two sides are alike: turn by less than a quarter.
                if grasp.tool.sides_alike and np.sum(cleared[:3, 1] * ready[:3, 1]) < 0:
                    held, ready, fixed = held @ _HALF_TURN, ready @ _HALF_TURN, fixed @ _HALF_TURN
                opening = max(2, closing - 1)
                straight = (coming - opening - closing) // 3
                self._go(opening, left, before.open_m)
                self._go(straight, cleared)
                self._go(coming - closing - opening - 2 * straight, ready, grasp.open_m, around=True)
            self._go(straight, held)
            self._go(closing, held, grasp.width_m)
            frames = slice(share.moves, share.stops)
            self.gripper[frames] = self._poses[frames, grasp.entity.body] @ fixed
            self.opening[frames], self.turn[frames] = grasp.width_m, n
            self._frame, before = share.stops, grasp
        self._leave(self._grasps[-1])

    def _leave(self, grasp: Grasp) -> None:
        self._pose = self.gripper[self._frame - 1]
        cleared, rest = _back(self._pose, grasp.back_m), len(self._poses) - self._frame
        opening = max(2, min(4, rest // 4))
        straight = (rest - opening + 1) // 2
        self._go(opening, self._pose, grasp.open_m)
        self._go(straight, cleared)
        self._go(rest - opening - straight, self._outside(grasp.tool, cleared, rest - opening - straight))

    def _go(
        self, frames: int, goal: Float[np.ndarray, "4 4"], open_m: float | None = None, *, around: bool = False
    ) -> None:
        """Fills some frames with a movement that reaches its goal at the last of them; ``around`` to the next grasp."""
        start, opened, turn = self._pose, self._open_m, self._turn
        self._pose, self._open_m = goal, opened if open_m is None else open_m
        self._turn += around
        if frames <= 0:
            return
        share = minimum_jerk(np.arange(1, frames + 1) / frames)
        path = (1 - share)[:, None] * start[:3, 3] + share[:, None] * goal[:3, 3]
        if around:
            path += (4 * share * (1 - share))[:, None] * self._detour(start[:3, 3], goal[:3, 3])
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack((start[:3, :3], goal[:3, :3]))))
        now = slice(self._frame, self._frame + frames)
        self.gripper[now, :3, :3] = turns(share).as_matrix()
        self.gripper[now, :3, 3] = path
        self.opening[now] = opened + share * (self._open_m - opened)
        self.turn[now] = turn + share * (self._turn - turn)
        self._frame += frames

    def _outside(self, tool: Tool, ready: Float[np.ndarray, "4 4"], frames: int) -> Float[np.ndarray, "4 4"]:
        """Above or beside all that the object sweeps; not as far if there is no time to get there."""
        place, room = ready[:3, 3], 0.3 * self._half_diagonal_m + tool.length_m * tool.scale
        edges = [(self._high if sign > 0 else self._low)[axis] for axis, sign in tool.exits]
        rest = [sign * (edge - place[axis]) for edge, (axis, sign) in zip(edges, tool.exits, strict=True)]
        # The shorter the likelier; a beaten path is a cue that no tracker should learn.
        lengths = np.array([max(length, 0.0) + room for length in rest])
        weights = lengths**-3.0
        way = int(self._rng.choice(len(lengths), p=weights / weights.sum()))
        length = min(lengths[way], _FASTEST_M_PER_S * tool.scale**0.5 * frames / FRAMES_PER_S)
        axis, sign = tool.exits[way]
        towards = sign * np.eye(3)[axis] + tool.exit_back * ready[:3, 2]
        pose = ready.copy()
        pose[:3, 3] += length * towards / np.linalg.norm(towards)
        pose[2, 3] = max(pose[2, 3], tool.length_m * tool.scale * 0.2)
        return pose

    def _detour(self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """By how much the middle of a straight way has to move away to stay clear of all that the object sweeps."""
        middle, margin = (start + goal) / 2, 0.05 * self._grasps[0].tool.scale
        depth = np.minimum(middle - self._low, self._high - middle) + margin
        shift = np.zeros(3)
        if (depth <= 0).any() or np.linalg.norm(goal - start) < 1e-6:
            return shift
        # Out of the box through the front, the top or a side, whichever is nearest; not through the back or the floor.
        outs = [(self._high[axis] - middle[axis], axis, 1) for axis in (0, 2, 1)]
        length, axis, sign = min([*outs, (middle[1] - self._low[1], 1, -1)], key=lambda way: way[0])
        shift[axis] = sign * (length + margin)
        return shift


def _back(pose: Float[np.ndarray, "4 4"], length_m: float) -> Float[np.ndarray, "4 4"]:
    """A tool that went straight back."""
    moved = pose.copy()
    moved[:3, 3] += length_m * pose[:3, 2]
    return moved
