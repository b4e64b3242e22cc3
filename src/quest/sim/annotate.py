"""Ground truth of one picture: where the entities are in it, and which of them are seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from quest.sim.articulation import apply
from quest.sim.cameras import PosedCamera
from quest.sim.entities import SimEntity
from quest.sim.objects import SimObject
from quest.sim.renderer import Picture

VISIBLE_WITHIN = 0.02
"""An entity is seen where the rendered depth is this close to its own, normalised units."""

MASK_RADIUS = 0.05
"""Rims and fronts have no mesh of their own: their mask is their body within this distance, normalised units."""


def entity_points(entities: Sequence[SimEntity], poses: Float[np.ndarray, "*T B 4 4"]) -> Float[np.ndarray, "*T E 3"]:
    """World points of entities on bodies that stand at ``world_from_body``."""
    carried_by = poses[..., np.array([e.body for e in entities], int), :, :]
    point = np.array([e.point for e in entities]).reshape(-1, 3, 1)
    return (carried_by[..., :3, :3] @ point)[..., 0] + carried_by[..., :3, 3]


def project_points(point_world: Float[np.ndarray, "E 3"], posed: PosedCamera) -> tuple[
    Float[np.ndarray, "E 2"], Float[np.ndarray, " E"]
]:  # fmt: skip
    """Pixels (NaN behind the camera) and depths along +z of world points."""
    point = apply(posed.cam_from_world, point_world)
    z = np.where(point[:, 2] > 1e-6, point[:, 2], np.nan)
    camera = posed.camera
    uv = np.stack((camera.fx * point[:, 0] / z + camera.cx, camera.fy * point[:, 1] / z + camera.cy), axis=-1)
    return uv, point[:, 2]


def see_entities(
    sim_object: SimObject, posed: PosedCamera, picture: Picture, point_world: Float[np.ndarray, "E 3"]
) -> tuple[Float[np.ndarray, "E 2"], Bool[np.ndarray, " E"]]:
    """Pixel of every entity in a picture, and which of them are seen."""
    uv, depth = project_points(point_world, posed)
    bodies = [e.body for e in sim_object.entities]
    return uv, visible_entities(picture, uv, depth, bodies, half_diagonal_m=sim_object.half_diagonal_m)


def visible_entities(
    picture: Picture,
    uv_px: Float[np.ndarray, "E 2"],
    depth_m: Float[np.ndarray, " E"],
    body: list[int],
    *,
    half_diagonal_m: float,
) -> Bool[np.ndarray, " E"]:
    """Which entities are seen: inside the image, and their own body at their own depth in the 3 x 3 pixels around.

    The neighbours count because a rim lies on the very edge of its body, where the pixel that holds it may
    already show what is behind.

    ``depth_m`` are the entities' depths along +z, ``body`` the bodies that carry them.
    """
    height, width = picture.depth_m.shape
    visible = np.zeros(len(uv_px), dtype=bool)
    for e, (u, v) in enumerate(uv_px):
        if not (0 <= u < width and 0 <= v < height):
            continue
        x, y = int(u), int(v)
        around = (slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2))
        same_body = picture.body[around] == 1 + body[e]
        near = np.abs(picture.depth_m[around] - depth_m[e]) <= VISIBLE_WITHIN * half_diagonal_m
        visible[e] = bool((same_body & near).any())
    return visible


def entity_mask(
    picture: Picture,
    entities: tuple[SimEntity, ...],
    point_world: Float[np.ndarray, "E 3"],
    posed: PosedCamera,
    *,
    half_diagonal_m: float,
) -> UInt8[np.ndarray, "H W"]:
    """Affordance mask: 0 nothing, else 1 + entity index.

    Handles and knobs are their own meshes; a rim or front is what is seen of its body within 0.05 normalised
    units of its point; hinges have no mask.
    """
    mask = picture.entity.copy()
    radius = MASK_RADIUS * half_diagonal_m
    camera = posed.camera
    uv, depth = project_points(point_world, posed)
    for e, entity in enumerate(entities):
        if entity.parts or entity.label == "hinge" or depth[e] <= radius:
            continue
        reach = radius * max(camera.fx, camera.fy) / (depth[e] - radius) + 1
        y0, y1 = np.clip([uv[e, 1] - reach, uv[e, 1] + reach + 1], 0, camera.height).astype(int)
        x0, x1 = np.clip([uv[e, 0] - reach, uv[e, 0] + reach + 1], 0, camera.width).astype(int)
        y, x = np.mgrid[y0:y1, x0:x1]
        z = picture.depth_m[y, x]
        seen = np.stack(((x + 0.5 - camera.cx) / camera.fx * z, (y + 0.5 - camera.cy) / camera.fy * z, z), axis=-1)
        centre = apply(posed.cam_from_world, point_world[e])
        near = (np.linalg.norm(seen - centre, axis=-1) <= radius) & (z > 0)
        near &= (picture.body[y, x] == 1 + entity.body) & (mask[y, x] == 0)
        mask[y, x] = np.where(near, 1 + e, mask[y, x])
    return mask
