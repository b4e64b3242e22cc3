"""What is played in a take, from where it is seen and what hides it, before anything is drawn for good.

In a take with hidden entities every joint has its share of the script. It starts to move in full view, the occluder
comes while it moves, the joint moves on and stops while its entity is hidden, and the occluder leaves. The occluder
stands still as long as it hides: it covers the whole hidden path, so that its motion tells nothing of the entity's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull
from trimesh.bounds import corners

from quest.errors import ObjectError
from quest.sim.annotate import entity_points, see_entities
from quest.sim.articulation import Articulation, apply
from quest.sim.cameras import CameraPath, PosedCamera, bump, sample_camera_paths
from quest.sim.entities import MOVES_AT_LEAST
from quest.sim.gripper import plan_gripper
from quest.sim.hand import plan_hand
from quest.sim.motion import (
    FRAMES_PER_S,
    HOLD_FRAMES,
    long_script,
    minimum_jerk,
    motion_script,
    sample_opening,
)
from quest.sim.objects import SimObject
from quest.sim.physics import play_physically
from quest.sim.props import (
    Occluder,
    Prop,
    Shape,
    change_light,
    disturbed_at,
    fit_shape,
    sample_occluder_surface,
    slide_in,
)
from quest.sim.pull import Task
from quest.sim.renderer import Renderer, Stage
from quest.sim.settings import TakeSettings
from quest.sim.suites import HIDDEN_FRAMES, Hiding

PULL_MARGIN = (20, 12)
"""Frames of a joint's share in which a gripper or a hand comes, and goes."""
SURROUNDINGS = 0.09
"""Radius of what is hidden around an entity, as a share of the image's width: 20 pixels of 224."""

_CAMERA_ATTEMPTS = 12
_HIDING_ATTEMPTS = 24
_AMPLITUDE = (0.75, 1.0)
_MOVES_HIDDEN = (0.4, 0.7)
_SEEN_AT_LEAST = 14
_SLIDE_FRAMES = (2, 3)


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
        points = entity_points(sim_object.entities, poses)
        velocity = (np.gradient(script, axis=0) * FRAMES_PER_S)[kept]
        return cls(kept, script[kept], velocity, poses, points, sim_object.articulation.swept(poses))

    def shows(self, first: int, end: int) -> tuple[int, int]:
        """Frames of the take that show a range of frames of the script: the first one, and one past the last."""
        low, high = np.searchsorted(self.kept, [first, end])
        return int(low), int(high)


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
    style = settings.motion
    if settings.pulled and style.margin == (0, 0):
        style = replace(style, margin=PULL_MARGIN)
    timing = {"frames_per_joint": settings.frames_per_joint, "style": style}
    if settings.frames is None:
        script = motion_script(sim_object.articulation, joints, motion_rng, **timing)
    else:
        script = long_script(sim_object.articulation, joints, motion_rng, frames=settings.frames, **timing)
    if settings.physics:
        script = play_physically(sim_object, script, motion_rng)
    playback = Playback.of(sim_object, script, settings.every)
    if settings.fixed_scene:
        articulation = sim_object.articulation
        # Whatever moves: points that bound the object with each of its joints open by itself.
        playback = replace(playback, swept=articulation.swept(articulation.poses(articulation.each_opened)))
    cameras, stage = _cameras(sim_object, playback, len(script), camera_rng, renderer, settings)
    props: list[Prop] = []
    about: dict[str, Any] = {}
    if settings.pulled:
        task = Task(sim_object, script, joints, style.margin, settings.frames_per_joint)
        if settings.gripper:
            puller = plan_gripper(task, props_rng)
        else:
            eyes = np.concatenate([np.linalg.inv(path.cam_from_world[::8])[:, :3, 3] for path in cameras])
            puller = plan_hand(task, props_rng, eyes)
        props += puller.parts
        about["grasped"] = [[name, *playback.shows(first, end)] for name, first, end in puller.grasps]
    if settings.disturbance == "light":
        props.append(change_light(len(script), props_rng))
    if settings.disturbance == "bump":
        at = disturbed_at(len(script), props_rng)
        cameras = tuple(bump(path, at, props_rng) for path in cameras)
        about["bumped"] = playback.shows(at, len(script))[0]
    return Staging(joints, playback, cameras, stage, tuple(props), about)


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


def _paths(
    points: Float[np.ndarray, "N 3"], frames: int, rng: np.random.Generator, settings: TakeSettings
) -> tuple[CameraPath, ...]:
    """Cameras that see some points, as the settings want them."""
    style, width, height = settings.cameras, settings.width, settings.height
    return tuple(sample_camera_paths(points, settings.views, frames, rng, style=style, width=width, height=height))


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
    points = playback.swept if sim_object.view_m is None else corners(sim_object.view_m)
    drawn: list[tuple[tuple[int, int], tuple[CameraPath, ...]]] = []
    stage: Stage | None = None
    while len(drawn) < _CAMERA_ATTEMPTS and not (drawn and drawn[-1][0][0] == settings.views):
        paths = _paths(points, frames, rng, settings)
        cameras = [path.at(0) for path in paths]
        stage = stage or renderer.stage(sim_object, cameras)  # only geometry matters here: it stays dark
        stage.pose(playback.poses[0])
        stage.aim(cameras)
        looks = zip(cameras, stage.pictures(), strict=True)
        seen = np.stack([see_entities(sim_object, *look, playback.points[0])[1][followed] for look in looks])
        drawn.append(((int(seen.any(axis=1).sum()), int(seen.any(axis=0).sum())), paths))
    assert stage is not None
    return max(drawn, key=lambda draw: draw[0])[1], stage


@dataclass(frozen=True)
class Episode:
    """One joint's share of the script; ends are one past the last frame."""

    joint: int
    start: int
    moves: int
    """First frame at which the joint is elsewhere."""
    hidden: int
    """First frame at which its entity is hidden."""
    stops: int
    """First frame at which the joint has stopped."""
    shown: int
    """End of the hidden frames."""
    end: int
    """End of the share."""
    slide: int
    """Frames that the occluder takes to come, and to go."""

    def away(self, frames: int) -> Float[np.ndarray, " T"]:
        """How far the occluder is at every frame of the script: 0 while it hides, 1 while it is out of the image."""
        t = np.arange(frames)
        gap = np.maximum(np.maximum(self.hidden - t, t - self.shown + 1), 0)
        return np.minimum(gap / (self.slide + 1), 1.0)


@dataclass(frozen=True)
class _Hidden:
    """An entity, the episode in which it is hidden, and what hides it."""

    entity: int
    episode: Episode
    shape: Shape


def stage_occlusion(
    sim_object: SimObject,
    level: int,
    motion_rng: np.random.Generator,
    camera_rng: np.random.Generator,
    occluder_rng: np.random.Generator,
    *,
    hiding: Hiding,
    renderer: Renderer,
    settings: TakeSettings,
) -> Staging:
    """A take in which entities are hidden, seen by one camera that stands still.

    Of up to 24 draws of joints, motion and camera the first is taken in which every joint's entity can be hidden: it is
    seen before and after, and look-alikes are in view or not, as wanted. With several joints, a draw in which
    two of them can be hidden is kept in reserve.

    Raises:
        ConfigError: more than one view is wanted, or what cannot be had together with hidden entities.
        ObjectError: the object has too few joints, or no draw is good enough.
    """
    hiding.check(settings)
    among = _joints_with_look_alikes(sim_object) if hiding.look_alike else sim_object.movable
    hidden = hiding.frames or int(occluder_rng.integers(HIDDEN_FRAMES[0], HIDDEN_FRAMES[1] + 1))
    stage: Stage | None = None
    best: tuple[tuple[int, ...], Float[np.ndarray, "S J"], CameraPath] | None = None
    found: list[_Hidden] = []
    for _ in range(_HIDING_ATTEMPTS):
        joints = choose_joints(sim_object, level, motion_rng, among=among)
        script, episodes = occlusion_script(sim_object.articulation, joints, hiding, hidden, motion_rng)
        playback = Playback.of(sim_object, script)
        (path,) = _paths(playback.swept, len(script), camera_rng, settings)
        camera = path.at(0)
        stage = stage or renderer.stage(sim_object, [camera])  # geometry matters, not light
        stage.aim([camera])
        now = [_hide(sim_object, playback, e, camera, hiding, occluder_rng, stage) for e in episodes]
        now = [h for h in now if h is not None]
        if len(now) >= min(level, 2) and len(now) > len(found):
            best, found = (joints, script, path), now
        if len(now) == level:
            break
    if best is None or stage is None:
        beside = "beside a look-alike that stays in view" if hiding.look_alike else "with no look-alike in view"
        raise ObjectError(
            f"{sim_object.object_id}: expected a view in which a moving entity is seen before and after, and can be "
            f"hidden {beside}, found none in {_HIDING_ATTEMPTS} draws; use another seed or another object"
        )
    joints, script, path = best
    occluders = []
    for h in found:
        surface = sample_occluder_surface(occluder_rng)
        poses = slide_in(h.shape, path.at(0), h.episode.away(len(script)), occluder_rng)
        occluders.append(Occluder(h.shape, surface, poses))
    playback = Playback.of(sim_object, script, settings.every)
    frames = [[sim_object.entities[h.entity].name, *playback.shows(h.episode.hidden, h.episode.shown)] for h in found]
    about = {"look_alike": hiding.look_alike, "hidden": frames}
    return Staging(joints, playback, (path,), stage, tuple(occluders), about)


def occlusion_script(
    articulation: Articulation, joints: tuple[int, ...], hiding: Hiding, hidden: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "S J"], list[Episode]]:
    """Joint positions at every frame, and what happens when.

    Every joint has one share, in which its entity is hidden for ``hidden`` frames.
    """
    episodes: list[Episode] = []
    movements: list[Float[np.ndarray, " N"]] = []
    start = 0
    for joint in joints:
        before, after = (int(rng.integers(low, high + 1)) for low, high in (hiding.before, hiding.after))
        # The joint stops well before it is shown again; at least half of its way is seen before it is hidden.
        unseen = max(1, round(rng.uniform(*_MOVES_HIDDEN) * hidden))
        room = before - (HOLD_FRAMES if start == 0 else 0)
        seen = min(max(_SEEN_AT_LEAST, round(1.5 * unseen)), room)
        unseen = min(unseen, seen)
        at = start + before
        slide = int(rng.integers(_SLIDE_FRAMES[0], _SLIDE_FRAMES[1] + 1))
        end = at + hidden + after
        episodes.append(Episode(joint, start, at - seen, at, at + unseen, at + hidden, end, slide))
        way = minimum_jerk(np.arange(1, seen + unseen + 1) / (seen + unseen))
        movements.append(rng.uniform(*_AMPLITUDE) * sample_opening(articulation, joint, rng) * way)
        start = end
    position = np.tile(articulation.rest, (start, 1))
    for e, movement in zip(episodes, movements, strict=True):
        position[e.moves : e.stops, e.joint] += movement
        position[e.stops :, e.joint] += movement[-1]
    return position, episodes


def _joints_with_look_alikes(sim_object: SimObject) -> tuple[int, ...]:
    """Movable joints with an entity whose label an entity on another joint bears too."""
    followed = [e for e in sim_object.entities if e.label != "hinge"]
    alike = {a.joint for a in followed for b in followed if a.label == b.label and a.joint != b.joint}
    joints = tuple(j for j in sim_object.movable if j in alike)
    if not joints:
        raise ObjectError(
            f"{sim_object.object_id}: expected moving joints with entities of the same label, found none; use an "
            "object with several doors or drawers, or hide entities alone"
        )
    return joints


def _hide(
    sim_object: SimObject,
    playback: Playback,
    episode: Episode,
    posed: PosedCamera,
    hiding: Hiding,
    rng: np.random.Generator,
    stage: Stage,
) -> _Hidden | None:
    """What can be hidden of an episode's entities as wanted, from one camera."""
    looks = []
    for t in (
        max(episode.start - 1, 0),
        (episode.moves + episode.hidden) // 2,
        episode.hidden - episode.slide - 1,
        (episode.hidden + episode.stops) // 2,
        episode.end - 1,
    ):
        stage.pose(playback.poses[t])
        (picture,) = stage.pictures()
        looks.append(see_entities(sim_object, posed, picture, playback.points[t]))
    uv, visible = (np.stack(each) for each in zip(*looks, strict=True))
    # The first entity of the moving joint that is seen at rest, on its way, before it is hidden and at the end.
    seen = np.logical_and.reduce(visible[[0, 1, 2, 4]], axis=0)
    own = [i for i, e in enumerate(sim_object.entities) if e.joint == episode.joint and e.label != "hinge" and seen[i]]
    if not own:
        return None
    entity, label = own[0], sim_object.entities[own[0]].label
    # What moves less in view tells nothing of its joint.
    moved_m = np.linalg.norm(playback.points[episode.hidden - 1, entity] - playback.points[episode.start, entity])
    alike = [i for i, e in enumerate(sim_object.entities) if e.label == label and i != entity]
    if moved_m < MOVES_AT_LEAST * sim_object.half_diagonal_m or (not hiding.look_alike and visible[:, alike].any()):
        return None
    slopes = slopes_to_hide(sim_object, playback, entity, episode, posed)
    nearest_m = float(apply(posed.cam_from_world, playback.swept)[:, 2].min())
    shape = fit_shape(slopes, posed, nearest_m, rng) if nearest_m > 0 else None
    if shape is None:
        return None
    if hiding.look_alike:
        camera = posed.camera
        slope = (uv[2:] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        beside = [i for i in alike if sim_object.entities[i].joint != episode.joint and visible[2:, i].all()]
        if all(shape.hides(slope[:, i]).any() for i in beside):
            return None
    return _Hidden(entity, episode, shape)


def slopes_to_hide(
    sim_object: SimObject, playback: Playback, entity: int, episode: Episode, posed: PosedCamera
) -> Float[np.ndarray, "N 2"]:
    """Rays, as x / z and y / z, that bound an entity and its surroundings on its whole hidden path."""
    e, camera = sim_object.entities[entity], posed.camera
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    disc = np.stack((np.cos(angle), np.sin(angle)), axis=-1) * SURROUNDINGS * camera.width / [camera.fx, camera.fy]
    parts = [np.asarray(sim_object.articulation.parts[i].surface.vertices) for i in e.parts]
    mesh = np.concatenate([e.point[None], *parts])
    slopes = []
    for t in range(episode.hidden, episode.stops + 1):
        points = apply(posed.cam_from_world, apply(playback.poses[t, e.body], mesh))
        rays = points[:, :2] / points[:, 2:]
        slopes += [rays, rays[:1] + disc]
    rays = np.concatenate(slopes)
    return rays[ConvexHull(rays).vertices]
