"""Hand-written object folders in the shape that ``load_object`` reads: boxes, a hinge, a slide.

The cabinet is 0.5 deep (x), 0.6 wide (y) and 1 high (z) in URDF units, its front at x = 0.25. A drawer fills the upper
half and slides along +x; a door covers the lower half, its hinge at the left edge (y = -0.3) of the front.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from quest.sim.articulation import ArticulatedJoint, Articulation, apply
from quest.sim.entities import SimEntity
from quest.sim.objects import SimObject
from quest.types import Joint


@dataclass(frozen=True)
class Box:
    """A visual of a link: an OBJ file with a box, or nothing but its name in the URDF if ``missing``."""

    name: str
    size: tuple[float, float, float]
    centre: tuple[float, float, float] = (0, 0, 0)
    missing: bool = False


@dataclass(frozen=True)
class Link:
    """A link and the joint above it."""

    name: str
    boxes: tuple[Box, ...]
    parent: str = "base"
    kind: str = "fixed"
    origin: tuple[float, float, float] = (0, 0, 0)
    axis: tuple[float, float, float] = (1, 0, 0)
    limits: tuple[float, float] | None = None
    yaw: float = 0.0


CARCASS = Link(
    "body",
    (
        Box("back-1", (0.02, 0.6, 1.0), (-0.24, 0, 0.5)),
        Box("side-2", (0.5, 0.02, 1.0), (0, -0.29, 0.5)),
        Box("side-3", (0.5, 0.02, 1.0), (0, 0.29, 0.5)),
        Box("shelf-4", (0.5, 0.6, 0.02), (0, 0, 0.01)),
        Box("shelf-5", (0.5, 0.6, 0.02), (0, 0, 0.5)),
        Box("shelf-6", (0.5, 0.6, 0.02), (0, 0, 0.99)),
    ),
)
HANDLE = Box("handle-8", (0.04, 0.2, 0.04), (0.26, 0, 0))
DRAWER = Link(
    "drawer",
    (Box("drawer_box-7", (0.44, 0.54, 0.4)), HANDLE),
    kind="prismatic",
    origin=(0.02, 0, 0.75),
    limits=(0, 0.35),
)
DOOR = Link(
    "door",
    (Box("door_panel-9", (0.02, 0.58, 0.46), (0.01, 0.3, 0)),),
    kind="revolute",
    origin=(0.25, -0.3, 0.25),
    axis=(0, 0, -1),
    limits=(0, 1.5),
)
TRAY = Link(
    "tray",
    (Box("tray-40", (0.4, 0.5, 0.02)), Box("handle-41", (0.03, 0.2, 0.03), (0.2, 0, 0.02))),
    kind="prismatic",
    origin=(0, 0, 0.2),
    limits=(0, 0.3),
)
"""Behind the door."""


def write_object(folder: Path, *links: Link, category: str | None = "StorageFurniture") -> Path:
    """Write an object folder; links without a box of their own get none."""
    meshes = folder / "textured_objs"
    meshes.mkdir(parents=True)
    text = ['<link name="base"/>']
    for link in links:
        text.append(f'<link name="{link.name}">')
        for number, box in enumerate(link.boxes):
            file = f"{link.name}-{number}.obj"
            if not box.missing:
                trimesh.creation.box(box.size).apply_translation(box.centre).export(meshes / file)
            text.append(
                f'<visual name="{box.name}"><geometry><mesh filename="textured_objs/{file}"/></geometry></visual>'
            )
        text.append("</link>")
        limit = "" if link.limits is None else '<limit lower="{}" upper="{}"/>'.format(*link.limits)
        text.append(
            f'<joint name="joint_{link.name}" type="{link.kind}">'
            f'<parent link="{link.parent}"/><child link="{link.name}"/>'
            f'<origin xyz="{_words(link.origin)}" rpy="0 0 {link.yaw}"/><axis xyz="{_words(link.axis)}"/>{limit}'
            "</joint>"
        )
    (folder / "mobility.urdf").write_text(f'<robot name="test">{"".join(text)}</robot>')
    if category is not None:
        (folder / "meta.json").write_text(json.dumps({"model_cat": category}))
    return folder


def write_cabinet(folder: Path) -> Path:
    """The cabinet described above."""
    return write_object(folder, CARCASS, DRAWER, DOOR)


def edit(folder: Path, old: str, new: str) -> Path:
    """Replaces some text of an object's URDF."""
    urdf = folder / "mobility.urdf"
    urdf.write_text(urdf.read_text().replace(old, new))
    return urdf


def in_world(thing: SimObject, entity: SimEntity) -> np.ndarray:
    """Where an entity is at rest."""
    return apply(thing.articulation.poses(thing.articulation.rest)[entity.body], entity.point)


def articulation(*joints: tuple[str, float, float]) -> Articulation:
    """Joints of a kind with limits, without any geometry, all on the base."""
    records = tuple(
        ArticulatedJoint(
            Joint(f"joint_{n}", kind, lower, upper),  # type: ignore[arg-type]
            0,
            np.eye(4),
            np.array([0.0, 0.0, 1.0]),
            float(np.clip(0, lower, upper)),
        )
        for n, (kind, lower, upper) in enumerate(joints)
    )
    return Articulation(("base", *(r.joint.name for r in records)), (), records, np.eye(4))


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(map(str, numbers))
