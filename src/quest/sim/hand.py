"""A person's hand that comes, takes hold of what is to move, pulls it, lets go and leaves.

It grasps as a gripper does, in one of three grips, with an arm that leads to where a person stands in front of the
object. Wrist and elbow bend as it moves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.sim.annotate import entity_points
from quest.sim.appearance import add_shape
from quest.sim.entities import SimEntity
from quest.sim.hand_shape import (
    BONES_M,
    ELBOW_BALL_M,
    FOREARM_M,
    FOREARM_SECTIONS_M,
    GRIPS,
    HAND_M,
    TIP_RADIUS_M,
    UPPER_ARM_SECTIONS_M,
    Grip,
    HandBuild,
    HandPose,
    bone_balls,
    elbow_direction,
    folds,
    hand_balls,
    hand_targets,
    nail_balls,
    palm_balls,
    pose_hand,
    rounded,
    sleeve_sections,
    tube_of_sections,
    unit_rows,
    upper_sleeve_sections,
)
from quest.sim.procedural.shapes import Mesh, join
from quest.sim.pull import CLEARANCE_M, Boxes, Grasp, Pull, Puller, Task, Tool, plan_pull
from quest.sim.surfaces import Surface, make_material, sample_colour, sample_surface, triple

SKIN_TONES = (
    (0.965, 0.929, 0.894), (0.953, 0.906, 0.859), (0.969, 0.918, 0.816), (0.918, 0.855, 0.729), (0.843, 0.741, 0.588),
    (0.627, 0.494, 0.337), (0.510, 0.361, 0.263), (0.376, 0.255, 0.204), (0.227, 0.192, 0.165), (0.161, 0.141, 0.125),
)  # fmt: skip
"""sRGB colours of the scale of Monk (2019), from light to dark."""

_RIGHT_HANDED = 0.75
_LENGTHS_M = (0.17, 0.21)
_FULL_SIZE_M = 0.15
"""Objects with at least this half diagonal meet a hand of its own size, smaller ones a smaller one."""
_SMALLEST = 0.6
_STANDING_DRAWS = 16
_STEP = 0.7
"""How far the person steps up and back, for each metre that the hand comes and goes."""
_CLEAR_RAD = np.deg2rad(35.0)
"""Angle that is wanted between an arm and the way from the hand to a camera."""

_USUAL: dict[Grip, tuple[str, ...]] = {"hook": ("handle",), "pinch": ("handle", "knob", "rim"), "touch": ("front",)}
_UNUSUAL_COST = 0.25
_HOOK_BONUS = 0.2
"""How much better than a pinch it is to reach around a handle."""
_WRIST_COST = 0.45
_THUMB_COST = 0.25
_FLOOR_COST = 1.0
_LOWEST_M = 0.05
"""A wrist that comes closer to the floor at scale 1 is in it."""


@dataclass(frozen=True)
class Person:
    """Where the shoulder of the person is whose hand pulls, relative to what it pulls."""

    build: HandBuild
    ahead_m: float
    """How far in front of the entity's farthest place."""
    aside_m: float
    """How far towards the hand's side."""
    above_m: float
    """How far above the entity, for the person stoops."""
    top_m: float
    """Its height above the ground at most, when the person stands upright."""

    def shoulder(self, path: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "3"]:
        """Where it is in the world while an entity takes a path."""
        x, (y, z) = path[:, 0].max() + self.ahead_m, path[:, 1:].mean(axis=0)
        return np.array([x, y + self.build.side * self.aside_m, min(z + self.above_m, max(self.top_m, z))])

    def clearance_rad(self, path: Float[np.ndarray, "M 3"], eyes: Float[np.ndarray, "N 3"]) -> float:
        """Smallest angle, seen from what is pulled, between the shoulder and a camera at one of some world points."""
        to_shoulder, to_eyes = self.shoulder(path) - path[:, None], eyes - path[:, None]
        lengths = np.linalg.norm(to_shoulder, axis=-1) * np.linalg.norm(to_eyes, axis=-1)
        level = np.sum(to_shoulder * to_eyes, axis=-1) / np.maximum(lengths, 1e-9)
        return float(np.arccos(np.clip(level, -1.0, 1.0)).min(initial=np.pi))


@dataclass(frozen=True)
class HandTool(Tool):
    """A hand in one of its grips, for the search and the ways."""

    build: HandBuild
    grip: Grip
    shoulder: Float[np.ndarray, "3"]
    """Where it is in the world."""

    def boxes(
        self, world_from_gripper: Float[np.ndarray, "4 4"], width_m: float, opening_m: float, *, shrink_m: float = 0.0
    ) -> Boxes:
        """Cubes along its bones, in its palm and in the forearm, each smaller by ``shrink_m`` on all sides."""
        balls = hand_balls(self.build, self._pose(width_m, opening_m))
        palm = self._pose(width_m, width_m).hand_from_palm
        world = world_from_gripper @ palm
        towards = elbow_direction(world[:, :3, 3], world[:, :3, 2], self.shoulder[None], self.build)
        elbow = towards[0] @ world_from_gripper[:3, :3]
        along = np.array([0.06, 0.12, 0.18])
        radii = np.interp(along, FOREARM_SECTIONS_M[:, 0], FOREARM_SECTIONS_M[:, 2])
        arm = np.column_stack((palm[0, :3, 3] + self.build.scale * along[:, None] * elbow, self.build.scale * radii))
        balls = np.concatenate((balls, arm))
        half = 0.75 * balls[:, 3:] - shrink_m
        return np.stack((balls[:, :3] - half, balls[:, :3] + half), axis=1)

    def _pose(self, width_m: float, opening_m: float) -> HandPose:
        """Its bones at a single moment."""
        return pose_hand(self.build, hand_targets(self.build, self.grip, width_m, np.array([opening_m])))

    def aversion(self, world_from_gripper: Float[np.ndarray, "M 4 4"], entity: SimEntity) -> float:
        """What a bent wrist, a thumb that points away from the head, the floor and an odd grip cost."""
        palm = world_from_gripper @ self._usual_palm
        wrist, straight = palm[:, :3, 3], palm[:, :3, 2]
        away = unit_rows(self.shoulder - wrist, 1e-6)
        thumb = -self.build.side * world_from_gripper[:, :3, 0]
        natural = np.array([0.2, -0.6 * self.build.side, 0.75]) / np.linalg.norm([0.2, 0.6, 0.75])
        cost = _WRIST_COST * float(np.mean(1 - np.sum(straight * away, axis=1)))
        cost += _THUMB_COST * float(np.mean(1 - thumb @ natural))
        cost += _FLOOR_COST * float(np.mean(wrist[:, 2] < _LOWEST_M * self.build.scale))
        if entity.label not in _USUAL[self.grip]:
            return cost + _UNUSUAL_COST
        return cost - _HOOK_BONUS * (self.grip == "hook")

    @cached_property
    def _usual_palm(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the palm when it holds something of usual width."""
        return self._pose(0.02, 0.02).hand_from_palm[0]


@dataclass(frozen=True)
class MeshPart:
    """A mesh with a material that moves; a prop."""

    mesh: Mesh
    surface: Surface
    world_from_shape: Float[np.ndarray, "S 4 4"]
    """Its pose at every frame of the script."""

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene``; returns the entity that :meth:`place` moves."""
        import sapien

        mesh = self.mesh
        arrays = (mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        looks = (mesh.normals.astype(np.float32), mesh.uv.astype(np.float32), make_material(self.surface))
        shape = sapien.render.RenderShapeTriangleMesh(*arrays, *looks)
        return add_shape(scene, shape, sapien.Pose(self.world_from_shape[0]))

    def place(self, actors: Any, frame: int) -> None:
        """Move its entity to where it is at a frame of the script."""
        import sapien

        actors.set_pose(sapien.Pose(self.world_from_shape[frame]))

    def pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Where it is at a frame of the script."""
        return self.world_from_shape[frame]


@dataclass(frozen=True)
class Hand(Puller):
    """A hand with its arm that moves."""

    parts: tuple[MeshPart, ...]
    grips: tuple[Grip, ...]
    """How it holds one entity after the other."""
    build: HandBuild


@dataclass(frozen=True)
class HandLook:
    """What a hand and its arm wear."""

    skin: Surface
    nail: Surface
    hand: Surface
    """Of the hand itself: skin, or a glove."""
    sleeve: Surface
    glove: bool
    sleeve_start_m: float
    """Where the sleeve starts behind the wrist, at scale 1; behind the elbow with a short one."""
    loose_m: float
    """How far it stands off the arm."""
    folds_m: float
    """How deep its folds are."""
    cuff_m: float
    """Length of a thicker cuff, or 0."""


def sample_skin(rng: np.random.Generator) -> Surface:
    """Draw a skin: any tone from light to dark, more or less red."""
    place = float(rng.uniform(0, len(SKIN_TONES) - 1))
    n = min(int(place), len(SKIN_TONES) - 2)
    tone = (1 - place + n) * np.array(SKIN_TONES[n]) + (place - n) * np.array(SKIN_TONES[n + 1])
    # A palette of skin is paler than hands are.
    tone = tone * (1 + float(rng.uniform(0.3, 1.0)) * np.array([0.02, -0.10, -0.16])) * float(rng.uniform(0.9, 1.03))
    return Surface(triple(np.clip(tone, 0, 1)), float(rng.uniform(0.45, 0.7)), 0.0, float(rng.uniform(0.2, 0.4)))


def sample_hand_look(rng: np.random.Generator) -> HandLook:
    """Draw skin, now and then a glove, and a long, turned-up or short sleeve of any cloth."""
    skin = sample_skin(rng)
    nail = Surface(triple(np.clip(0.82 * np.array(skin.colour) + [0.17, 0.10, 0.10], 0, 1)), 0.3, 0.0, 0.5)
    glove = bool(rng.random() < 0.12)
    worn = Surface(sample_colour(rng), float(rng.uniform(0.5, 0.95)), 0.0, float(rng.uniform(0.1, 0.3)))
    cloth = sample_surface(rng, kinds=("weave", "stripes", "checker", "noise"), textured=0.6)
    cloth = replace(cloth, roughness=float(rng.uniform(0.8, 1.0)), metallic=0.0, specular=float(rng.uniform(0.0, 0.15)))
    kind = int(rng.choice(3, p=(0.55, 0.2, 0.25)))
    start = (rng.uniform(0.0, 0.03), rng.uniform(0.08, 0.17), FOREARM_M + rng.uniform(0.03, 0.12))[kind]
    cuff = float(rng.uniform(0.02, 0.05)) if kind < 2 and rng.random() < 0.6 else 0.0
    loose = float(rng.uniform(0.006, 0.016))
    deep = loose * rng.uniform(0.1, 0.35)
    return HandLook(skin, nail, worn if glove else skin, cloth, glove, float(start), loose, deep, cuff)


def hand_scale(half_diagonal_m: float, length_m: float = HAND_M) -> float:
    """Scale of a hand of some length for an object: its own for furniture, less for what is small."""
    return length_m / HAND_M * float(np.clip(half_diagonal_m / _FULL_SIZE_M, _SMALLEST, 1.0))


def sample_hand_build(half_diagonal_m: float, rng: np.random.Generator, *, glove: bool) -> HandBuild:
    """Draw a hand for an object: its length, its side, how thick and how curled its fingers are."""
    return HandBuild(
        hand_scale(half_diagonal_m, float(rng.uniform(*_LENGTHS_M))),
        1 if rng.random() < _RIGHT_HANDED else -1,
        float(rng.uniform(0.9, 1.18)) * (1.06 if glove else 1.0),
        float(rng.uniform(0.2, 1.0)),
    )


def hand_tool(grip: Grip, person: Person, shoulder: Float[np.ndarray, "3"]) -> HandTool:
    """A person's hand in a grip, with the shoulder somewhere in the world."""
    build = person.build
    half_x, span, opening, reaches = {
        "hook": (0.036, 0.85, 0.058, (0.009, 0.014)),
        "pinch": (0.012, 0.0, 0.075, (0.011, 0.006, 0.002)),
        "touch": (0.030, 0.0, 0.060, ()),
    }[grip]
    return HandTool(
        noun="hand",
        scale=build.scale,
        pad_half_m=(half_x, 0.003, TIP_RADIUS_M * build.thickness),
        span_share=span,
        opening_m=opening,
        length_m=0.14,
        reaches_m=reaches,
        touches=grip == "touch",
        touch_open_m=2 * CLEARANCE_M * build.scale,
        turns=tuple(2 * np.pi * np.arange(16) / 16),
        touch_turns=16,
        sides_alike=False,
        # It comes from and goes to the side on which the shoulder is.
        exits=((1, build.side if person.aside_m >= 0 else -build.side),),
        exit_back=0.5,
        build=build,
        grip=grip,
        shoulder=shoulder,
    )


def plan_hand(task: Task, rng: np.random.Generator, eyes: Float[np.ndarray, "N 3"]) -> Hand:
    """A hand that pulls one joint after the other; its arm keeps clear of cameras at some world points if it can.

    Errors are those of :func:`quest.sim.pull.plan_pull`.
    """
    look = sample_hand_look(rng)
    build = sample_hand_build(task.sim_object.half_diagonal_m, rng, glove=look.glove)
    person = _standing(task, build, eyes, rng)

    def tools(path: Float[np.ndarray, "M 3"]) -> list[HandTool]:
        shoulder = person.shoulder(path)
        return [hand_tool(grip, person, shoulder) for grip in GRIPS]

    pull = plan_pull(task, rng, "hand", tools)
    return Hand(_parts(build, look, pull, rng), pull.held, tuple(_tool(grasp).grip for grasp in pull.grasps), build)


def _standing(task: Task, build: HandBuild, eyes: Float[np.ndarray, "N 3"], rng: np.random.Generator) -> Person:
    """Where the person stands: the first draw in which the arm keeps clear of all cameras, or the clearest."""
    moved = [e for e in task.sim_object.entities if e.joint in task.joints and e.label != "hinge"]
    paths = entity_points(moved, task.poses[:: max(1, len(task.script) // 8)]).swapaxes(0, 1)
    people: list[tuple[float, Person]] = []
    while len(people) < _STANDING_DRAWS and not (people and people[-1][0] >= _CLEAR_RAD):
        ahead, aside = float(rng.uniform(0.28, 0.45)), float(rng.uniform(-0.2, 0.45))
        above, top = float(rng.uniform(0.2, 0.5)), float(rng.uniform(1.2, 1.5))
        person = Person(build, build.scale * ahead, build.scale * aside, build.scale * above, top)
        people.append((min((person.clearance_rad(path, eyes) for path in paths), default=np.pi), person))
    return max(people, key=lambda drawn: drawn[0])[1]


def _parts(build: HandBuild, look: HandLook, pull: Pull, rng: np.random.Generator) -> tuple[MeshPart, ...]:
    """Everything that is seen of a hand that goes its way."""
    first, *later = pull.grasps
    targets = hand_targets(build, _tool(first).grip, first.width_m, pull.opening_m)
    shoulder = np.tile(_tool(first).shoulder, (len(pull.turn), 1))
    for n, grasp in enumerate(later):
        share = np.clip(pull.turn - n, 0.0, 1.0)
        targets = targets.mixed(hand_targets(build, _tool(grasp).grip, grasp.width_m, pull.opening_m), share)
        shoulder += share[:, None] * (_tool(grasp).shoulder - shoulder)
    pose = pose_hand(build, targets)
    world_from_palm = pull.world_from_gripper @ pose.hand_from_palm
    pieces = [
        *_hand_pieces(build, look, pose, pull.world_from_gripper, world_from_palm),
        *_arm_pieces(build, look, world_from_palm, shoulder + _STEP * _steps(pull), rng),
    ]
    return tuple(
        MeshPart(replace(mesh, vertices=build.scale * mesh.vertices), surface, frames)
        for mesh, surface, frames in pieces
    )


def _tool(grasp: Grasp) -> HandTool:
    assert isinstance(grasp.tool, HandTool)
    return grasp.tool


def _steps(pull: Pull) -> Float[np.ndarray, "S 3"]:
    """Ways over the floor that the hand has to go until it holds something for the first time, and since the last."""
    hand, (first, last) = pull.world_from_gripper[:, :3, 3], (pull.held[0][1], pull.held[-1][2] - 1)
    steps = np.zeros_like(hand)
    steps[:first], steps[last:] = hand[:first] - hand[first], hand[last:] - hand[last]
    return steps * [1.0, 1.0, 0.0]


_Piece = tuple[Mesh, Surface, np.ndarray]
"""A mesh at scale 1, what it wears, and where it is in the world at every frame."""


def _hand_pieces(
    build: HandBuild,
    look: HandLook,
    pose: HandPose,
    world_from_hand: Float[np.ndarray, "S 4 4"],
    world_from_palm: Float[np.ndarray, "S 4 4"],
) -> list[_Piece]:
    pieces: list[_Piece] = [(join([rounded(balls) for balls in palm_balls(build)]), look.hand, world_from_palm)]
    for finger, lengths in enumerate(BONES_M.tolist()):
        joints, across = pose.joints[:, finger], pose.across[:, finger]
        for bone, length in enumerate(lengths):
            frame = world_from_hand @ _frames(joints[:, bone], joints[:, bone + 1] - joints[:, bone], across)
            pieces.append((rounded(bone_balls(finger, bone, length, build.thickness)), look.hand, frame))
        if not look.glove:
            pieces.append((rounded(nail_balls(finger, lengths[-1], build.thickness)), look.nail, frame))
    return pieces


def _arm_pieces(
    build: HandBuild,
    look: HandLook,
    world_from_palm: Float[np.ndarray, "S 4 4"],
    shoulder: Float[np.ndarray, "S 3"],
    rng: np.random.Generator,
) -> list[_Piece]:
    wrist, across = world_from_palm[:, :3, 3], world_from_palm[:, :3, 0]
    towards = elbow_direction(wrist, world_from_palm[:, :3, 2], shoulder, build)
    elbow = wrist + build.scale * FOREARM_M * towards
    lower = _frames(wrist, towards, across)
    # The upper arm does not turn about itself: from the forearm's frame by the shortest way.
    onwards = unit_rows(shoulder - elbow, 1e-9)
    level = np.sum(lower[:, :3, 0] * onwards, axis=1) / np.maximum(1 + np.sum(towards * onwards, axis=1), 1e-6)
    upper = _frames(elbow, onwards, lower[:, :3, 0] - level[:, None] * (towards + onwards))
    pieces = [(tube_of_sections(FOREARM_SECTIONS_M), look.skin, lower)]
    pieces += [(mesh, look.skin, upper) for mesh in (rounded(ELBOW_BALL_M), tube_of_sections(UPPER_ARM_SECTIONS_M))]
    if look.sleeve_start_m < FOREARM_M:
        sections = sleeve_sections(look.sleeve_start_m, look.loose_m, cuff_m=look.cuff_m)
        pieces.append((tube_of_sections(sections, folds(len(sections), look.folds_m, rng)), look.sleeve, lower))
        pieces.append((rounded(ELBOW_BALL_M + np.array([0.0, 0.0, 0.0, 0.5 * look.loose_m])), look.sleeve, upper))
    sections = upper_sleeve_sections(max(0.0, look.sleeve_start_m - FOREARM_M), look.loose_m)
    shoulder_ball = np.array([[0.0, 0.0, sections[-1, 0] - 0.01, sections[-1, 1] + 0.004]])
    pieces.append((tube_of_sections(sections, folds(len(sections), look.folds_m, rng)), look.sleeve, upper))
    return [*pieces, (rounded(shoulder_ball), look.sleeve, upper)]


def _frames(
    origin: Float[np.ndarray, "S 3"], along: Float[np.ndarray, "S 3"], across: Float[np.ndarray, "S 3"]
) -> Float[np.ndarray, "S 4 4"]:
    """Frames at some places with z along directions and x as near as it gets to others."""
    frames = np.tile(np.eye(4), (len(origin), 1, 1))
    z = unit_rows(along, 1e-9)
    x = unit_rows(across - np.sum(across * z, axis=1, keepdims=True) * z, 1e-9)
    frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 2] = x, np.cross(z, x), z
    frames[:, :3, 3] = origin
    return frames
