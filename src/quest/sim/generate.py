"""From an object and a seed to a take: choose joints and cameras, play the motion, render, annotate."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.sim.annotate import entity_mask
from quest.sim.appearance import Region, apply_appearance, sample_appearance
from quest.sim.cameras import PosedCamera
from quest.sim.motion import FRAMES_PER_S
from quest.sim.objects import SimObject
from quest.sim.occluder import add_occluder, place_occluder
from quest.sim.occlusion import stage_occlusion
from quest.sim.renderer import Picture, Renderer
from quest.sim.staging import Staging, TakeSettings, see_entities, stage_plain
from quest.sim.suites import Suite
from quest.types import Clip, Entity, Take, TakeInfo, View

_DEFAULTS = TakeSettings()


def take_name(object_id: str, level: int, seed: int, suite: Suite | None = None) -> str:
    """Name of a take in its store."""
    return f"{object_id}-L{level}-{'' if suite is None else f'{suite.tag}-'}s{seed:06d}"


def generate_take(
    sim_object: SimObject,
    level: int,
    seed: int,
    *,
    renderer: Renderer,
    settings: TakeSettings = _DEFAULTS,
    suite: Suite | None = None,
    provenance: dict[str, Any] | None = None,
) -> Take:
    """Renders one take with its ground truth; same object, level, seed, suite and settings give the same arrays.

    Args:
        sim_object: the object.
        level: how many joints move one after the other.
        seed: of the motion, the cameras and the appearance.
        renderer: the process's renderer.
        settings: views, size and frames.
        suite: what makes the take difficult; None for an ordinary take.
        provenance: who made it, for the take's metadata; takes of suites add what is hidden when.

    Raises:
        ConfigError: the suite cannot be made with these settings.
        ObjectError: the object has fewer than ``level`` joints that carry an entity that moves, or the suite finds
            nothing in it to hide.
        RendererError: the renderer broke.
    """
    key = [zlib.crc32(sim_object.object_id.encode()), level, seed, *([] if suite is None else suite.tag.encode())]
    motion_rng, camera_rng, appearance_rng, occluder_rng = (np.random.default_rng([*key, n]) for n in range(4))
    if suite is None:
        staging = stage_plain(sim_object, level, motion_rng, camera_rng, renderer=renderer, settings=settings)
    else:
        staging = stage_occlusion(
            sim_object, level, suite, motion_rng, camera_rng, occluder_rng, renderer=renderer, settings=settings
        )
    name = take_name(sim_object.object_id, level, seed, suite)
    played = staging.playback
    stamp_s = played.kept / FRAMES_PER_S
    views = _record(sim_object, staging, appearance_rng, renderer, settings)
    flow = np.zeros_like(played.points)
    flow[:-1] = np.diff(played.points, axis=0)
    info = TakeInfo(
        name=name,
        source=sim_object.source,
        object_id=sim_object.object_id,
        category=sim_object.category,
        level=level,
        seed=seed,
        half_diagonal_m=sim_object.half_diagonal_m,
        frames_per_s=FRAMES_PER_S / settings.every,
        entities=tuple(Entity(e.name, e.label, e.body, e.joint) for e in sim_object.entities),
        joints=tuple(j.joint for j in sim_object.articulation.joints),
        moved_joints=staging.moved_joints,
        provenance={**(provenance or {}), **staging.about},
        suite="standard" if suite is None else suite.name,
    )
    return Take(
        info=info,
        views=tuple(r.view(f"{name}/view{v}", stamp_s) for v, r in enumerate(views)),
        stamp_s=stamp_s,
        point_world=played.points.astype(np.float32),
        flow_world=flow.astype(np.float32),
        link_pose=played.poses.astype(np.float32),
        joint_position=played.position.astype(np.float32),
        joint_velocity=played.velocity.astype(np.float32),
        joint_axis=np.stack([sim_object.articulation.axes(p) for p in played.poses]).astype(np.float32),
    )


def _record(
    sim_object: SimObject,
    staging: Staging,
    appearance_rng: np.random.Generator,
    renderer: Renderer,
    settings: TakeSettings,
) -> list[_ViewRecorder]:
    """Dresses the scene, plays the take and photographs every frame."""
    appearance = sample_appearance(appearance_rng, randomize_materials=settings.randomize_materials)
    played, occluders = staging.playback, staging.occluders
    region = Region.around(played.swept)
    actors: list[Any] = []

    def dress(scene: Any, bodies: list[Any]) -> None:
        apply_appearance(scene, appearance, region, bodies, procedural=sim_object.source == "procedural")
        actors.extend(add_occluder(scene, occluder) for occluder in occluders)

    stage = renderer.stage(sim_object, staging.cameras, dress)
    frames = len(played.kept)
    recorders = [_ViewRecorder(sim_object, camera, frames) for camera in staging.cameras]
    pictures: list[Picture] = []
    drawn: tuple[np.ndarray, ...] = ()
    for t, kept in enumerate(played.kept):
        poses = (played.poses[t], *(o.world_from_shape[kept] for o in occluders))
        if t == 0 or not all(map(np.array_equal, poses, drawn)):  # else nothing moved: the pictures are the same
            stage.pose(played.poses[t])
            for actor, occluder in zip(actors, occluders, strict=True):
                place_occluder(actor, occluder, int(kept))
            pictures, drawn = stage.pictures(), poses
        for recorder, picture in zip(recorders, pictures, strict=True):
            recorder.add(t, picture, played.points[t])
    return recorders


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
        a["uv_px"][t], a["visible"][t] = see_entities(o, self.posed, picture, point_world)

    def view(self, name: str, stamp_s: Float[np.ndarray, " T"]) -> View:
        a = self._arrays
        poses = np.tile(self.posed.cam_from_world, (self.frames, 1, 1))
        clip = Clip(name, self.posed.camera, a["rgb"], a["depth_m"], stamp_s, poses)
        return View(clip, a["uv_px"], a["visible"], a["link_id"], a["entity_id"])
