"""Reading a URDF file: links with their visuals, and joints, as plain records in URDF units.

Only what a kinematic playback needs is read: visuals, origins, joint types, axes and limits.
Collisions, inertias and transmissions are ignored.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int

from quest.errors import ObjectError
from quest.untrusted import MOST_TEXT, reading, require_file

_MOST = 1e6
"""Beyond which no number of a URDF is believed."""

CONTINUOUS_RANGE_RAD = np.pi / 2
"""How far a joint without limits is taken to turn."""

_JOINT_TYPES = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
"""What has more than one degree of freedom is rare in articulated objects, and stays fixed."""
_SIZES = {"cylinder": ("radius", "length"), "sphere": ("radius",)}


@dataclass(frozen=True)
class MeshData:
    """A mesh that has no file."""

    vertices: Float[np.ndarray, "N 3"]
    """Positions."""
    faces: Int[np.ndarray, "M 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    corners: tuple[Float32[np.ndarray, "M*3 3"], Float32[np.ndarray, "M*3 3"], Float32[np.ndarray, "M*3 2"]]
    """Position, normal and texture coordinate of every corner of every face, as they are drawn."""
    colour: tuple[float, float, float]
    """Linear red, green, blue."""
    roughness: float
    """0 mirror, 1 matt."""


@dataclass(frozen=True)
class UrdfVisual:
    """One visual of a URDF link: a mesh or a primitive."""

    name: str
    link_from_visual: Float[np.ndarray, "4 4"]
    """Pose in its URDF link."""
    mesh: Path | MeshData | None
    """Mesh file or mesh, or None for a primitive."""
    scale: tuple[float, float, float]
    shape: str
    """``mesh``, ``box``, ``cylinder`` or ``sphere``."""
    size: tuple[float, ...]
    """Box edge lengths; or radius and length (cylinder); or radius (sphere)."""
    rgba: tuple[float, float, float, float] | None
    """Colour of the visual's material, or None."""


@dataclass(frozen=True)
class UrdfJoint:
    """One joint of a URDF."""

    name: str
    kind: str
    """``revolute``, ``prismatic`` or ``fixed``."""
    parent: str
    child: str
    parent_from_joint: Float[np.ndarray, "4 4"]
    """Pose of the joint's frame in the parent link."""
    axis: Float[np.ndarray, "3"]
    """Unit direction in the joint's frame."""
    lower: float
    """Lower limit, radians or URDF units."""
    upper: float
    """Upper limit, radians or URDF units."""
    mimics: str | None = None
    """Name of the joint that it should follow, or None."""


@dataclass(frozen=True)
class Urdf:
    """A parsed URDF: visuals per link name, and joints ordered from the root to the leaves."""

    links: dict[str, tuple[UrdfVisual, ...]]
    joints: tuple[UrdfJoint, ...]


def read_urdf(path: Path) -> Urdf:
    """Reads a URDF file.

    Raises:
        ObjectError: the file is missing, is not XML, or its links do not form a tree.
    """
    if not path.exists():
        raise ObjectError(f"{path}: expected a URDF file, found none; name a folder that holds mobility.urdf")
    require_file(path, ObjectError, most=MOST_TEXT)
    with reading(path, ObjectError, "not a readable URDF, restore the file from its source"):
        root = ElementTree.parse(path).getroot()
    if any("ros.org/wiki/xacro" in str(element.tag) for element in root.iter()):
        raise ObjectError(
            f"{path}: expected a URDF, got xacro, which has to be expanded; run: xacro {path.name} > expanded.urdf"
        )
    colours = {m.get("name"): rgba for m in root.findall("material") if (rgba := _rgba(m)) is not None}
    with reading(f"{path}: a link, visual or joint", ObjectError, "restore the file from its source"):
        links = {
            link.attrib["name"]: tuple(_visual(v, path.parent, colours) for v in link.findall("visual"))
            for link in root.findall("link")
        }
        joints = [_joint(joint) for joint in root.findall("joint")]
    return Urdf(links, _ordered(joints, links, path))


def pose_matrix(xyz: Float[np.ndarray, "3"], rpy: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Pose of a URDF origin: fixed-axis roll, pitch, yaw, then a translation."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    matrix[:3, 3] = xyz
    return matrix


def _numbers(text: str | None, default: tuple[float, ...]) -> np.ndarray:
    if text is None:
        return np.array(default, dtype=np.float64)
    values = np.array([_number(v) for v in text.split()])
    if values.shape != (len(default),):
        raise ValueError(f"expected {len(default)} finite numbers, got {text!r}")
    return values


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) < _MOST:
        raise ValueError(f"expected a number below {_MOST:g}, got {text!r}")
    return value


def _origin(element: ElementTree.Element) -> Float[np.ndarray, "4 4"]:
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    return pose_matrix(_numbers(attributes.get("xyz"), (0, 0, 0)), _numbers(attributes.get("rpy"), (0, 0, 0)))


def _rgba(material: ElementTree.Element) -> tuple[float, float, float, float] | None:
    colour = material.find("color")
    if colour is None or colour.get("rgba") is None:
        return None
    r, g, b, a = _numbers(colour.get("rgba"), (0, 0, 0, 1)).tolist()
    return (r, g, b, a)


def _visual(element: ElementTree.Element, folder: Path, colours: dict) -> UrdfVisual:
    geometry = element.find("geometry")
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None:
        raise ValueError(f"visual {element.get('name')!r} has no geometry")
    mesh, scale, size = None, np.ones(3), []
    if shape.tag == "mesh":
        mesh, text = _mesh_path(shape.attrib["filename"], folder), shape.get("scale")
        each = len((text or "1 1 1").split()) == 3
        scale = _numbers(text, (1, 1, 1)) if each else np.full(3, _number(text or "1"))
    elif shape.tag == "box":
        size = _numbers(shape.attrib["size"], (0, 0, 0)).tolist()
    elif shape.tag in _SIZES:
        size = [_number(shape.attrib[key]) for key in _SIZES[shape.tag]]
    else:
        raise ValueError(f"unknown geometry {shape.tag!r}")
    material = element.find("material")
    rgba = None if material is None else _rgba(material) or colours.get(material.get("name"))
    sx, sy, sz = scale.tolist()
    return UrdfVisual(element.get("name") or "", _origin(element), mesh, (sx, sy, sz), shape.tag, tuple(size), rgba)


def _mesh_path(filename: str, folder: Path) -> Path:
    """Where a mesh is: ``package://NAME/rest`` is looked for beside the URDF and in the folders above it.

    Above it, either a folder called NAME holds ``rest``, or the package's own folder has another name.
    """
    if not filename.startswith("package://"):
        return folder / filename.removeprefix("file://")
    inside = Path(filename.removeprefix("package://"))
    rest = Path(*inside.parts[1:])
    above = [folder, *folder.resolve().parents]
    candidates = [root / end for root in above for end in (inside, rest)]
    return next((path for path in candidates if path.is_file()), folder / inside)


def _joint(element: ElementTree.Element) -> UrdfJoint:
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise ValueError(f"joint {element.get('name')!r} lacks a parent or child")
    kind = _JOINT_TYPES.get(element.attrib["type"], "fixed")
    limit, mimic, towards = (element.find(tag) for tag in ("limit", "mimic", "axis"))
    axis = _numbers(None if towards is None else towards.get("xyz"), (1, 0, 0))
    norm = float(np.linalg.norm(axis))
    if kind != "fixed" and norm < 1e-9:
        raise ValueError(f"joint {element.get('name')!r} has an axis of length zero")
    lower, upper = 0.0, CONTINUOUS_RANGE_RAD if kind == "revolute" else 0.0
    if kind != "fixed" and element.attrib["type"] != "continuous" and limit is not None:
        lower, upper = sorted((_number(limit.get("lower", "0")), _number(limit.get("upper", "0"))))
    return UrdfJoint(
        element.attrib["name"], kind, parent.attrib["link"], child.attrib["link"], _origin(element),
        axis / max(norm, 1e-9), lower, upper, None if mimic is None else mimic.get("joint"),
    )  # fmt: skip


def _ordered(joints: list[UrdfJoint], links: dict, path: Path) -> tuple[UrdfJoint, ...]:
    """Joints from the root to the leaves; file order among those that are equally deep."""
    children = [j.child for j in joints]
    unknown = sorted({n for j in joints for n in (j.parent, j.child)} - set(links))
    twice = len(children) - len(set(children))
    if unknown or twice or not links:
        raise ObjectError(
            f"{path}: expected links that form a tree; unknown links {unknown}, {twice} links with two parents; "
            "restore the file from its source"
        )
    reached, remaining, order = set(links) - set(children), list(joints), []
    while remaining:
        ready = [j for j in remaining if j.parent in reached]
        if not ready:
            raise ObjectError(
                f"{path}: expected links that form a tree, found a cycle; restore the file from its source"
            )
        order += ready
        reached |= {j.child for j in ready}
        remaining = [j for j in remaining if j.child not in reached]
    return tuple(order)
