"""What a hand and its arm are like: where their bones are in three grips, and the meshes of flesh and cloth on them.

The frame of a hand is that of its tool: the origin lies where it holds, x runs across the fingers to the little one of
a right hand, y from the thumb to the fingers, z from the fingertips back to the palm. A left hand is its mirror image
along x. All lengths at scale 1 belong to a hand of 0.185 m, in metres.

- ``hook``: four fingers reach around a bar, the thumb closes from the other side;
- ``pinch``: index and middle finger meet the thumb; ring and little finger are curled;
- ``touch``: the tips of nearly straight fingers.

Meshes are hulls of balls, and tubes of varying section.

Reference: Buryanov and Kotiuk (2010), Proportions of hand segments, table of bone lengths.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull

from quest.sim.procedural.shapes import Mesh
from quest.sim.pull import CLEARANCE_M
from quest.sim.surfaces import TILE_M

Grip = Literal["hook", "pinch", "touch"]
GRIPS: tuple[Grip, ...] = get_args(Grip)

HAND_M = 0.185
"""Length of the hand at scale 1, from the wrist to the tip of the middle finger."""
FOREARM_M = 0.27
UPPER_ARM_M = 0.30
PALM_M = 0.088
"""From the wrist to the knuckles."""
TIP_RADIUS_M = 0.0072

BONES_M = np.array(
    [
        [0.0462, 0.0316, 0.0217],
        [0.0398, 0.0224, 0.0158],
        [0.0446, 0.0263, 0.0174],
        [0.0414, 0.0257, 0.0173],
        [0.0327, 0.0181, 0.0160],
    ]
)
"""Of thumb (metacarpal, proximal, distal) and fingers (proximal, middle, distal), from the index on."""
_ROOTS_M = np.array(
    [
        [-0.021, -0.012, -0.020],
        [-0.029, 0.002, -0.086],
        [-0.0095, 0.004, -0.088],
        [0.010, 0.002, -0.082],
        [0.028, -0.003, -0.074],
    ]
)
"""Where the bones start in the palm's frame: its origin is the wrist, y the back of the hand, z away from the
fingers."""
_RADII_M = np.array(
    [
        [0.0140, 0.0115, 0.0098, 0.0080],
        [0.0100, 0.0086, 0.0076, 0.0070],
        [0.0102, 0.0088, 0.0078, 0.0071],
        [0.0097, 0.0083, 0.0074, 0.0067],
        [0.0085, 0.0072, 0.0065, 0.0060],
    ]
)
"""Of thumb and fingers at their joints, from root to tip."""
_PALM_BALLS = [
    [-0.0285, 0.0, -0.084, 0.0112],  # knuckles
    [-0.0095, 0.002, -0.086, 0.0116],
    [0.010, 0.0, -0.080, 0.0110],
    [0.027, -0.004, -0.072, 0.0098],
    [-0.013, -0.002, -0.004, 0.0150],  # heel
    [0.014, -0.002, -0.004, 0.0150],
    [0.023, -0.006, -0.030, 0.0135],
    [-0.014, -0.004, -0.030, 0.0140],
]
_WEB_BALLS = [[-0.021, -0.011, -0.021, 0.0135], [-0.026, -0.004, -0.062, 0.0085], [-0.006, -0.007, -0.030, 0.0135]]
"""Between the palm and the root of the thumb."""
FOREARM_SECTIONS_M = np.array(
    [
        [-0.016, 0.0160, 0.0100],
        [-0.010, 0.0225, 0.0155],
        [0.000, 0.0260, 0.0180],
        [0.020, 0.0270, 0.0190],
        [0.050, 0.0285, 0.0215],
        [0.100, 0.0345, 0.0295],
        [0.150, 0.0405, 0.0365],
        [0.200, 0.0435, 0.0410],
        [0.240, 0.0430, 0.0420],
        [0.270, 0.0400, 0.0400],
    ]
)
"""Of a bare forearm at scale 1: along z from the wrist to the elbow, half axes across and along the back of the
hand."""
ELBOW_BALL_M = np.array([[0.0, 0.0, 0.0, 0.0400]])
"""The elbow at scale 1."""
UPPER_ARM_SECTIONS_M = np.column_stack(
    (np.linspace(0, UPPER_ARM_M, 12), *[0.040 + 0.014 * np.sin(np.linspace(0, 2.2, 12))] * 2)
)
"""Of a bare upper arm at scale 1, along z from the elbow to the shoulder."""

_TILT_DEG = {"hook": 14.0, "pinch": 38.0, "touch": 24.0}
"""By how much the palm rises from the tool's axis towards the fingers' side."""
_END_SHARE = np.array([0.9, 0.65, 0.65, 0.65, 0.65])
"""How much the last joint bends for the middle one."""
_BENDS = np.deg2rad(np.linspace(0.0, 118.0, 60))
_WRIST_RAD = np.deg2rad(62.0)
_ELBOW_M = 0.06
"""Half the thickness of the elbow, and a little."""
_SIDES = 28

Balls = Float[np.ndarray, "K 4"]
"""Balls, a row each: centre and radius, metres."""


@dataclass(frozen=True)
class HandBuild:
    """What a hand is like."""

    scale: float
    """Its length over :data:`HAND_M`."""
    side: int
    """1 for a right hand, -1 for a left one."""
    thickness: float
    """Of its fingers, as a factor."""
    curl: float
    """How far fingers that do not hold are curled, 0 to 1."""


@dataclass(frozen=True)
class HandPose:
    """Where the bones are at S moments, in the hand's frame."""

    hand_from_palm: Float[np.ndarray, "S 4 4"]
    """Pose of the palm's frame: at the wrist, y out of the back of the hand, z away from the fingers."""
    joints: Float[np.ndarray, "S 5 4 3"]
    """Thumb first; from the root of each to the middle of its tip, metres."""
    across: Float[np.ndarray, "S 5 3"]
    """Unit normals of the planes in which they bend."""


@dataclass(frozen=True)
class HandTargets:
    """Where knuckles and fingertips shall be at S moments, for a right hand at scale 1."""

    knuckles: Float[np.ndarray, "S 3"]
    """Middle of the knuckles."""
    tilt_rad: Float[np.ndarray, " S"]
    tips: Float[np.ndarray, "S 5 3"]

    def mixed(self, other: HandTargets, share: Float[np.ndarray, " S"]) -> HandTargets:
        """These, on the way to others: 0 for these, 1 for the others."""
        s = share[:, None]
        return HandTargets(
            (1 - s) * self.knuckles + s * other.knuckles,
            (1 - share) * self.tilt_rad + share * other.tilt_rad,
            (1 - s[..., None]) * self.tips + s[..., None] * other.tips,
        )


def hand_targets(build: HandBuild, grip: Grip, width_m: float, opening_m: Float[np.ndarray, " S"]) -> HandTargets:
    """Knuckles and fingertips of a grip.

    ``width_m`` is between the fingers when they hold, ``opening_m`` now: more while the hand comes and goes.
    """
    width, opening = width_m / build.scale, opening_m / build.scale
    half = opening / 2
    opened = np.clip((opening - width) / (2 * CLEARANCE_M), 0.0, 1.0)
    radius = TIP_RADIUS_M * build.thickness
    zero, curl = np.zeros_like(half), build.curl
    if grip == "hook":
        knuckles = _rows(zero, half + radius + 0.008, 0.031 + 0.004 * opened)
        over = opened * (half + radius + 0.001) + (1 - opened) * (width / 2 - 0.008)
        tips = [
            _rows(-0.014 - 0.010 * opened, -half - 1.2 * radius - 0.016 * opened, zero + 0.004),
            _rows(zero - 0.027, over, zero - 0.014),
            _rows(zero - 0.009, over, zero - 0.015),
            _rows(zero + 0.009, over, zero - 0.014),
            _rows(zero + 0.026, over, zero - 0.012),
        ]
    elif grip == "pinch":
        knuckles = _rows(zero + 0.019, 0.040 + 0.5 * half, 0.049 - 0.1 * half)
        loose = half + radius
        tips = [
            _rows(zero, -half - 1.1 * radius, zero + 0.001),
            _rows(zero - 0.008, loose, zero),
            _rows(zero + 0.009, loose, zero + 0.001),
            _rows(zero + 0.026, loose - 0.010 * curl, zero + 0.012 + 0.020 * curl),
            _rows(zero + 0.041, loose - 0.016 * curl, zero + 0.026 + 0.020 * curl),
        ]
    else:
        knuckles = _rows(zero, 0.034 + 0.2 * half, zero + 0.064)
        spread = 0.8 + 4 * half
        tips = [
            _rows(-0.042 - half, 0.002 - half, zero + 0.042),
            _rows(-0.026 * spread, zero, zero),
            _rows(-0.009 * spread, zero, zero),
            _rows(0.010 * spread, zero, zero + 0.001),
            _rows(0.028 * spread, -0.002 + zero, zero + 0.008),
        ]
    tilt = np.full(len(half), np.deg2rad(_TILT_DEG[grip]))
    return HandTargets(knuckles, tilt, np.stack(tips, axis=1))


def pose_hand(build: HandBuild, targets: HandTargets) -> HandPose:
    """Bones that bring the fingertips to where they shall be, or as near as they reach."""
    cos, sin, zero = np.cos(targets.tilt_rad), np.sin(targets.tilt_rad), np.zeros_like(targets.tilt_rad)
    palm = np.tile(np.eye(4), (len(cos), 1, 1))
    palm[:, :3, 1], palm[:, :3, 2] = _rows(zero, cos, sin), _rows(zero, -sin, cos)
    palm[:, :3, 3] = targets.knuckles + PALM_M * palm[:, :3, 2]
    roots = np.einsum("sij,fj->sfi", palm[:, :3, :3], _ROOTS_M) + palm[:, None, :3, 3]
    bulge = np.repeat(palm[:, None, :3, 1], 5, axis=1)
    bulge[:, 0] = np.array([-0.75, -0.6, -0.1])
    mirror = np.array([build.side, 1.0, 1.0])
    joints, across = _bend(roots * mirror, targets.tips * mirror, bulge * mirror)
    palm[:, :3, 3] *= mirror
    palm[:, :3, 3] *= build.scale
    return HandPose(palm, build.scale * joints, across)


def _bend(
    roots: Float[np.ndarray, "S F 3"], tips: Float[np.ndarray, "S F 3"], bulge: Float[np.ndarray, "S F 3"]
) -> tuple[Float[np.ndarray, "S F 4 3"], Float[np.ndarray, "S F 3"]]:
    """Joints of chains of three bones from roots to tips, and the normals of their planes; bent towards ``bulge``."""
    chord = tips - roots
    reach = np.linalg.norm(chord, axis=-1)
    along = chord / reach[..., None]
    up = bulge - np.sum(bulge * along, axis=-1, keepdims=True) * along
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    flat = np.zeros((*reach.shape, 4, 2))
    for f, (first, second, third) in enumerate(BONES_M):
        ends = 1 + _END_SHARE[f]
        far = first + second * np.exp(-1j * _BENDS) + third * np.exp(-1j * ends * _BENDS)
        bend = np.interp(-reach[:, f], -np.abs(far), _BENDS)
        steps = np.stack((first + 0j * bend, second * np.exp(-1j * bend), third * np.exp(-1j * ends * bend)), axis=1)
        way = np.cumsum(steps, axis=1)
        way = way * np.exp(-1j * np.angle(way[:, -1:]))
        flat[:, f, 1:] = np.stack((np.real(way), np.imag(way)), axis=-1)
    joints = roots[:, :, None] + flat[..., :1] * along[:, :, None] + flat[..., 1:] * up[:, :, None]
    return joints, np.cross(along, up)


def elbow_direction(
    wrist: Float[np.ndarray, "S 3"],
    straight: Float[np.ndarray, "S 3"],
    shoulder: Float[np.ndarray, "S 3"],
    build: HandBuild,
) -> Float[np.ndarray, "S 3"]:
    """Unit directions from the wrist to the elbow, in the world, whose floor is z = 0.

    The arm bends in the elbow, downwards and outwards, and in the wrist by 62 degrees at most, unless the elbow would
    meet the floor. ``straight`` are unit directions of a forearm that is in line with the palm.
    """
    towards = shoulder - wrist
    far = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    towards = towards / far
    near, upper = build.scale * FOREARM_M, build.scale * UPPER_ARM_M
    cos = np.clip((near**2 + far**2 - upper**2) / (2 * near * far), np.cos(np.deg2rad(70)), 1.0)
    down = np.array([0.3, 0.5 * build.side, -1.0])
    aside = unit_rows(down - (towards @ down)[:, None] * towards, 1e-6)
    wanted = cos * towards + np.sqrt(1 - cos**2) * aside
    # No farther from the straight wrist than a wrist bends.
    level = np.clip(np.sum(wanted * straight, axis=1, keepdims=True), -1.0, 1.0)
    angle = np.minimum(np.arccos(level), _WRIST_RAD)
    found = np.cos(angle) * straight + np.sin(angle) * unit_rows(wanted - level * straight, 1e-6)
    found[:, 2] = np.maximum(found[:, 2], np.minimum((_ELBOW_M * build.scale - wrist[:, 2]) / near, 0.9))
    return unit_rows(found)


def unit_rows(vectors: Float[np.ndarray, "*N 3"], least: float = 0.0) -> Float[np.ndarray, "*N 3"]:
    """Directions of vectors; those shorter than ``least`` are divided by that."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), least)


def _rows(*columns: Float[np.ndarray, " S"]) -> Float[np.ndarray, "S 3"]:
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


@cache
def _directions() -> Float[np.ndarray, "N 3"]:
    return np.asarray(trimesh.creation.icosphere(subdivisions=2).vertices)


def rounded(balls: Balls) -> Mesh:
    """The hull of some balls, with the smooth normals of their surfaces."""
    directions = _directions()
    points = (balls[:, None, :3] + balls[:, None, 3:] * directions).reshape(-1, 3)
    hull = ConvexHull(points)
    corner = points[hull.simplices]
    outwards = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    turned = np.sum(outwards * hull.equations[:, :3], axis=1) < 0
    faces = np.where(turned[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, faces = np.unique(faces, return_inverse=True)
    normals = np.tile(directions, (len(balls), 1))[used]
    return Mesh(points[used], faces.reshape(-1, 3).astype(np.int64), normals, points[used][:, :2] / TILE_M)


def tube_of_sections(sections: Float[np.ndarray, "N 3"], waves_m: Float[np.ndarray, "N S"] | float = 0.0) -> Mesh:
    """A tube along z with a flat start and an open end.

    Args:
        sections: z and the half axes along x and y, a row each, by growing z.
        waves_m: by how much the surface stands out, for every section and each of its 28 corners: folds of cloth.
    """
    angle = 2 * np.pi * np.arange(_SIDES + 1) / _SIDES
    waves = np.broadcast_to(np.asarray(waves_m, float), (len(sections), _SIDES))
    waves = np.concatenate((waves, waves[:, :1]), axis=1)
    z, a, b = (sections[:, k : k + 1] for k in range(3))
    points = np.stack(np.broadcast_arrays((a + waves) * np.cos(angle), (b + waves) * np.sin(angle), z), axis=-1)
    around = np.roll(points[:, :-1], -1, axis=1) - np.roll(points[:, :-1], 1, axis=1)
    around = np.concatenate((around, around[:, :1]), axis=1)
    normals = unit_rows(np.cross(around, np.gradient(points, axis=0)), 1e-12)
    length = sections[:, :1] - sections[0, 0]
    girth = np.mean(a + b) / 2 * angle
    uv = np.stack(np.broadcast_arrays(length, girth), axis=-1).reshape(-1, 2) / TILE_M
    row, column = np.meshgrid(np.arange(len(sections) - 1), np.arange(_SIDES), indexing="ij")
    first = (row * (_SIDES + 1) + column).ravel()
    right, above = first + 1, first + _SIDES + 1
    disc, start = np.arange(1, _SIDES - 1), len(points) * (_SIDES + 1)
    faces = np.concatenate(
        (
            np.stack((first, right, above + 1), 1),
            np.stack((first, above + 1, above), 1),
            start + np.stack((np.zeros_like(disc), disc + 1, disc), 1),
        )
    )
    vertices = np.concatenate((points.reshape(-1, 3), points[0, :-1]))
    normals = np.concatenate((normals.reshape(-1, 3), np.tile([0.0, 0.0, -1.0], (_SIDES, 1))))
    return Mesh(vertices, faces.astype(np.int64), normals, np.concatenate((uv, uv[:_SIDES])))


def bone_balls(finger: int, bone: int, length_m: float, thickness: float) -> Balls:
    """Of one bone along z from its joint at the origin, at scale 1; counted from the thumb, and from the root."""
    near, far = thickness * _RADII_M[finger, bone : bone + 2]
    balls = [[0.0, 0.0, 0.0, near], [0.0, 0.0, length_m, far]]
    if bone == 2:  # the pad of the fingertip is its thickest place
        balls.append([0.0, -0.12 * far, 0.55 * length_m, 1.03 * near])
    return np.array(balls)


def nail_balls(finger: int, length_m: float, thickness: float) -> Balls:
    """Of a fingernail on the last bone: a thin plate on its back, y."""
    radius = thickness * _RADII_M[finger, 3]
    height, half = 0.80 * radius, 0.50 * radius
    corners = [(x, z) for x in (-half, half) for z in (0.62 * length_m, length_m + 0.35 * radius)]
    edges = [[x, height - 0.06 * radius, z, 0.22 * radius] for x, z in corners]
    middle = [[0.0, height, z, 0.24 * radius] for z in (0.60 * length_m, length_m + 0.45 * radius)]
    return np.array(edges + middle)


def palm_balls(build: HandBuild) -> tuple[Float[np.ndarray, "8 4"], Float[np.ndarray, "3 4"]]:
    """Of the palm, and of what lies between it and the root of the thumb, in the palm's frame at scale 1."""
    found = np.array(_PALM_BALLS), np.array(_WEB_BALLS)
    for balls in found:
        balls[:, 0] *= build.side
        balls[:, 3] *= 0.5 + 0.5 * build.thickness
    return found


def hand_balls(build: HandBuild, pose: HandPose) -> Balls:
    """Balls that fill palm and fingers at the first of some moments, in the hand's frame."""
    palm = np.concatenate(palm_balls(build))
    palm = np.concatenate((palm, (palm[:4] + palm[[4, 4, 5, 5]]) / 2))
    rotation, shift = pose.hand_from_palm[0, :3, :3], pose.hand_from_palm[0, :3, 3]
    found = [np.column_stack(((build.scale * palm[:, :3]) @ rotation.T + shift, build.scale * palm[:, 3]))]
    for finger, joints in enumerate(pose.joints[0]):
        for bone in range(3):
            ends = bone_balls(finger, bone, 0.0, build.thickness)[:2, 3]
            for share in (0.0, 0.5, 1.0):
                radius = (1 - share) * ends[0] + share * ends[1]
                centre = (1 - share) * joints[bone] + share * joints[bone + 1]
                found.append(np.array([[*centre, build.scale * radius]]))
    return np.concatenate(found)


def sleeve_sections(start_m: float, loose_m: float, *, cuff_m: float = 0.0) -> Float[np.ndarray, "N 3"]:
    """Of a sleeve around the forearm from ``start_m`` behind the wrist, ``loose_m`` wider than the arm."""
    z = np.linspace(start_m, FOREARM_M, 40)
    arm = np.stack([np.interp(z, FOREARM_SECTIONS_M[:, 0], FOREARM_SECTIONS_M[:, k]) for k in (1, 2)], axis=1)
    loose = loose_m + np.where(z < start_m + cuff_m, 0.0025, 0.0)
    # Cloth does not follow the arm: rounder than it, and tightest at the elbow.
    size = arm + (loose * (1 - 0.5 * (z - start_m) / max(FOREARM_M - start_m, 1e-6)))[:, None]
    return np.column_stack((z, size[:, 0], np.maximum(size[:, 1], 0.85 * size[:, 0])))


def upper_sleeve_sections(start_m: float, loose_m: float) -> Float[np.ndarray, "N 3"]:
    """Of a sleeve around the upper arm, from ``start_m`` behind the elbow to the shoulder."""
    z = np.linspace(start_m, UPPER_ARM_M + 0.02, 40)
    arm = ELBOW_BALL_M[0, 3] + 0.018 * np.sin(np.clip(z / UPPER_ARM_M, 0, 1) * 1.6)
    wide = arm + (0.5 * loose_m if start_m == 0 else loose_m + 0.006)
    return np.column_stack((z, wide, wide))


def folds(count: int, depth_m: float, rng: np.random.Generator) -> Float[np.ndarray, "N S"]:
    """How cloth stands out along a sleeve of some sections and around it."""
    along, around = np.linspace(0, 1, count)[:, None], 2 * np.pi * np.arange(_SIDES) / _SIDES
    field = np.zeros((count, _SIDES))
    for _ in range(7):
        turns, waves = int(rng.integers(0, 3)), rng.uniform(3, 11)
        field += np.sin(2 * np.pi * waves * along + turns * around + rng.uniform(0, 2 * np.pi)) * rng.uniform(0.3, 1)
    return depth_m * field / max(np.abs(field).max(), 1e-9)
