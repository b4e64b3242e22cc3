"""What a procedural object is made of: meshes, parts, links and joints; and how it is written.

Axes while an object is built: x to the right of someone who stands before it, y into the object (the
front looks along -y), z up, the ground at z = 0. Metres and radians. It is written as a folder of PartNet-Mobility's
shape: URDF, OBJ meshes, ``meta.json``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float, Int

from quest.types import GRIPS


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh whose vertices are not shared across sharp edges."""

    vertices: Float[np.ndarray, "N 3"]
    """Positions in metres."""
    faces: Int[np.ndarray, "M 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    normals: Float[np.ndarray, "N 3"]
    """Unit normal per vertex."""
    uv: Float[np.ndarray, "N 2"]
    """Texture coordinate per vertex; one unit is half a metre, u runs along the grain."""

    def moved(self, offset: tuple[float, float, float] | np.ndarray) -> Mesh:
        """The mesh shifted by ``offset`` metres."""
        return replace(self, vertices=self.vertices + np.asarray(offset, dtype=float))

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> Mesh:
        """The mesh turned about the origin by a rotation matrix."""
        return replace(self, vertices=self.vertices @ rotation.T, normals=self.normals @ rotation.T)

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Smallest and largest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def join(meshes: list[Mesh]) -> Mesh:
    """One mesh out of several; closed meshes stay closed."""
    assert meshes, "nothing to join"
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
    )


@dataclass(frozen=True)
class Part:
    """One visual of a link."""

    role: str
    """What it is (``handle``, ``knob``, ``drawer_front``, ``frame`` ...); its visual is called ``role-N``."""
    mesh: Mesh
    """Geometry in the frame of its link."""
    surface: str = "body"
    """Which material of :data:`SURFACES` it wears before any appearance is drawn."""


SURFACES = {
    "body": (0.72, 0.62, 0.50),
    "front": (0.80, 0.72, 0.60),
    "metal": (0.62, 0.62, 0.65),
    "dark": (0.08, 0.08, 0.09),
    "white": (0.90, 0.90, 0.88),
    "inside": (0.78, 0.75, 0.70),
    "leather": (0.25, 0.13, 0.06),
    "glass": (0.10, 0.13, 0.14),
}
"""Base colours (linear RGB) that the written ``.mtl`` gives to each kind of surface."""


@dataclass(frozen=True)
class Link:
    """A moving link and the joint that carries it on the body."""

    name: str
    """Name of the link; its joint is called ``<name>_joint``."""
    parts: tuple[Part, ...]
    """Visuals, in the frame whose origin is ``origin``."""
    kind: Literal["revolute", "prismatic"]
    """``revolute`` or ``prismatic``."""
    origin: tuple[float, float, float]
    """Joint origin in the object's frame, metres."""
    axis: tuple[float, float, float]
    """Unit direction of the joint in the object's frame."""
    upper: float
    """Upper limit in radians or metres; the lower one is 0, which is closed."""

    @property
    def has_handle(self) -> bool:
        """Whether a handle or a knob is among the parts."""
        return any(part.role in GRIPS for part in self.parts)


@dataclass(frozen=True)
class ObjectModel:
    """A whole object: a resting body and the links that move on it."""

    model_cat: str
    """Category in PartNet-Mobility's words, such as ``StorageFurniture``."""
    body: tuple[Part, ...]
    """Visuals that do not move, in the object's frame."""
    links: tuple[Link, ...]
    """Moving links, each a child of the body."""

    def moved(self, offset: tuple[float, float, float]) -> ObjectModel:
        """The whole object shifted by ``offset`` metres."""
        body = tuple(replace(part, mesh=part.mesh.moved(offset)) for part in self.body)
        links = []
        for link in self.links:
            x, y, z = np.asarray(link.origin) + np.asarray(offset)
            links.append(replace(link, origin=(float(x), float(y), float(z))))
        return ObjectModel(self.model_cat, body, tuple(links))


MESH_FOLDER = "textured_objs"
URDF_NAME = "mobility.urdf"
_BODY = "body"
_ALWAYS = 6
"""So many surfaces are written for every object, worn or not."""


def write_object(model: ObjectModel, folder: Path, *, name: str, meta: dict[str, object]) -> Path:
    """Write a model; whatever the folder held under the same names is replaced.

    The root link ``base`` carries the body by a fixed joint that turns the front from -y to -x, as
    PartNet-Mobility's own base joints do.

    Args:
        model: the object, front along -y, metres.
        folder: where to write; made if missing.
        name: name of the robot in the URDF.
        meta: what ``meta.json`` holds beside ``model_cat``.

    Returns:
        The folder.
    """
    meshes = folder / MESH_FOLDER
    meshes.mkdir(parents=True, exist_ok=True)
    (meshes / "surfaces.mtl").write_text(_materials(model), encoding="ascii")
    robot = ET.Element("robot", name=name)
    ET.SubElement(robot, "link", name="base")
    number = _write_link(robot, _BODY, model.body, meshes, 0)
    _write_joint(robot, "body_joint", "fixed", "base", _BODY, origin=(0, 0, 0), yaw_rad=-math.pi / 2)
    for link in model.links:
        number = _write_link(robot, link.name, link.parts, meshes, number)
        joint = _write_joint(robot, f"{link.name}_joint", link.kind, _BODY, link.name, origin=link.origin)
        ET.SubElement(joint, "axis", xyz=_numbers(link.axis))
        ET.SubElement(joint, "limit", lower="0", upper=f"{link.upper:.6g}", effort="100", velocity="10")
    ET.indent(robot)
    text = '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
    (folder / URDF_NAME).write_text(text, encoding="ascii")
    meta_text = json.dumps({"model_cat": model.model_cat, **meta}, indent=1, sort_keys=True)
    (folder / "meta.json").write_text(meta_text + "\n", encoding="ascii")
    return folder


def _write_link(robot: ET.Element, name: str, parts: tuple[Part, ...], meshes: Path, number: int) -> int:
    link = ET.SubElement(robot, "link", name=name)
    for part in parts:
        filename = f"part-{number}.obj"
        (meshes / filename).write_text(_obj(part.mesh, part.surface), encoding="ascii")
        visual = ET.SubElement(link, "visual", name=f"{part.role}-{number}")
        ET.SubElement(visual, "origin", xyz="0 0 0")
        geometry = ET.SubElement(visual, "geometry")
        ET.SubElement(geometry, "mesh", filename=f"{MESH_FOLDER}/{filename}")
        number += 1
    return number


def _write_joint(
    robot: ET.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    *,
    origin: tuple[float, float, float],
    yaw_rad: float = 0.0,
) -> ET.Element:
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=_numbers(origin), rpy=f"0 0 {yaw_rad:.15g}")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _numbers(values: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _obj(mesh: Mesh, surface: str) -> str:
    assert surface in SURFACES, surface
    rows = ["mtllib surfaces.mtl", f"usemtl {surface}"]
    rows += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices.tolist()]
    rows += [f"vt {u:.5f} {v:.5f}" for u, v in mesh.uv.tolist()]
    rows += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.normals.tolist()]
    rows += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(rows) + "\n"


def _materials(model: ObjectModel) -> str:
    rows = []
    worn = {part.surface for part in (*model.body, *(part for link in model.links for part in link.parts))}
    for index, (name, colour) in enumerate(SURFACES.items()):
        if index >= _ALWAYS and name not in worn:
            continue
        shine = "0.6 0.6 0.6" if name == "metal" else "0.1 0.1 0.1"
        rows.append(f"newmtl {name}\nKd {colour[0]} {colour[1]} {colour[2]}\nKs {shine}\nNs 40\nd 1\n")
    return "\n".join(rows)
