"""Writes an :class:`ObjectModel` as a folder of PartNet-Mobility's shape: URDF, OBJ meshes, ``meta.json``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from xml.etree import ElementTree as ET

from quest.sim.procedural.model import SURFACES, Mesh, ObjectModel, Part

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
