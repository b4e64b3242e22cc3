"""Takes in which something hides a moving entity: when joints move, what is hidden when, by what, seen from where.

Every joint has its share of the script. It starts to move in full view, the occluder comes while it moves, the joint
moves on and stops while its entity is hidden, and the occluder leaves. The occluder stands still as long as it hides:
it covers the whole hidden path, so that its motion tells nothing of the entity's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull

from quest.errors import ObjectError
from quest.sim.articulation import Articulation, apply
from quest.sim.cameras import CameraPath, PosedCamera, sample_camera_paths
from quest.sim.entities import MOVES_AT_LEAST
from quest.sim.motion import HOLD_FRAMES, minimum_jerk, sample_opening
from quest.sim.objects import SimObject
from quest.sim.props import Occluder, Shape, fit_shape, sample_occluder_surface, slide_in
from quest.sim.renderer import Renderer, Stage
from quest.sim.settings import TakeSettings
from quest.sim.staging import Playback, Staging, choose_joints, played_frames, see_entities
from quest.sim.suites import HIDDEN_FRAMES, Hiding

SURROUNDINGS = 0.09
"""Radius of what is hidden around an entity, as a share of the image's width: 20 pixels of 224."""

_ATTEMPTS = 24
_AMPLITUDE = (0.75, 1.0)
_MOVES_HIDDEN = (0.4, 0.7)
_SEEN_AT_LEAST = 14
_SLIDE_FRAMES = (2, 3)


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
    hiding: Hiding,
    motion_rng: np.random.Generator,
    camera_rng: np.random.Generator,
    occluder_rng: np.random.Generator,
    *,
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
    joints_left = _joints_with_look_alikes(sim_object) if hiding.look_alike else sim_object.movable
    hidden = hiding.frames or int(occluder_rng.integers(HIDDEN_FRAMES[0], HIDDEN_FRAMES[1] + 1))
    stage: Stage | None = None
    best: tuple[tuple[int, ...], Float[np.ndarray, "S J"], PosedCamera, list[_Hidden]] | None = None
    for _ in range(_ATTEMPTS):
        joints = choose_joints(sim_object, level, motion_rng, among=joints_left)
        script, episodes = occlusion_script(sim_object.articulation, joints, hiding, hidden, motion_rng)
        playback = Playback.of(sim_object, script)
        (path,) = sample_camera_paths(
            playback.swept,
            1,
            len(script),
            camera_rng,
            style=settings.cameras,
            width=settings.width,
            height=settings.height,
        )
        camera = path.at(0)
        stage = stage or renderer.stage(sim_object, [camera])  # geometry matters, not light
        stage.aim([camera])
        found = _hide(sim_object, playback, episodes, camera, hiding, occluder_rng, stage)
        if len(found) >= min(level, 2) and (best is None or len(found) > len(best[3])):
            best = (joints, script, camera, found)
        if len(found) == level:
            break
    if best is None or stage is None:
        beside = "beside a look-alike that stays in view" if hiding.look_alike else "with no look-alike in view"
        raise ObjectError(
            f"{sim_object.object_id}: expected a view in which a moving entity is seen before and after, and can be "
            f"hidden {beside}, found none in {_ATTEMPTS} draws; use another seed or another object"
        )
    joints, script, camera, found = best
    occluders = tuple(
        Occluder(h.shape, sample_occluder_surface(occluder_rng), slide_in(h.shape, camera, away, occluder_rng))
        for h in found
        for away in [h.episode.away(len(script))]
    )
    playback = Playback.of(sim_object, script, settings.every)
    about = {
        "look_alike": hiding.look_alike,
        "hidden": [
            [sim_object.entities[h.entity].name, *played_frames(playback.kept, h.episode.hidden, h.episode.shown)]
            for h in found
        ],
    }
    return Staging(joints, playback, (CameraPath.standing(camera, len(script)),), stage, occluders, about)


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
    episodes: list[Episode],
    posed: PosedCamera,
    hiding: Hiding,
    rng: np.random.Generator,
    stage: Stage,
) -> list[_Hidden]:
    """What can be hidden of every episode's entities as wanted, from one camera."""
    found = []
    for episode in episodes:
        moments = np.array(
            [
                max(episode.start - 1, 0),
                (episode.moves + episode.hidden) // 2,
                episode.hidden - episode.slide - 1,
                (episode.hidden + episode.stops) // 2,
                episode.end - 1,
            ]
        )
        uv, visible = _seen_at(sim_object, playback, moments, posed, stage)
        entity = _entity_of(sim_object, episode, visible)
        if entity is None or _travel(playback, entity, episode) < MOVES_AT_LEAST * sim_object.half_diagonal_m:
            continue
        label = sim_object.entities[entity].label
        alike = [i for i, e in enumerate(sim_object.entities) if e.label == label and i != entity]
        if not hiding.look_alike and visible[:, alike].any():
            continue
        slopes = slopes_to_hide(sim_object, playback, entity, episode, posed)
        nearest_m = float(apply(posed.cam_from_world, playback.swept)[:, 2].min())
        shape = fit_shape(slopes, posed, nearest_m, rng) if nearest_m > 0 else None
        if shape is None:
            continue
        beside = [i for i in alike if sim_object.entities[i].joint != episode.joint and visible[2:, i].all()]
        camera = posed.camera
        slope = (uv[2:] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        if hiding.look_alike and not any(not shape.hides(slope[:, i]).any() for i in beside):
            continue
        found.append(_Hidden(entity, episode, shape))
    return found


def _seen_at(
    sim_object: SimObject, playback: Playback, moments: Int[np.ndarray, " M"], posed: PosedCamera, stage: Stage
) -> tuple[Float[np.ndarray, "M E 2"], Bool[np.ndarray, "M E"]]:
    """Pixels of all entities at some frames, and which of them are seen with nothing before the object."""
    uv, visible = [], []
    for t in moments:
        stage.pose(playback.poses[t])
        (picture,) = stage.pictures()
        pixel, seen = see_entities(sim_object, posed, picture, playback.points[t])
        uv.append(pixel)
        visible.append(seen)
    return np.stack(uv), np.stack(visible)


def _entity_of(sim_object: SimObject, episode: Episode, visible: Bool[np.ndarray, "M E"]) -> int | None:
    """The first entity of the moving joint that is seen at rest, on its way, before it is hidden and at the end."""
    for i, e in enumerate(sim_object.entities):
        if e.joint == episode.joint and e.label != "hinge" and visible[[0, 1, 2, 4], i].all():
            return i
    return None


def _travel(playback: Playback, entity: int, episode: Episode) -> float:
    """How far an entity gets in view before it is hidden, metres: its joint cannot be seen from less."""
    return float(np.linalg.norm(playback.points[episode.hidden - 1, entity] - playback.points[episode.start, entity]))


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
