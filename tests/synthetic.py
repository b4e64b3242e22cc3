"""A tiny take rendered analytically, so that everything downstream of the simulator is tested without it.

The object is a row of thin textured panels in front of a wall. Each panel is a link with one joint and one entity:
panels 0, 2, ... slide towards the camera (drawers), panels 1, 3, ... swing about their left edge (doors). World axes:
x right, y away from the cameras, z up. Every pixel is a ray cut with planes, so depth, masks and pixels agree exactly.
"""

from __future__ import annotations

import numpy as np

from quest.types import LABELS, Camera, Clip, Entity, Joint, Take, TakeInfo, View

PANEL_WIDTH_M = 0.26
PANEL_HEIGHT_M = 0.5
PANEL_PITCH_M = 0.3
ENTITY_RADIUS_M = 0.04
WALL_Y_M = 0.6
FRAMES_PER_S = 30.0


def make_take(
    *,
    frames: int = 24,
    views: int = 2,
    entities: int = 3,
    size: tuple[int, int] = (64, 64),
    seed: int = 0,
    name: str | None = None,
    hinges: bool = False,
) -> Take:
    """A take with exact ground truth; nothing moves in its first eight frames (or third, where it is shorter).

    Args:
        frames: number of frames.
        views: number of static cameras.
        entities: number of panels, each with one entity; labels cycle through :data:`quest.types.LABELS`.
        size: image width and height, pixels.
        seed: textures and amplitudes.
        name: name of the take; made up from the seed by default.
        hinges: add one entity labelled ``hinge`` per panel, after the others.
    """
    rng = np.random.default_rng(seed)
    position, kinds, limits = _motion(rng, frames, entities)
    rest = np.array([[(k - (entities - 1) / 2) * PANEL_PITCH_M - PANEL_WIDTH_M / 2, 0.0, 0.0] for k in range(entities)])
    pose = np.stack([_link_pose(rest[k], kinds[k], position[:, k]) for k in range(entities)], axis=1)

    local = np.tile([0.7 * PANEL_WIDTH_M, 0.0, 0.55 * PANEL_HEIGHT_M], (entities, 1))
    links = list(range(entities))
    labels = [LABELS[k % len(LABELS)] for k in range(entities)]
    if hinges:
        local = np.concatenate([local, np.tile([0.0, 0.0, 0.5 * PANEL_HEIGHT_M], (entities, 1))])
        links, labels = links * 2, labels + ["hinge"] * entities
    point = np.einsum("tlij,lj->tli", pose[:, links][..., :3, :3], local) + pose[:, links][..., :3, 3]

    half_diagonal_m = 0.5 * float(np.hypot((entities - 1) * PANEL_PITCH_M + PANEL_WIDTH_M, PANEL_HEIGHT_M))
    stamp_s = np.arange(frames) / FRAMES_PER_S
    axis = np.where(np.array(kinds)[:, None] == "prismatic", [0.0, -1.0, 0.0], [0.0, 0.0, -1.0])
    info = TakeInfo(
        name=name or f"panels-{seed}",
        source="procedural",
        object_id=f"panels-{seed}",
        category="Panels",
        level=entities,
        seed=seed,
        half_diagonal_m=half_diagonal_m,
        frames_per_s=FRAMES_PER_S,
        entities=tuple(Entity(f"link_{k}/{label}", label, k, k) for k, label in zip(links, labels, strict=True)),
        joints=tuple(Joint(f"joint_{k}", kinds[k], 0.0, limits[k]) for k in range(entities)),
        moved_joints=tuple(range(entities)),
        provenance={"made_by": "tests/synthetic.py"},
    )
    textures = rng.uniform(40, 255, size=(entities + 1, 8, 8, 3))
    cameras = [_camera(v, views, size, 3.6 * half_diagonal_m) for v in range(views)]
    rendered = [
        _render_view(
            f"{info.name}/view_{v}", *cameras[v], pose, point, local[:entities], links, textures, half_diagonal_m
        )
        for v in range(views)
    ]
    return Take(
        info=info,
        views=tuple(rendered),
        stamp_s=stamp_s,
        point_world=point.astype(np.float32),
        flow_world=np.diff(point, axis=0, append=point[-1:]).astype(np.float32),
        link_pose=pose.astype(np.float32),
        joint_position=position.astype(np.float32),
        joint_velocity=(np.diff(position, axis=0, append=position[-1:]) * FRAMES_PER_S).astype(np.float32),
        joint_axis=np.tile(np.concatenate([rest, axis], axis=1), (frames, 1, 1)).astype(np.float32),
    )


def _motion(rng: np.random.Generator, frames: int, joints: int) -> tuple[np.ndarray, list, list[float]]:
    """Minimum-jerk strokes, one joint after the other; kinds and upper limits of the joints."""
    kinds = ["prismatic" if k % 2 == 0 else "revolute" for k in range(joints)]
    limits = [0.3 if kind == "prismatic" else np.pi / 2 for kind in kinds]
    hold = 8 if frames > 16 else frames // 3
    step = (frames - hold) / max(joints, 1)
    position = np.zeros((frames, joints))
    for k in range(joints):
        s = np.clip((np.arange(frames) - hold - k * step + 1) / max(step, 1e-9), 0, 1)
        position[:, k] = (10 * s**3 - 15 * s**4 + 6 * s**5) * limits[k] * rng.uniform(0.6, 0.9)
    return position, kinds, limits


def _link_pose(rest: np.ndarray, kind: str, position: np.ndarray) -> np.ndarray:
    """``world_from_link`` over time; a link's origin is the lower left corner of its panel."""
    pose = np.tile(np.eye(4), (len(position), 1, 1))
    pose[:, :3, 3] = rest
    if kind == "prismatic":
        pose[:, 1, 3] -= position
        return pose
    cos, sin = np.cos(position), np.sin(position)
    pose[:, 0, 0], pose[:, 0, 1], pose[:, 1, 0], pose[:, 1, 1] = cos, sin, -sin, cos
    return pose


def _camera(view: int, views: int, size: tuple[int, int], distance_m: float) -> tuple[Camera, np.ndarray]:
    """Camera ``view`` of ``views`` on an arc in front of the object, and its ``cam_from_world``."""
    azimuth = np.deg2rad(0.0 if views == 1 else -25 + 50 * view / (views - 1))
    target = np.array([0.0, 0.0, PANEL_HEIGHT_M / 2])
    eye = target + distance_m * np.array([np.sin(azimuth), -np.cos(azimuth), 0.35])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3], cam_from_world[:3, 3] = rotation, -rotation @ eye
    width, height = size
    focal = 1.5 * min(width, height)
    return Camera(focal, focal, width / 2, height / 2, width, height), cam_from_world


def _render_view(
    name: str,
    camera: Camera,
    cam_from_world: np.ndarray,
    pose: np.ndarray,
    point: np.ndarray,
    local: np.ndarray,
    links: list[int],
    textures: np.ndarray,
    half_diagonal_m: float,
) -> View:
    frames = len(pose)
    rendered = [_render_frame(camera, cam_from_world, pose[t], local, textures) for t in range(frames)]
    rgb, depth_m, link_id, entity_id = (np.stack(images) for images in zip(*rendered, strict=True))
    cam_point = point @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    uv = np.stack([cam_point[..., 0], cam_point[..., 1]], axis=-1) / cam_point[..., 2:]
    uv = uv * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    visible = np.zeros(uv.shape[:2], dtype=bool)
    for t, e in np.ndindex(*visible.shape):
        x, y = np.floor(uv[t, e]).astype(int)
        if 0 <= x < camera.width and 0 <= y < camera.height:
            near = abs(depth_m[t, y, x] - cam_point[t, e, 2]) < 0.02 * half_diagonal_m
            neighbours = link_id[t, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            visible[t, e] = near and (neighbours == links[e] + 1).any()
    clip = Clip(name, camera, rgb, depth_m, np.arange(frames) / FRAMES_PER_S, np.tile(cam_from_world, (frames, 1, 1)))
    return View(clip, uv.astype(np.float32), visible, link_id, entity_id)


def _render_frame(
    camera: Camera, cam_from_world: np.ndarray, pose: np.ndarray, local: np.ndarray, textures: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colour, depth (to 0.1 mm, as the store keeps it), link id and entity id of one frame."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    ray_cam = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rotation = cam_from_world[:3, :3]
    # z of ray_cam is 1, so the length along the ray is depth.
    eye, ray = -rotation.T @ cam_from_world[:3, 3], ray_cam @ rotation

    depth = (WALL_Y_M - eye[1]) / ray[..., 1]
    hit = eye + depth[..., None] * ray
    rgb = _texture(textures[-1], hit[..., 0] / 2.0, hit[..., 2] / 2.0) * 0.45
    link_id, entity_id = np.zeros(x.shape, np.uint8), np.zeros(x.shape, np.uint8)
    for k, (world_from_link, entity) in enumerate(zip(pose, local, strict=True)):
        link_from_world = np.linalg.inv(world_from_link)
        start, direction = link_from_world[:3, :3] @ eye + link_from_world[:3, 3], ray @ link_from_world[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -start[1] / direction[..., 1]
            hit = start + distance[..., None] * direction
        inside = (distance > 0.1) & (distance < depth) & (np.abs(hit[..., 0] / PANEL_WIDTH_M - 0.5) < 0.5)
        inside &= np.abs(hit[..., 2] / PANEL_HEIGHT_M - 0.5) < 0.5
        near = np.linalg.norm(hit - entity, axis=-1) < ENTITY_RADIUS_M
        colour = _texture(textures[k], np.nan_to_num(hit[..., 0]) / 0.3, np.nan_to_num(hit[..., 2]) / 0.3)
        colour = np.where(near[..., None], 255 - colour, colour)
        depth = np.where(inside, distance, depth)
        rgb = np.where(inside[..., None], colour, rgb)
        link_id[inside] = k + 1
        entity_id[inside] = np.where(near[inside], k + 1, 0)
    return rgb.astype(np.uint8), (np.rint(depth * 1e4).astype(np.float32) * np.float32(1e-4)), link_id, entity_id


def _texture(cells: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A smooth periodic texture: bilinear interpolation of random cells, eight to the unit."""
    n = len(cells)
    i, j = np.floor(u * n).astype(int), np.floor(v * n).astype(int)
    a, b = (u * n - i)[..., None], (v * n - j)[..., None]
    top = (1 - a) * cells[j % n, i % n] + a * cells[j % n, (i + 1) % n]
    low = (1 - a) * cells[(j + 1) % n, i % n] + a * cells[(j + 1) % n, (i + 1) % n]
    return (1 - b) * top + b * low
