"""From an object and a seed to a take: choose joints and cameras, play the motion, render, annotate."""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.sim.annotate import entity_mask
from quest.sim.appearance import Region, apply_appearance, odd_appearance, sample_appearance
from quest.sim.cameras import CameraPath
from quest.sim.motion import FRAMES_PER_S
from quest.sim.objects import SimObject
from quest.sim.occlusion import stage_occlusion
from quest.sim.procedural.model import Dice
from quest.sim.renderer import Picture, Renderer
from quest.sim.room import furnished
from quest.sim.sensor import SensorModel, sense
from quest.sim.settings import TakeSettings
from quest.sim.staging import Staging, see_entities, stage_plain
from quest.sim.stretch import draw_stretch, stretched
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
        settings: views, size, frames, and how cameras, joints and sensors behave.
        suite: which suite it belongs to; None for an ordinary take. Its settings are not applied: pass them.
        provenance: who made it, for the take's metadata; what is unusual about the take is added.

    Raises:
        ConfigError: the suite cannot be made with these settings.
        ObjectError: the object has fewer than ``level`` joints that carry an entity that moves, or the suite finds
            nothing in it to hide.
        RendererError: the renderer broke.
    """
    hiding = None if suite is None else suite.hiding
    # What hides has draws of its own; all other suites show the motion of the ordinary take, to be compared with it.
    own = suite.tag.encode() if suite is not None and hiding is not None else b""
    key = [zlib.crc32(sim_object.object_id.encode()), level, seed, *own]
    scene = key[:1] if settings.fixed_scene else key
    motion_rng, camera_rng, appearance_rng, props_rng, sensor_rng = (
        np.random.default_rng([*(scene if n in (1, 2) else key), n]) for n in range(5)
    )
    sim_object, shape = _shaped(sim_object, np.random.default_rng([*key, 5]), settings)
    if settings.room:
        sim_object, beside = furnished(sim_object, Dice(np.random.PCG64([*scene, 6])), things=settings.things)
        shape = {**shape, "beside": beside}
    if hiding is None:
        staging = stage_plain(
            sim_object, level, motion_rng, camera_rng, props_rng, renderer=renderer, settings=settings
        )
    else:
        staging = stage_occlusion(
            sim_object, level, hiding, motion_rng, camera_rng, props_rng, renderer=renderer, settings=settings
        )
    about = {**(provenance or {}), **_conditions(settings, suite), **shape}
    return record_take(
        sim_object,
        staging,
        name=take_name(sim_object.object_id, level, seed, suite),
        seed=seed,
        appearance_rng=appearance_rng,
        sensor_rng=sensor_rng,
        settings=settings,
        suite="standard" if suite is None else suite.name,
        provenance=about,
    )


def record_take(
    sim_object: SimObject,
    staging: Staging,
    *,
    name: str,
    seed: int,
    appearance_rng: np.random.Generator,
    sensor_rng: np.random.Generator,
    settings: TakeSettings,
    suite: str = "standard",
    provenance: dict[str, Any] | None = None,
) -> Take:
    """Renders a take that is staged, with its ground truth.

    Light, surroundings and materials are drawn from ``appearance_rng``, noise from ``sensor_rng``; all else is for the
    take's metadata, where what the staging says of itself is added to ``provenance``.

    Raises:
        RendererError: the renderer broke.
    """
    played = staging.playback
    stamp_s = played.kept / FRAMES_PER_S
    views = _record(sim_object, staging, appearance_rng, settings)
    flow = np.zeros_like(played.points)
    flow[:-1] = np.diff(played.points, axis=0)
    info = TakeInfo(
        name=name,
        source=sim_object.source,
        object_id=sim_object.object_id,
        category=sim_object.category,
        level=len(staging.moved_joints),
        seed=seed,
        half_diagonal_m=sim_object.half_diagonal_m,
        frames_per_s=FRAMES_PER_S / settings.every,
        entities=tuple(Entity(e.name, e.label, e.body, e.joint) for e in sim_object.entities),
        joints=tuple(j.joint for j in sim_object.articulation.joints),
        moved_joints=staging.moved_joints,
        provenance={**(provenance or {}), **staging.about},
        suite=suite,
    )
    return Take(
        info=info,
        views=tuple(
            r.view(f"{name}/view{v}", stamp_s, settings.sensor, rng)
            for v, (r, rng) in enumerate(zip(views, sensor_rng.spawn(len(views)), strict=True))
        ),
        stamp_s=stamp_s,
        point_world=played.points.astype(np.float32),
        flow_world=flow.astype(np.float32),
        link_pose=played.poses.astype(np.float32),
        joint_position=played.position.astype(np.float32),
        joint_velocity=played.velocity.astype(np.float32),
        joint_axis=sim_object.articulation.axes(played.poses).astype(np.float32),
    )


def _shaped(
    sim_object: SimObject, rng: np.random.Generator, settings: TakeSettings
) -> tuple[SimObject, dict[str, Any]]:
    """The object in the shape that it has in this take, and what is unusual about that."""
    if settings.stretch == 1:
        return sim_object, {}
    factors = draw_stretch(rng, settings.stretch)
    return stretched(sim_object, factors), {"stretch": factors.tolist()}


def _conditions(settings: TakeSettings, suite: Suite | None) -> dict[str, Any]:
    """How a take is made, for its provenance: a digest of all settings, and what is unusual in plain words."""
    ordinary, found = TakeSettings(), {}
    for what in ("cameras", "motion", "sensor"):
        if getattr(settings, what) != getattr(ordinary, what):
            found[what] = asdict(getattr(settings, what))
    for what in ("physics", "gripper", "hand", "disturbance", "broad_materials", "fixed_scene", "room", "things"):
        if getattr(settings, what) != getattr(ordinary, what):
            found[what] = getattr(settings, what)
    variant = {"variant": suite.variant} if suite is not None and suite.variant else {}
    return {"settings": settings.digest, **variant, **found}


def _record(
    sim_object: SimObject, staging: Staging, appearance_rng: np.random.Generator, settings: TakeSettings
) -> list[_ViewRecorder]:
    """Dresses the scene, plays the take and photographs every frame."""
    appearance = sample_appearance(
        appearance_rng, randomize_materials=settings.randomize_materials, broad=settings.broad_materials
    )
    if settings.disturbance == "texture":
        appearance = odd_appearance(appearance, appearance_rng)
    played, stage, props = staging.playback, staging.stage, staging.props
    region = Region.around(played.swept)
    wide = not all(path.static for path in staging.cameras)
    actors: list[Any] = []

    def dress(scene: Any, bodies: list[Any]) -> None:
        procedural = sim_object.source == "procedural"
        room = settings.room
        apply_appearance(scene, appearance, region, bodies, procedural=procedural, wide=wide, room=room)
        actors.extend(prop.add(scene) for prop in props)

    stage.dress(dress)
    paths = [path.kept(played.kept) for path in staging.cameras]
    recorders = [_ViewRecorder(sim_object, path, len(played.kept)) for path in paths]
    pictures: list[Picture] = []
    drawn: tuple[np.ndarray, ...] = ()

    def annotate(t: int) -> None:
        for recorder, picture in zip(recorders, pictures, strict=True):
            recorder.add(t, picture, played.points[t])

    for t, kept in enumerate(played.kept):
        cameras = [path.at(t) for path in paths]
        poses = (played.poses[t], *(c.cam_from_world for c in cameras), *(prop.pose(int(kept)) for prop in props))
        if t == 0 or not all(map(np.array_equal, poses, drawn)):  # else nothing moved: the pictures are the same
            stage.pose(played.poses[t])
            stage.aim(cameras)
            for actor, prop in zip(actors, props, strict=True):
                prop.place(actor, int(kept))
            stage.shoot()
            if t > 0:
                annotate(t - 1)  # while this frame is drawn
            pictures, drawn = stage.develop(), poses
        else:
            annotate(t - 1)
    annotate(len(played.kept) - 1)
    return recorders


@dataclass
class _ViewRecorder:
    """Collects what one camera sees, frame by frame."""

    sim_object: SimObject
    path: CameraPath
    frames: int
    _arrays: dict[str, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        t, h, w, e = self.frames, self.path.camera.height, self.path.camera.width, len(self.sim_object.entities)
        self._arrays = {
            "rgb": np.zeros((t, h, w, 3), np.uint8),
            "depth_m": np.zeros((t, h, w), np.float32),
            "link_id": np.zeros((t, h, w), np.uint8),
            "entity_id": np.zeros((t, h, w), np.uint8),
            "uv_px": np.zeros((t, e, 2), np.float32),
            "visible": np.zeros((t, e), bool),
        }

    def add(self, t: int, picture: Picture, point_world: Float[np.ndarray, "E 3"]) -> None:
        o, a, posed = self.sim_object, self._arrays, self.path.at(t)
        a["rgb"][t], a["depth_m"][t], a["link_id"][t] = picture.rgb, picture.depth_m, picture.body
        a["entity_id"][t] = entity_mask(picture, o.entities, point_world, posed, half_diagonal_m=o.half_diagonal_m)
        a["uv_px"][t], a["visible"][t] = see_entities(o, posed, picture, point_world)

    def view(self, name: str, stamp_s: Float[np.ndarray, " T"], sensor: SensorModel, rng: np.random.Generator) -> View:
        a = self._arrays
        rgb, depth_m = sense(a["rgb"], a["depth_m"], sensor, rng, camera=self.path.camera)
        clip = Clip(name, self.path.camera, rgb, depth_m, stamp_s, self.path.cam_from_world)
        return View(clip, a["uv_px"], a["visible"], a["link_id"], a["entity_id"])
