"""From an object and a seed to a take: choose joints and cameras, play the motion, render, annotate."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import asdict, is_dataclass
from functools import partial
from typing import Any

import numpy as np

from quest.sim.annotate import entity_mask, see_entities
from quest.sim.appearance import Region, apply_appearance, odd_appearance, sample_appearance
from quest.sim.cameras import CameraPath
from quest.sim.motion import FRAMES_PER_S
from quest.sim.objects import SimObject
from quest.sim.procedural.model import Dice
from quest.sim.renderer import Picture, Renderer
from quest.sim.room import furnished
from quest.sim.sensor import sense
from quest.sim.settings import TakeSettings
from quest.sim.staging import Staging, stage_occlusion, stage_plain
from quest.sim.stretch import draw_stretch, stretched
from quest.sim.suites import Suite
from quest.types import Camera, Clip, Entity, Take, TakeInfo, View

_DEFAULTS = TakeSettings()
_TOLD = (
    "cameras", "motion", "sensor",
    "physics", "gripper", "hand", "disturbance", "broad_materials", "fixed_scene", "room", "things",
)  # fmt: skip
"""Settings that a take's provenance names where they are unusual."""


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

    So many joints as ``level`` says move one after the other. A suite's settings are not applied: pass them.
    ``provenance`` says who made it, for the take's metadata; what is unusual about the take is added.

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
    about = {**(provenance or {}), **_conditions(settings, suite)}
    if settings.stretch != 1:
        factors = draw_stretch(np.random.default_rng([*key, 5]), settings.stretch)
        sim_object, about["stretch"] = stretched(sim_object, factors), factors.tolist()
    if settings.room:
        sim_object, about["beside"] = furnished(sim_object, Dice(np.random.PCG64([*scene, 6])), things=settings.things)
    stage = stage_plain if hiding is None else partial(stage_occlusion, hiding=hiding)
    staging = stage(sim_object, level, motion_rng, camera_rng, props_rng, renderer=renderer, settings=settings)
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
    paths = [path.kept(played.kept) for path in staging.cameras]
    films = _film(sim_object, staging, paths, appearance_rng, settings)
    views = []
    for v, (path, film, rng) in enumerate(zip(paths, films, sensor_rng.spawn(len(films)), strict=True)):
        rgb, depth_m = sense(film.pop("rgb"), film.pop("depth_m"), settings.sensor, rng, camera=path.camera)
        clip = Clip(f"{name}/view{v}", path.camera, rgb, depth_m, stamp_s, path.cam_from_world)
        views.append(View(clip, **film))
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
        views=tuple(views),
        stamp_s=stamp_s,
        point_world=played.points.astype(np.float32),
        flow_world=flow.astype(np.float32),
        link_pose=played.poses.astype(np.float32),
        joint_position=played.position.astype(np.float32),
        joint_velocity=played.velocity.astype(np.float32),
        joint_axis=sim_object.articulation.axes(played.poses).astype(np.float32),
    )


def _conditions(settings: TakeSettings, suite: Suite | None) -> dict[str, Any]:
    """How a take is made, for its provenance: a digest of all settings, and what is unusual in plain words."""
    found: dict[str, Any] = {"settings": settings.digest}
    if suite is not None and suite.variant:
        found["variant"] = suite.variant
    for what in _TOLD:
        value = getattr(settings, what)
        if value != getattr(_DEFAULTS, what):
            found[what] = asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
    return found


def _film(
    sim_object: SimObject,
    staging: Staging,
    paths: list[CameraPath],
    appearance_rng: np.random.Generator,
    settings: TakeSettings,
) -> list[dict[str, np.ndarray]]:
    """Dresses the scene, plays the take and draws every frame: colours, depth and ground truth of every view."""
    appearance = sample_appearance(
        appearance_rng, randomize_materials=settings.randomize_materials, broad=settings.broad_materials
    )
    if settings.disturbance == "texture":
        appearance = odd_appearance(appearance, appearance_rng)
    procedural = sim_object.source == "procedural"
    wide = not all(path.static for path in staging.cameras)
    region = Region.around(staging.playback.swept)
    scene, bodies = staging.stage.scene, staging.stage.bodies
    apply_appearance(scene, appearance, region, bodies, procedural=procedural, wide=wide, room=settings.room)
    points, o = staging.playback.points, sim_object
    films = [_blank(len(points), len(o.entities), path.camera) for path in paths]
    for t, pictures in enumerate(_pictures(staging, paths)):
        for film, path, picture in zip(films, paths, pictures, strict=True):
            posed = path.at(t)
            film["rgb"][t], film["depth_m"][t], film["link_id"][t] = picture.rgb, picture.depth_m, picture.body
            film["entity_id"][t] = entity_mask(picture, o.entities, points[t], posed, half_diagonal_m=o.half_diagonal_m)
            film["uv_px"][t], film["visible"][t] = see_entities(o, posed, picture, points[t])
    return films


def _blank(frames: int, entities: int, camera: Camera) -> dict[str, np.ndarray]:
    shape = (frames, camera.height, camera.width)
    return {
        "rgb": np.zeros((*shape, 3), np.uint8),
        "depth_m": np.zeros(shape, np.float32),
        "link_id": np.zeros(shape, np.uint8),
        "entity_id": np.zeros(shape, np.uint8),
        "uv_px": np.zeros((frames, entities, 2), np.float32),
        "visible": np.zeros((frames, entities), bool),
    }


def _pictures(staging: Staging, paths: list[CameraPath]) -> Iterator[list[Picture]]:
    """What the cameras see at every kept frame; while the caller looks at one, the next one is drawn."""
    stage, played = staging.stage, staging.playback
    actors = [prop.add(stage.scene) for prop in staging.props]
    pictures: list[Picture] = []
    drawn: tuple[np.ndarray, ...] = ()
    for t, kept in enumerate(played.kept.tolist()):
        cameras = [path.at(t) for path in paths]
        poses = (played.poses[t], *(c.cam_from_world for c in cameras), *(prop.pose(kept) for prop in staging.props))
        moved = t == 0 or not all(map(np.array_equal, poses, drawn))  # else the pictures are the same
        if moved:
            stage.pose(played.poses[t])
            stage.aim(cameras)
            for actor, prop in zip(actors, staging.props, strict=True):
                prop.place(actor, kept)
            stage.render()
        if t > 0:
            yield pictures
        if moved:
            pictures, drawn = stage.read_back(), poses
    yield pictures
