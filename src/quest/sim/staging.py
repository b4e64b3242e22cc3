"""What is played in a take, and from where it is seen, before anything is drawn for good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.errors import ConfigError, ObjectError
from quest.sim.annotate import project_points, visible_entities
from quest.sim.articulation import apply
from quest.sim.cameras import PosedCamera, sample_cameras
from quest.sim.motion import FRAMES_PER_S, HOLD_FRAMES, motion_script
from quest.sim.objects import SimObject
from quest.sim.occluder import Occluder
from quest.sim.renderer import Picture, Renderer

_CAMERA_ATTEMPTS = 12


@dataclass(frozen=True)
class TakeSettings:
    """What all takes of a run have in common.

    Attributes:
        views: how many static cameras.
        size: width and height of the images, pixels.
        every: keep every n-th frame of the motion script.
        frames_per_joint: frames of the script that each joint gets; suites have scripts of their own.
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


@dataclass(frozen=True)
class Playback:
    """A motion script, played.

    Attributes:
        kept: frames of the script that the take keeps.
        position: joint positions, radians or metres.
        velocity: per second, of the whole script.
        poses: ``world_from_body``.
        points: world point of every entity.
        swept: world points that bound the object, at a few moments.
    """

    kept: Int[np.ndarray, " T"]
    position: Float[np.ndarray, "T J"]
    velocity: Float[np.ndarray, "T J"]
    poses: Float[np.ndarray, "T B 4 4"]
    points: Float[np.ndarray, "T E 3"]
    swept: Float[np.ndarray, "N 3"]

    @classmethod
    def of(cls, sim_object: SimObject, script: Float[np.ndarray, "S J"], every: int = 1) -> Playback:
        """Plays every n-th frame of a script."""
        kept = np.arange(0, len(script), every)
        poses = np.stack([sim_object.articulation.poses(p) for p in script[kept]])
        points = np.stack([[apply(p[e.body], e.point) for e in sim_object.entities] for p in poses])
        velocity = (np.gradient(script, axis=0) * FRAMES_PER_S)[kept]
        return cls(kept, script[kept], velocity, poses, points, _swept(sim_object, poses))


@dataclass(frozen=True)
class Staging:
    """A take before it is drawn.

    Attributes:
        moved_joints: the joints that move, in order.
        playback: the motion.
        cameras: where it is seen from.
        occluders: things that come between the cameras and the object; their poses are those of the whole script.
        about: what the take's provenance says of it.
    """

    moved_joints: tuple[int, ...]
    playback: Playback
    cameras: tuple[PosedCamera, ...]
    occluders: tuple[Occluder, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)


def stage_plain(
    sim_object: SimObject,
    level: int,
    motion_rng: np.random.Generator,
    camera_rng: np.random.Generator,
    *,
    renderer: Renderer,
    settings: TakeSettings,
) -> Staging:
    """An ordinary take: nothing but the object.

    Raises:
        ObjectError: the object has fewer than ``level`` joints that carry an entity that moves.
    """
    joints = choose_joints(sim_object, level, motion_rng)
    script = motion_script(sim_object.articulation, joints, motion_rng, frames_per_joint=settings.frames_per_joint)
    playback = Playback.of(sim_object, script, settings.every)
    return Staging(joints, playback, _cameras(sim_object, playback, camera_rng, renderer, settings))


def choose_joints(
    sim_object: SimObject, level: int, rng: np.random.Generator, *, among: Sequence[int] | None = None
) -> tuple[int, ...]:
    """Which joints move in a take, in order.

    Joints whose entities can be seen while the object is closed come first: a tray moves after its oven's door.

    Args:
        sim_object: the object.
        level: how many joints.
        rng: what they are drawn from.
        among: the joints that they are chosen from; by default all that carry an entity that moves.

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


def _cameras(
    sim_object: SimObject, playback: Playback, rng: np.random.Generator, renderer: Renderer, settings: TakeSettings
) -> tuple[PosedCamera, ...]:
    """Cameras that see an entity at rest in every view; the best of a few draws if none does."""
    followed = [i for i, e in enumerate(sim_object.entities) if e.label != "hinge"]
    best: tuple[tuple[int, int], list[PosedCamera]] | None = None
    for _ in range(_CAMERA_ATTEMPTS):
        cameras = sample_cameras(playback.swept, settings.views, rng, width=settings.size, height=settings.size)
        # Only geometry matters here: the stage stays dark.
        stage = renderer.stage(sim_object, cameras, lambda scene, bodies: None)
        stage.pose(playback.poses[0])
        pictures = stage.pictures()
        seen = np.stack(
            [
                see_entities(sim_object, camera, picture, playback.points[0])[1][followed]
                for camera, picture in zip(cameras, pictures, strict=True)
            ]
        )
        score = (int(seen.any(axis=1).sum()), int(seen.any(axis=0).sum()))
        if best is None or score > best[0]:
            best = (score, cameras)
        if score[0] == len(cameras):
            break
    assert best is not None
    return tuple(best[1])
