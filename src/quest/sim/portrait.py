"""Portraits of an object: closed and open, from a few sides, in plain light, with its entities located."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from quest.errors import ConfigError
from quest.sim.annotate import entity_points, see_entities
from quest.sim.appearance import Light, Region, apply_appearance, sample_appearance
from quest.sim.cameras import sample_cameras
from quest.sim.objects import SimObject
from quest.sim.renderer import Renderer
from quest.sim.surfaces import Surface

OPENED = 0.8
"""How far an opened object's joints are from rest, of the way to their limits."""

_SIDES_SEED = 2299
"""Draws sides that show most of an object: from the left and a little above, then from the right and higher."""

_FLOOR = Surface((0.62, 0.64, 0.66), roughness=0.95, metallic=0.0, specular=0.1)
_SUN = Light("directional", (0.55, 0.45, 0.75), 4.0, (1.0, 0.98, 0.95))


@dataclass(frozen=True)
class Portrait:
    """One picture of an object."""

    opened: bool
    """Whether its joints are open."""
    rgb: UInt8[np.ndarray, "S S 3"]
    """Colours."""
    uv_px: Float[np.ndarray, "E 2"]
    """Pixel of every entity."""
    visible: Bool[np.ndarray, " E"]
    """Which of them are seen."""


def portray(sim_object: SimObject, renderer: Renderer, *, sides: int = 2, size_px: int = 288) -> list[Portrait]:
    """Pictures of an object: from every side closed, then from every side open; always the same ones.

    Raises:
        ConfigError: fewer than one side, or pictures of fewer than 16 pixels.
        RendererError: the renderer broke.
    """
    if sides < 1 or size_px < 16:
        raise ConfigError(
            f"portraits: expected at least one side and 16 pixels, got {sides} and {size_px}; ask for more"
        )
    articulation = sim_object.articulation
    opened = articulation.rest + OPENED * np.array([j.opening() for j in articulation.joints])
    moments = (articulation.rest, opened)
    swept = np.concatenate([articulation.world_points(position) for position in moments])
    cameras = sample_cameras(swept, sides, np.random.default_rng(_SIDES_SEED), width=size_px, height=size_px)
    procedural = sim_object.source == "procedural"
    look_rng = np.random.default_rng([zlib.crc32(b"portrait"), zlib.crc32(sim_object.object_id.encode())])
    appearance = replace(
        sample_appearance(look_rng, randomize_materials=procedural),
        ambient=(0.42, 0.42, 0.43), lights=(_SUN,), shadows=True, floor=_FLOOR, wall=None, distractors=(),
    )  # fmt: skip
    stage = renderer.stage(sim_object, cameras)
    apply_appearance(stage.scene, appearance, Region.around(swept), stage.bodies, procedural=procedural)
    found = []
    for position in moments:
        poses = articulation.poses(position)
        points = entity_points(sim_object.entities, poses)
        stage.pose(poses)
        for posed, picture in zip(cameras, stage.pictures(), strict=True):
            seen = see_entities(sim_object, posed, picture, points)
            found.append(Portrait(position is opened, picture.rgb, *seen))
    return found
