"""Static cameras in front of an object: where they stand and how they are aimed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from quest.types import Camera

AZIMUTH_DEG = (-60.0, 60.0)
ELEVATION_DEG = (5.0, 50.0)
FLAT_ELEVATION_DEG = (20.0, 65.0)
"""For objects that lie flat, of which a low camera would see an edge only."""
FIELD_OF_VIEW_DEG = (40.0, 60.0)
_DISTINCT_DEG = 18.0
_FILL = (0.80, 0.97)


@dataclass(frozen=True)
class PosedCamera:
    """A camera and where it stands."""

    camera: Camera
    cam_from_world: Float[np.ndarray, "4 4"]


def sample_cameras(
    points: Float[np.ndarray, "N 3"], count: int, rng: np.random.Generator, *, width: int, height: int
) -> list[PosedCamera]:
    """Cameras in the front hemisphere (+x) that see all ``points``, about 18 degrees apart or more.

    Args:
        points: world points that must stay inside the image: the object on the origin, in all its joint states.
        count: how many cameras.
        rng: what they are drawn from.
        width: image width, pixels.
        height: image height, pixels.
    """
    extent = np.ptp(points, axis=0)
    flat = extent[2] < 0.35 * extent.max()
    low, high = np.deg2rad(FLAT_ELEVATION_DEG if flat else ELEVATION_DEG)
    directions: list[np.ndarray] = []
    apart = np.deg2rad(_DISTINCT_DEG)
    while len(directions) < count:
        azimuth, elevation = rng.uniform(*np.deg2rad(AZIMUTH_DEG)), rng.uniform(low, high)
        direction = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        if all(direction @ d < np.cos(apart) for d in directions):
            directions.append(direction)
        else:
            apart *= 0.97  # so that any number of cameras fits
    return [_aimed(points, d, rng, width=width, height=height) for d in directions]


def _aimed(
    points: Float[np.ndarray, "N 3"],
    direction: Float[np.ndarray, "3"],
    rng: np.random.Generator,
    *,
    width: int,
    height: int,
) -> PosedCamera:
    fov = rng.uniform(*np.deg2rad(FIELD_OF_VIEW_DEG))
    fill = rng.uniform(*_FILL)
    roll = rng.normal(0.0, np.deg2rad(1.5))
    focal = max(width, height) / 2 / np.tan(fov / 2)
    forward = -direction
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    rotation = np.stack((right, down, forward))
    local = points @ rotation.T
    slope = fill * np.array([width, height]) / 2 / focal
    # Smallest camera distance at which both sides of the image still hold every point, per image axis:
    # (x - cx) <= slope (z + d) for all points, and the mirrored inequality, solved for the centre cx and d.
    centre, distance = np.zeros(2), 0.0
    for axis in range(2):
        upper = (local[:, axis] - slope[axis] * local[:, 2]).max()
        lower = (local[:, axis] + slope[axis] * local[:, 2]).min()
        centre[axis] = (upper + lower) / 2
        distance = max(distance, (upper - lower) / 2 / slope[axis])
    eye_local = np.array([centre[0], centre[1], -distance])
    # Off-centre by part of the room that the fill factor leaves.
    eye_local[:2] += rng.uniform(-0.5, 0.5, size=2) * (1 - fill) * distance * slope
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -eye_local
    return PosedCamera(Camera(focal, focal, width / 2, height / 2, width, height), cam_from_world)
