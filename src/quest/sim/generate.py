"""From an object and a seed to a take: choose joints and cameras, play the motion, render, annotate."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.errors import ConfigError, ObjectError
from quest.sim.annotate import entity_mask, project_points, visible_entities
from quest.sim.appearance import Region, apply_appearance, sample_appearance
from quest.sim.articulation import Articulation, apply
from quest.sim.cameras import PosedCamera, sample_cameras
from quest.sim.motion import FRAMES_PER_S, HOLD_FRAMES, motion_script
from quest.sim.objects import SimObject
from quest.sim.renderer import Picture, Renderer
from quest.types import Clip, Entity, Take, TakeInfo, View

_CAMERA_ATTEMPTS = 12


@dataclass(frozen=True)
class TakeSettings:
    """What all takes of a run have in common.

    Attributes:
        views: how many static cameras.
        size: width and height of the images, pixels.
        every: keep every n-th frame of the motion script.
        frames_per_joint: frames of the script that each joint gets.
        randomize_materials: whether objects get random materials, beside random light and surroundings.
    """

    views: int = 3
    size: int = 224
    every: int = 1
    frames_per_joint: int = 60
    randomize_materials: bool = True

    def __post_init__(self) -> None:
        if self.views < 1 or self.size < 16:
            raise ConfigError(f"take: expected at least 1 view of 16 pixels, got {self.views} of {self.size}")
        if not 1 <= self.every <= HOLD_FRAMES:
            raise ConfigError(f"take: expected to keep every 1st to {HOLD_FRAMES}th frame, got every {self.every}")


def take_name(object_id: str, level: int, seed: int) -> str:
    """Name of a take in its store."""
    return f"{object_id}-L{level}-s{seed:06d}"


def generate_take(
    sim_object: SimObject,
    level: int,
    seed: int,
    *,
    renderer: Renderer,
    settings: TakeSettings = TakeSettings(),
    provenance: dict[str, Any] | None = None,
) -> Take:
    """Renders one take with its ground truth; same object, level, seed and settings give the same arrays.

    Args:
        sim_object: the object.
        level: how many joints move one after the other.
        seed: of the motion, the cameras and the appearance.
        renderer: the process's renderer.
        settings: views, size and frames.
        provenance: who made it, for the take's metadata.

    Raises:
        ObjectError: the object has fewer than ``level`` joints that carry an entity that moves.
        RendererError: the renderer broke.
    """
    key = [zlib.crc32(sim_object.object_id.encode()), level, seed]
    motion_rng, camera_rng, appearance_rng = (np.random.default_rng([*key, stream]) for stream in range(3))
    articulation = sim_object.articulation
    moved_joints = choose_joints(sim_object, level, motion_rng)
    script = motion_script(articulation, moved_joints, motion_rng, frames_per_joint=settings.frames_per_joint)
    velocity = np.gradient(script, axis=0) * FRAMES_PER_S
    kept = np.arange(0, len(script), settings.every)
    position = script[kept]
    poses = np.stack([articulation.poses(p) for p in position])
    points = np.stack([_entity_points(sim_object, p) for p in poses])
    swept = _swept(articulation, poses)
    appearance = sample_appearance(appearance_rng, randomize_materials=settings.randomize_materials)
    region = Region.around(swept)

    def dress(scene: Any, bodies: list[Any]) -> None:
        apply_appearance(scene, appearance, region, bodies, procedural=sim_object.source == "procedural")

    cameras = _cameras(sim_object, swept, poses[0], points[0], camera_rng, renderer, settings)
    stage = renderer.stage(sim_object, cameras, dress)
    recorders = [_ViewRecorder(sim_object, camera, len(kept)) for camera in cameras]
    for t in range(len(kept)):
        stage.pose(poses[t])
        for recorder, picture in zip(recorders, stage.pictures(), strict=True):
            recorder.add(t, picture, points[t])
    name = take_name(sim_object.object_id, level, seed)
    stamp_s = kept / FRAMES_PER_S
    flow = np.zeros_like(points)
    flow[:-1] = np.diff(points, axis=0)
    return Take(
        info=_info(sim_object, name, level, seed, moved_joints, FRAMES_PER_S / settings.every, provenance or {}),
        views=tuple(r.view(f"{name}/view{v}", stamp_s) for v, r in enumerate(recorders)),
        stamp_s=stamp_s,
        point_world=points.astype(np.float32),
        flow_world=flow.astype(np.float32),
        link_pose=poses.astype(np.float32),
        joint_position=position.astype(np.float32),
        joint_velocity=velocity[kept].astype(np.float32),
        joint_axis=np.stack([articulation.axes(p) for p in poses]).astype(np.float32),
    )


def choose_joints(sim_object: SimObject, level: int, rng: np.random.Generator) -> tuple[int, ...]:
    """Which joints move in a take, in order.

    Joints whose entities can be seen while the object is closed come first: a tray moves after its oven's door.

    Raises:
        ObjectError: there are fewer than ``level`` joints that carry an entity that moves.
    """
    movable = sim_object.movable
    if not 1 <= level <= len(movable):
        raise ObjectError(
            f"{sim_object.object_id}: expected a level between 1 and the object's number of joints that carry a moving "
            f"entity ({len(movable)}), got {level}; use a lower level or another object"
        )
    seen = {e.joint for e in sim_object.entities if e.label != "hinge" and not e.inside}
    order = [int(j) for j in rng.permutation(movable)]
    return tuple(sorted(order, key=lambda j: j not in seen)[:level])


@dataclass
class _ViewRecorder:
    """Collects what one camera sees, frame by frame."""

    sim_object: SimObject
    posed: PosedCamera
    frames: int
    _arrays: dict[str, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        t, h, w, e = self.frames, self.posed.camera.height, self.posed.camera.width, len(self.sim_object.entities)
        self._arrays = {
            "rgb": np.zeros((t, h, w, 3), np.uint8),
            "depth_m": np.zeros((t, h, w), np.float32),
            "link_id": np.zeros((t, h, w), np.uint8),
            "entity_id": np.zeros((t, h, w), np.uint8),
            "uv_px": np.zeros((t, e, 2), np.float32),
            "visible": np.zeros((t, e), bool),
        }

    def add(self, t: int, picture: Picture, point_world: Float[np.ndarray, "E 3"]) -> None:
        o, a = self.sim_object, self._arrays
        a["rgb"][t], a["depth_m"][t], a["link_id"][t] = picture.rgb, picture.depth_m, picture.body
        a["entity_id"][t] = entity_mask(picture, o.entities, point_world, self.posed, half_diagonal_m=o.half_diagonal_m)
        a["uv_px"][t], a["visible"][t] = _seen(o, self.posed, picture, point_world)

    def view(self, name: str, stamp_s: Float[np.ndarray, " T"]) -> View:
        a = self._arrays
        poses = np.tile(self.posed.cam_from_world, (self.frames, 1, 1))
        clip = Clip(name, self.posed.camera, a["rgb"], a["depth_m"], stamp_s, poses)
        return View(clip, a["uv_px"], a["visible"], a["link_id"], a["entity_id"])


def _seen(
    sim_object: SimObject, posed: PosedCamera, picture: Picture, point_world: Float[np.ndarray, "E 3"]
) -> tuple[np.ndarray, np.ndarray]:
    uv, depth = project_points(point_world, posed)
    bodies = [e.body for e in sim_object.entities]
    return uv, visible_entities(picture, uv, depth, bodies, half_diagonal_m=sim_object.half_diagonal_m)


def _entity_points(sim_object: SimObject, poses: Float[np.ndarray, "B 4 4"]) -> Float[np.ndarray, "E 3"]:
    return np.stack([apply(poses[e.body], e.point) for e in sim_object.entities])


def _swept(articulation: Articulation, poses: Float[np.ndarray, "T B 4 4"]) -> Float[np.ndarray, "N 3"]:
    """World points that bound the object, at a few moments of the take."""
    moments = poses[np.unique(np.linspace(0, len(poses) - 1, 16).astype(int))]
    return np.concatenate(
        [apply(pose[b], points) for b, points in enumerate(articulation.body_hulls) if len(points) for pose in moments]
    )


def _cameras(
    sim_object: SimObject,
    swept: Float[np.ndarray, "N 3"],
    rest_poses: Float[np.ndarray, "B 4 4"],
    rest_points: Float[np.ndarray, "E 3"],
    rng: np.random.Generator,
    renderer: Renderer,
    settings: TakeSettings,
) -> list[PosedCamera]:
    """Cameras that see an entity at rest in every view; the best of a few draws if none does."""
    followed = [i for i, e in enumerate(sim_object.entities) if e.label != "hinge"]
    best: tuple[tuple[int, int], list[PosedCamera]] | None = None
    for _ in range(_CAMERA_ATTEMPTS):
        cameras = sample_cameras(swept, settings.views, rng, width=settings.size, height=settings.size)
        # Only geometry matters here: the stage stays dark.
        stage = renderer.stage(sim_object, cameras, lambda scene, bodies: None)
        stage.pose(rest_poses)
        pictures = stage.pictures()
        seen = np.stack(
            [_seen(sim_object, c, p, rest_points)[1][followed] for c, p in zip(cameras, pictures, strict=True)]
        )
        score = (int(seen.any(axis=1).sum()), int(seen.any(axis=0).sum()))
        if best is None or score > best[0]:
            best = (score, cameras)
        if score[0] == len(cameras):
            break
    assert best is not None
    return best[1]


def _info(
    sim_object: SimObject,
    name: str,
    level: int,
    seed: int,
    moved_joints: tuple[int, ...],
    frames_per_s: float,
    provenance: dict[str, Any],
) -> TakeInfo:
    return TakeInfo(
        name=name,
        source=sim_object.source,
        object_id=sim_object.object_id,
        category=sim_object.category,
        level=level,
        seed=seed,
        half_diagonal_m=sim_object.half_diagonal_m,
        frames_per_s=frames_per_s,
        entities=tuple(Entity(e.name, e.label, e.body, e.joint) for e in sim_object.entities),
        joints=tuple(j.joint for j in sim_object.articulation.joints),
        moved_joints=moved_joints,
        provenance=provenance,
    )
