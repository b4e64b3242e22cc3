"""Make the sample clips that ship with the package: procedural furniture that no figure rests on.

    python benchmarks/make_sample.py                  # all clips: some minutes
    python benchmarks/make_sample.py --clip sample    # one of them

Objects have seeds from 120000 on, which belong to no part of the object split. Objects, seeds, camera and movements are
fixed: the clips can be made again. Beside each clip lies its truth, which tests compare the shipped weights with.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from quest.data.recording import write_recording
from quest.data.sample import SAMPLES
from quest.sim.articulation import apply
from quest.sim.cameras import CameraStyle, sample_camera_paths
from quest.sim.generate import record_take
from quest.sim.motion import minimum_jerk
from quest.sim.objects import SimObject
from quest.sim.plan import ObjectShelf
from quest.sim.props import Occluder, fit_shape, sample_occluder_surface, slide_in
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings
from quest.sim.staging import Episode, Playback, Staging, slopes_to_hide
from quest.types import Take

ASSETS = Path(__file__).parents[1] / "src" / "quest" / "assets"


@dataclass(frozen=True)
class Scene:
    """What happens in a clip. Frames are those of a script of 30 per second, of which every second one is kept."""

    object_id: str
    """A procedural object."""
    episodes: tuple[Episode, ...]
    """When each joint moves, and when its entity is occluded: from ``hidden`` up to ``shown``."""
    opening: tuple[float, ...]
    """How far each episode's joint opens, as a share of its range."""
    azimuth_deg: float
    """Direction to the camera; 0 is the front."""
    elevation_deg: float
    """Its height above the horizon."""
    camera_seed: int
    """What field of view, framing and roll are drawn from."""
    look_seed: int
    """What light, surroundings and materials are drawn from."""
    occluder_seed: int
    """What the occluders' shapes, materials and ways are drawn from."""


def _episode(joint: int, *, moves: int, stops: int, hidden: int, shown: int, end: int) -> Episode:
    return Episode(joint, 0, moves, hidden, stops, shown, end, slide=3)


SCENES = {
    "sample": Scene(
        "base_cabinet-120000",
        (
            _episode(2, moves=8, stops=56, hidden=52, shown=78, end=90),
            _episode(0, moves=90, stops=124, hidden=132, shown=152, end=170),
        ),
        (0.65, 0.8),
        azimuth_deg=4.0,
        elevation_deg=16.0,
        camera_seed=2,
        look_seed=2,
        occluder_seed=0,
    ),
    # The drawer is hidden as it stops: its knob is lost, an alarm rings, and it is found again.
    "sample-alarm": Scene(
        "drawer_desk-120014",
        (_episode(2, moves=10, stops=37, hidden=33, shown=66, end=150),),
        (0.8,),
        azimuth_deg=17.76134871435351,
        elevation_deg=22.919252442665027,
        camera_seed=840,
        look_seed=876,
        occluder_seed=310,
    ),
}


@dataclass(frozen=True)
class MakeSample:
    """Render the sample clips, with their truth beside them; those that are there are replaced."""

    clip: tuple[str, ...] = SAMPLES
    """Which ones."""
    size: tuple[int, int] = (640, 480)
    """Width and height, pixels."""
    out: Path = ASSETS
    """Folder that holds the clips."""

    def run(self) -> int:
        """Render takes and write their views as recordings."""
        renderer = Renderer()
        shelf = ObjectShelf()
        for name in self.clip:
            scene = SCENES[name]
            take = film(name, scene, shelf.load("procedural", scene.object_id), self.size, renderer)
            write(take, self.out / name)
        return 0


def write(take: Take, folder: Path) -> None:
    """Write the view of a take as a recording with the truth beside it, in place of what is there."""
    shutil.rmtree(folder, ignore_errors=True)
    # Millimetres, as real sensors give.
    write_recording(take.views[0].clip, folder, depth_scale_m=1e-3, crf=20)
    (folder / "truth.json").write_text(json.dumps(truth(take), separators=(",", ":")) + "\n")


def film(name: str, scene: Scene, thing: SimObject, size: tuple[int, int], renderer: Renderer) -> Take:
    """Play a scene and render it, with its ground truth.

    Raises:
        RendererError: the renderer broke.
        SystemExit: an entity cannot be occluded as the scene wants it.
    """
    azimuth_deg, elevation_deg = scene.azimuth_deg, scene.elevation_deg
    style = CameraStyle(azimuth_deg=(azimuth_deg, azimuth_deg), elevation_deg=(elevation_deg, elevation_deg))
    settings = TakeSettings(views=1, size=size, every=2, cameras=style)
    frames = max(episode.end for episode in scene.episodes)
    script = np.tile(thing.articulation.rest, (frames, 1))
    for episode, share in zip(scene.episodes, scene.opening, strict=True):
        way = minimum_jerk(np.clip((np.arange(frames) - episode.moves) / (episode.stops - episode.moves), 0, 1))
        script[:, episode.joint] += share * thing.articulation.joints[episode.joint].opening() * way
    whole, playback = Playback.of(thing, script), Playback.of(thing, script, settings.every)
    (path,) = sample_camera_paths(
        playback.swept, 1, frames, np.random.default_rng(scene.camera_seed), style=style, width=size[0], height=size[1]
    )
    camera, rng = path.at(0), np.random.default_rng(scene.occluder_seed)
    nearest_m = float(apply(camera.cam_from_world, playback.swept)[:, 2].min())
    occluders: list[Occluder] = []
    hidden: list[tuple[str, int, int]] = []
    for episode in scene.episodes:
        if episode.hidden == episode.shown:
            continue
        entity = next(i for i, e in enumerate(thing.entities) if e.joint == episode.joint and e.label != "hinge")
        until_rest = replace(episode, stops=max(episode.stops, episode.hidden))
        shape = fit_shape(slopes_to_hide(thing, whole, entity, until_rest, camera), camera, nearest_m, rng)
        if shape is None:
            raise SystemExit(f"{name}: {thing.entities[entity].name} cannot be occluded; change the scene")
        poses = slide_in(shape, camera, episode.away(frames), rng)
        occluders.append(Occluder(shape, sample_occluder_surface(rng), poses))
        hidden.append((thing.entities[entity].name, *playback.shows(episode.hidden, episode.shown)))
    joints = tuple(episode.joint for episode in scene.episodes)
    stage = renderer.stage(thing, [camera])
    staging = Staging(joints, playback, (path,), stage, tuple(occluders), {"hidden": hidden})
    look_rng = np.random.default_rng(scene.look_seed)
    return record_take(
        thing, staging, name=name, seed=0, appearance_rng=look_rng, sensor_rng=look_rng, settings=settings
    )


def truth(take: Take) -> dict[str, Any]:
    """What is true of the first view of a take, per entity that can be followed; hinges are left out.

    Pixels are rounded to 0.1, metres to 1 mm, axes to 0.001. ``visible_frames`` are first frames, and frames after the
    last, of the times in which an entity is seen; ``occluded`` has name, first frame, and frame after the last.
    """
    view, info = take.views[0], take.info
    entities = []
    for e in take.tracked:
        entity = info.entities[e]
        joint = None
        if not entity.fixed:
            axis = take.joint_axis[0, entity.joint].astype(float).round(3).tolist()
            joint = {
                "kind": info.joints[entity.joint].kind,
                "origin_m": axis[:3],
                "axis": axis[3:],
                "position": take.joint_position[:, entity.joint].astype(float).round(4).tolist(),
            }
        edges = np.flatnonzero(np.diff(view.visible[:, e].astype(np.int8), prepend=0, append=0))
        entities.append(
            {
                "name": entity.name,
                "label": entity.label,
                "moves": entity.joint in info.moved_joints,
                "joint": joint,
                "visible_frames": edges.reshape(-1, 2).tolist(),
                "uv_px": view.uv_px[:, e].astype(float).round(1).tolist(),
                "point_world_m": take.point_world[:, e].astype(float).round(3).tolist(),
            }
        )
    return {
        "object": info.object_id,
        "half_diagonal_m": round(info.half_diagonal_m, 4),
        "occluded": info.provenance["hidden"],
        "entities": entities,
    }


if __name__ == "__main__":
    sys.exit(tyro.cli(MakeSample).run())
