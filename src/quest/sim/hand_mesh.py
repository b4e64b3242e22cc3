"""Meshes of a hand, its forearm and its sleeve: hulls of balls, and tubes of varying section."""

from __future__ import annotations

from functools import cache

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import ConvexHull

from quest.sim.hand_pose import UPPER_ARM_M
from quest.sim.procedural.shapes import Mesh
from quest.sim.surfaces import TILE_M

_SIDES = 28

Balls = Float[np.ndarray, "K 4"]
"""Balls, a row each: centre and radius, metres."""

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
    normals = np.cross(around, np.gradient(points, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    length = sections[:, :1] - sections[0, 0]
    girth = np.mean(a + b) / 2 * angle
    uv = np.stack(np.broadcast_arrays(length, girth), axis=-1).reshape(-1, 2) / TILE_M
    row, column = np.meshgrid(np.arange(len(sections) - 1), np.arange(_SIDES), indexing="ij")
    first = (row * (_SIDES + 1) + column).ravel()
    right, above = first + 1, first + _SIDES + 1
    faces = np.concatenate((np.stack((first, right, above + 1), 1), np.stack((first, above + 1, above), 1)))
    start = len(points) * (_SIDES + 1)
    disc = np.arange(1, _SIDES - 1)
    faces = np.concatenate((faces, start + np.stack((np.zeros_like(disc), disc + 1, disc), 1)))
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


def palm_balls(side: int, thickness: float) -> Balls:
    """Of the palm in its frame at scale 1."""
    knuckles = [
        [-0.0285, 0.0, -0.084, 0.0112],
        [-0.0095, 0.002, -0.086, 0.0116],
        [0.010, 0.0, -0.080, 0.0110],
        [0.027, -0.004, -0.072, 0.0098],
    ]
    heel = [
        [-0.013, -0.002, -0.004, 0.0150],
        [0.014, -0.002, -0.004, 0.0150],
        [0.023, -0.006, -0.030, 0.0135],
        [-0.014, -0.004, -0.030, 0.0140],
    ]
    return _mirrored(knuckles + heel, side, thickness)


def web_balls(side: int, thickness: float) -> Balls:
    """Of what lies between the palm and the root of the thumb, in the palm's frame at scale 1."""
    balls = [[-0.021, -0.011, -0.021, 0.0135], [-0.026, -0.004, -0.062, 0.0085], [-0.006, -0.007, -0.030, 0.0135]]
    return _mirrored(balls, side, thickness)


def _mirrored(balls: list[list[float]], side: int, thickness: float) -> Balls:
    found = np.array(balls)
    found[:, 0] *= side
    found[:, 3] *= 0.5 + 0.5 * thickness
    return found


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


def sleeve_sections(start_m: float, end_m: float, loose_m: float, *, cuff_m: float = 0.0) -> Float[np.ndarray, "N 3"]:
    """Of a sleeve around the forearm from ``start_m`` behind the wrist, ``loose_m`` wider than the arm."""
    z = np.linspace(start_m, end_m, 40)
    arm = np.stack([np.interp(z, FOREARM_SECTIONS_M[:, 0], FOREARM_SECTIONS_M[:, k]) for k in (1, 2)], axis=1)
    loose = loose_m + np.where(z < start_m + cuff_m, 0.0025, 0.0)
    # Cloth does not follow the arm: rounder than it, and tightest at the elbow.
    size = arm + (loose * (1 - 0.5 * (z - start_m) / max(end_m - start_m, 1e-6)))[:, None]
    return np.column_stack((z, size[:, 0], np.maximum(size[:, 1], 0.85 * size[:, 0])))


def upper_sleeve_sections(start_m: float, loose_m: float) -> Float[np.ndarray, "N 3"]:
    """Of a sleeve around the upper arm, from ``start_m`` behind the elbow to the shoulder."""
    z = np.linspace(start_m, UPPER_ARM_M + 0.02, 40)
    arm = ELBOW_BALL_M[0, 3] + 0.018 * np.sin(np.clip(z / UPPER_ARM_M, 0, 1) * 1.6)
    wide = arm + (0.5 * loose_m if start_m == 0 else loose_m + 0.006)
    return np.column_stack((z, wide, wide))


def shoulder_ball(sections: Float[np.ndarray, "N 3"]) -> Balls:
    """What closes a sleeve at the shoulder."""
    return np.array([[0.0, 0.0, sections[-1, 0] - 0.01, sections[-1, 1] + 0.004]])


def folds(count: int, depth_m: float, rng: np.random.Generator) -> Float[np.ndarray, "N S"]:
    """How cloth stands out along a sleeve of some sections and around it."""
    along, around = np.linspace(0, 1, count)[:, None], 2 * np.pi * np.arange(_SIDES) / _SIDES
    field = np.zeros((count, _SIDES))
    for _ in range(7):
        turns, waves = int(rng.integers(0, 3)), rng.uniform(3, 11)
        field += np.sin(2 * np.pi * waves * along + turns * around + rng.uniform(0, 2 * np.pi)) * rng.uniform(0.3, 1)
    return depth_m * field / max(np.abs(field).max(), 1e-9)
