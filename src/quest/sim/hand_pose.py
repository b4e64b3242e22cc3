"""Where the bones of a hand and its arm are, for three grips.

The frame of a hand is that of its tool: the origin lies where it holds, x runs across the fingers to the little one of
a right hand, y from the thumb to the fingers, z from the fingertips back to the palm. A left hand is its mirror image
along x. All lengths at scale 1 belong to a hand of 0.185 m, in metres.

- ``hook``: four fingers reach around a bar, the thumb closes from the other side;
- ``pinch``: index and middle finger meet the thumb; ring and little finger are curled;
- ``touch``: the tips of nearly straight fingers.

Reference: Buryanov and Kotiuk (2010), Proportions of hand segments, table of bone lengths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from quest.sim.grasp import CLEARANCE_M

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

ROOTS_M = np.array(
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

_TILT_DEG = {"hook": 14.0, "pinch": 38.0, "touch": 24.0}
"""By how much the palm rises from the tool's axis towards the fingers' side."""
_END_SHARE = np.array([0.9, 0.65, 0.65, 0.65, 0.65])
"""How much the last joint bends for the middle one."""
_BENDS = np.deg2rad(np.linspace(0.0, 118.0, 60))
_WRIST_RAD = np.deg2rad(62.0)
_ELBOW_M = 0.06
"""Half the thickness of the elbow, and a little."""


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

    Args:
        build: the hand.
        grip: how it holds.
        width_m: what is between its fingers when it holds.
        opening_m: what is between them now; more while it comes and goes.
    """
    width, opening = width_m / build.scale, opening_m / build.scale
    half = opening / 2
    opened = np.clip((opening - width) / (2 * CLEARANCE_M), 0.0, 1.0)
    radius = TIP_RADIUS_M * build.thickness
    zero, curl = np.zeros_like(half), build.curl
    if grip == "hook":
        knuckles = _rows(zero, half + radius + 0.008, 0.031 + 0.004 * opened)
        over = opened * (half + radius + 0.001) + (1 - opened) * (width / 2 - 0.008)
        fingers = [_rows(zero + x, over, zero + z) for x, z in ((-0.027, -0.014), (-0.009, -0.015), (0.009, -0.014))]
        tips = [
            _rows(-0.014 - 0.010 * opened, -half - 1.2 * radius - 0.016 * opened, zero + 0.004),
            *fingers,
            _rows(zero + 0.026, over, zero - 0.012),
        ]
    elif grip == "pinch":
        knuckles = _rows(zero + 0.019, 0.040 + 0.5 * half, 0.049 - 0.1 * half)
        loose = half + radius
        tips = [
            _rows(zero, -half - 1.1 * radius, zero + 0.001),
            _rows(zero - 0.008, half + radius, zero),
            _rows(zero + 0.009, half + radius, zero + 0.001),
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
    roots = np.einsum("sij,fj->sfi", palm[:, :3, :3], ROOTS_M) + palm[:, None, :3, 3]
    bulge = np.repeat(palm[:, None, :3, 1], 5, axis=1)
    bulge[:, 0] = np.array([-0.75, -0.6, -0.1])
    mirror = np.array([build.side, 1.0, 1.0])
    roots, tips, bulge = roots * mirror, targets.tips * mirror, bulge * mirror
    joints, across = _bend(roots, tips, bulge)
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
    meet the floor.

    Args:
        wrist: where the wrist is.
        straight: unit directions of a forearm that is in line with the palm.
        shoulder: where the shoulder is.
        build: the hand.
    """
    towards = shoulder - wrist
    far = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
    towards = towards / far
    near, upper = build.scale * FOREARM_M, build.scale * UPPER_ARM_M
    cos = np.clip((near**2 + far**2 - upper**2) / (2 * near * far), np.cos(np.deg2rad(70)), 1.0)
    down = np.array([0.3, 0.5 * build.side, -1.0])
    aside = down - (towards @ down)[:, None] * towards
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-6)
    wanted = cos * towards + np.sqrt(1 - cos**2) * aside
    # No farther from the straight wrist than a wrist bends.
    level = np.clip(np.sum(wanted * straight, axis=1, keepdims=True), -1.0, 1.0)
    angle = np.minimum(np.arccos(level), _WRIST_RAD)
    side = wanted - level * straight
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-6)
    found = np.cos(angle) * straight + np.sin(angle) * side
    found[:, 2] = np.maximum(found[:, 2], np.minimum((_ELBOW_M * build.scale - wrist[:, 2]) / near, 0.9))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def _rows(*columns: Float[np.ndarray, " S"]) -> Float[np.ndarray, "S 3"]:
    return np.stack(np.broadcast_arrays(*columns), axis=-1)
