"""What is played in a take, and from where it is seen, before anything is drawn for good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from trimesh.bounds import corners

from quest.errors import ObjectError
from quest.sim.annotate import project_points, visible_entities
from quest.sim.articulation import apply
from quest.sim.cameras import CameraPath, PosedCamera, bump, sample_camera_paths
from quest.sim.gripper import plan_gripper
from quest.sim.hand import plan_hand
from quest.sim.motion import FRAMES_PER_S, MotionStyle, long_script, motion_script
from quest.sim.objects import SimObject
from quest.sim.physics import play_physically
from quest.sim.props import Prop, change_light, disturbed_at
from quest.sim.pull import Puller
from quest.sim.renderer import Picture, Renderer, Stage
from quest.sim.settings import TakeSettings

PULL_MARGIN = (20, 12)
"""Frames of a joint's share in which a gripper or a hand comes, and goes."""

_CAMERA_ATTEMPTS = 12


@dataclass(frozen=True)
class Playback:
    """A motion script, played."""

    kept: Int[np.ndarray, " T"]
    """Frames of the script that the take keeps."""
    position: Float[np.ndarray, "T J"]
    """Joint positions, radians or metres."""
    velocity: Float[np.ndarray, "T J"]
    """Per second, of the whole script."""
    poses: Float[np.ndarray, "T B 4 4"]
    """``world_from_body``."""
    points: Float[np.ndarray, "T E 3"]
    """World point of every entity."""
    swept: Float[np.ndarray, "N 3"]
    """World points that bound the object, at a few moments."""

    @classmethod
    def of(cls, sim_object: SimObject, script: Float[np.ndarray, "S J"], every: int = 1) -> Playback:
        """Plays every n-th frame of a script."""
        kept = np.arange(0, len(script), every)
        poses = sim_object.articulation.poses(script[kept])
        points = np.stack([[apply(p[e.body], e.point) for e in sim_object.entities] for p in poses])
        velocity = (np.gradient(script, axis=0) * FRAMES_PER_S)[kept]
        return cls(kept, script[kept], velocity, poses, points, _swept(sim_object, poses))


@dataclass(frozen=True)
class Staging:
    """A take before it is drawn."""

    moved_joints: tuple[int, ...]
    """The joints that move, in order."""
    playback: Playback
    cameras: tuple[CameraPath, ...]
    """Where it is seen from at every frame of the script."""
    stage: Stage
    """The object before these cameras, not dressed yet."""
    props: tuple[Prop, ...] = ()
    """What else is in the scene and moves or changes, by frames of the script."""
    about: dict[str, Any] = field(default_factory=dict)
    """What the take's provenance says of it."""


def stage_plain(
    sim_object: SimObject,
    level: int,
    motion_rng: np.random.Generator,
    camera_rng: np.random.Generator,
    props_rng: np.random.Generator,
    *,
    renderer: Renderer,
    settings: TakeSettings,
) -> Staging:
    """A take in which nothing is hidden on purpose: the object, and what pulls or disturbs if the settings say so.

    Raises:
        ObjectError: the object has fewer than ``level`` joints that carry an entity that moves, or a gripper or
            a hand finds nothing to grasp.
    """
    joints = choose_joints(sim_object, level, motion_rng)
    script = _script(sim_object, joints, motion_rng, settings)
    playback = Playback.of(sim_object, script, settings.every)
    if settings.fixed_scene:
        playback = replace(playback, swept=_reach(sim_object))
    cameras, stage = _cameras(sim_object, playback, len(script), camera_rng, renderer, settings)
    props: list[Prop] = []
    about: dict[str, Any] = {}
    puller = _puller(sim_object, script, joints, cameras, props_rng, settings)
    if puller is not None:
        props.append(puller)
        about["grasped"] = [[name, *played_frames(playback.kept, first, end)] for name, first, end in puller.grasps]
    if settings.disturbance == "light":
        props.append(change_light(len(script), props_rng))
    if settings.disturbance == "bump":
        at = disturbed_at(len(script), props_rng)
        cameras = tuple(bump(path, at, props_rng) for path in cameras)
        about["bumped"] = played_frames(playback.kept, at, len(script))[0]
    return Staging(joints, playback, cameras, stage, tuple(props), about)


def _puller(
    sim_object: SimObject,
    script: Float[np.ndarray, "S J"],
    joints: tuple[int, ...],
    cameras: tuple[CameraPath, ...],
    rng: np.random.Generator,
    settings: TakeSettings,
) -> Puller | None:
    """The gripper or the hand that pulls, if the settings say so."""
    timing = {"margin": _motion_style(settings).margin, "frames_per_joint": settings.frames_per_joint}
    if settings.gripper:
        return plan_gripper(sim_object, script, joints, **timing, rng=rng)
    if settings.hand:
        seen_from = np.concatenate([np.linalg.inv(path.cam_from_world[::8])[:, :3, 3] for path in cameras])
        return plan_hand(sim_object, script, joints, **timing, eyes=seen_from, rng=rng)
    return None


def _motion_style(settings: TakeSettings) -> MotionStyle:
    wanted = settings.motion
    return replace(wanted, margin=PULL_MARGIN) if settings.pulled and wanted.margin == (0, 0) else wanted


def _script(
    sim_object: SimObject, joints: tuple[int, ...], rng: np.random.Generator, settings: TakeSettings
) -> Float[np.ndarray, "S J"]:
    articulation, style = sim_object.articulation, _motion_style(settings)
    share = settings.frames_per_joint
    if settings.frames is None:
        script = motion_script(articulation, joints, rng, frames_per_joint=share, style=style)
    else:
        script = long_script(articulation, joints, rng, frames=settings.frames, frames_per_joint=share, style=style)
    return play_physically(sim_object, script, rng) if settings.physics else script


def played_frames(kept: Int[np.ndarray, " T"], first: int, end: int) -> tuple[int, int]:
    """Frames of the take that show a range of frames of the script: the first one, and one past the last."""
    low, high = np.searchsorted(kept, [first, end])
    return int(low), int(high)


def choose_joints(
    sim_object: SimObject, level: int, rng: np.random.Generator, *, among: Sequence[int] | None = None
) -> tuple[int, ...]:
    """Which joints move in a take, in order.

    Joints whose entities can be seen while the object is closed come first: a tray moves after its oven's door.

    They are chosen from ``among``, by default all that carry an entity that moves.

    Raises:
        ObjectError: there are fewer than ``level`` joints that carry an entity that moves.
    """
    movable = sim_object.movable if among is None else among
    if not 1 <= level <= len(movable):
        raise ObjectError(
            f"{sim_object.object_id}: expected a level between 1 and the object's number of joints that carry a moving "
            f"entity ({len(movable)}), got {level}; use a lower level or another object"
        )
    seen = {e.joint for e in sim_object.entities if e.label != "hinge" and not e.inside}
    order = [int(j) for j in rng.permutation(movable)]
    return tuple(sorted(order, key=lambda j: j not in seen)[:level])


def see_entities(
    sim_object: SimObject, posed: PosedCamera, picture: Picture, points: Float[np.ndarray, "E 3"]
) -> tuple[Float[np.ndarray, "E 2"], Bool[np.ndarray, " E"]]:
    """Pixel of every entity in a picture, and which of them are seen."""
    uv, depth = project_points(points, posed)
    bodies = [e.body for e in sim_object.entities]
    return uv, visible_entities(picture, uv, depth, bodies, half_diagonal_m=sim_object.half_diagonal_m)


def _swept(sim_object: SimObject, poses: Float[np.ndarray, "T B 4 4"]) -> Float[np.ndarray, "N 3"]:
    moments = poses[np.unique(np.linspace(0, len(poses) - 1, 16).astype(int))]
    hulls = sim_object.articulation.body_hulls
    return np.concatenate([apply(pose[b], hull) for b, hull in enumerate(hulls) if len(hull) for pose in moments])


def _reach(sim_object: SimObject) -> Float[np.ndarray, "N 3"]:
    """World points that bound the object with each of its joints open by itself."""
    joints = sim_object.articulation.joints
    rest = sim_object.articulation.rest
    opened = rest + np.diag([j.opening() for j in joints])
    return _swept(sim_object, sim_object.articulation.poses(np.stack((rest, *opened))))


def _cameras(
    sim_object: SimObject,
    playback: Playback,
    frames: int,
    rng: np.random.Generator,
    renderer: Renderer,
    settings: TakeSettings,
) -> tuple[tuple[CameraPath, ...], Stage]:
    """Cameras that see an entity at rest in every view, or the best of a few draws; and the object before them."""
    followed = [i for i, e in enumerate(sim_object.entities) if e.label != "hinge"]
    best: tuple[tuple[int, int], list[CameraPath]] | None = None
    stage: Stage | None = None
    for _ in range(_CAMERA_ATTEMPTS):
        paths = sample_camera_paths(
            playback.swept if sim_object.view_m is None else corners(sim_object.view_m),
            settings.views,
            frames,
            rng,
            style=settings.cameras,
            width=settings.width,
            height=settings.height,
        )
        cameras = [path.at(0) for path in paths]
        if stage is None:
            stage = renderer.stage(sim_object, cameras)  # only geometry matters here: it stays dark
            stage.pose(playback.poses[0])
        stage.aim(cameras)
        seen = np.stack(
            [
                see_entities(sim_object, camera, picture, playback.points[0])[1][followed]
                for camera, picture in zip(cameras, stage.pictures(), strict=True)
            ]
        )
        score = (int(seen.any(axis=1).sum()), int(seen.any(axis=0).sum()))
        if best is None or score > best[0]:
            best = (score, paths)
        if score[0] == len(cameras):
            break
    assert best is not None
    assert stage is not None
    return tuple(best[1]), stage
