"""Object folders, of PartNet-Mobility or of that shape, as records that can be moved and rendered."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import trimesh
from jaxtyping import Float

from quest.data.split import object_split
from quest.errors import ObjectError
from quest.sim.articulation import ArticulatedJoint, Articulation, Part
from quest.sim.description import (
    CORRECTIONS,
    CREDIT_NAME,
    DESCRIPTION_NAME,
    FRONTS,
    NOTHING_SAID,
    Description,
    place,
    read_description,
)
from quest.sim.entities import MOVES_AT_LEAST, SimEntity, find_entities, part_label
from quest.sim.standing import closed, placed, real_scale, scaled, size_scale, with_scaled_origins
from quest.sim.urdf import MeshData, Urdf, UrdfVisual, read_urdf
from quest.types import Joint
from quest.untrusted import read_json, reading

OBJECTS_VARIABLE = "QUEST_OBJECTS"
"""Environment variable that names the folder of PartNet-Mobility folders."""

_PLAUSIBLE_M = (0.02, 3.0)
"""Longest side; what is larger has parts beyond the 6.55 m to which takes keep depth."""
_MOST_JOINTS, _MOST_ENTITIES = 254, 255
"""Masks of links and of entities have one byte."""
_PART_NAMES = ("mobility_v2.json", "result_after_merging.json")
_CATEGORY_OF_BASE = {
    "furniture_body": "StorageFurniture",
    "refrigerator_body": "Refrigerator",
    "microwave_body": "Microwave",
    "oven_body": "Oven",
}

Source = Literal["partnet-mobility", "sweethome3d", "procedural", "own"]
_AS_TOLD = ("own", "sweethome3d")
"""Sources whose objects are in metres and stand as their files say."""


@dataclass(frozen=True)
class SimObject:
    """An articulated object, ready to be moved and rendered."""

    source: Source
    """``sweethome3d`` is an import that is in the object split, ``own`` any other object of a user."""
    object_id: str
    """The folder's name, or ``CATEGORY-SEED``."""
    category: str
    """Such as ``StorageFurniture``; ``Unknown`` if the folder does not tell."""
    articulation: Articulation
    """Bodies, joints and their geometry, metres."""
    entities: tuple[SimEntity, ...]
    """What can be followed; hinges come last."""
    half_diagonal_m: float
    """Half the diagonal of the bounding box at rest."""
    scale: float
    """Metres per unit of the URDF."""
    warnings: tuple[str, ...]
    """Degradations, in words: missing meshes, a category that is not known."""
    movers: tuple[int, ...] | None = None
    """Joints that may move in takes; None for all of them."""
    view_m: Float[np.ndarray, "2 3"] | None = None
    """Box that cameras film, least and greatest world coordinates, metres; None for the whole object."""

    @property
    def movable(self) -> tuple[int, ...]:
        """Joints that carry an entity (hinges aside) that moves at least 0.1 normalised units."""
        least = MOVES_AT_LEAST * self.half_diagonal_m
        moving = {e.joint for e in self.entities if e.label != "hinge" and not e.fixed and e.travel_m >= least}
        return tuple(sorted(moving if self.movers is None else moving.intersection(self.movers)))


def find_objects(root: Path | None = None) -> list[Path]:
    """Object folders below ``root`` (default: the environment's ``QUEST_OBJECTS``), sorted.

    Raises:
        ObjectError: no root is given or set, it does not exist, or it holds no folder with a URDF.
    """
    if root is None:
        value = os.environ.get(OBJECTS_VARIABLE)
        if not value:
            raise ObjectError(
                f"no folder of PartNet-Mobility objects: set {OBJECTS_VARIABLE} to the folder that holds them, "
                "or pass --objects-root; procedural objects need none (--procedural N)"
            )
        root = Path(value)
    if not root.is_dir():
        raise ObjectError(
            f"{root}: expected a folder of PartNet-Mobility objects, found none; check {OBJECTS_VARIABLE}"
        )
    folders = sorted({f.parent for pattern in ("*/mobility.urdf", "*/*.urdf") for f in root.glob(pattern)})
    if not folders:
        raise ObjectError(f"{root}: expected folders that each hold a mobility.urdf or another URDF, found none")
    return folders


def find_things(root: Path) -> list[Path]:
    """URDFs of things that do not open, one in each folder below ``root``, sorted.

    Raises:
        ObjectError: there is none.
    """
    found = sorted(root.glob("*/*.urdf"))
    if not found:
        raise ObjectError(
            f"{root}: expected folders that each hold a thing's URDF, found none; quest objects import makes them "
            "(things/ in its folder)"
        )
    return found


def load_thing(path: Path) -> tuple[Part, ...]:
    """The parts of a thing that does not open, as it stands on the floor about the origin, metres.

    Args:
        path: its URDF, of one link.

    Raises:
        ObjectError: the URDF is broken or has joints, or its meshes are missing.
    """
    with reading(path, ObjectError, "use another thing"):
        urdf = read_urdf(path)
        if urdf.joints:
            raise ObjectError(f"{path}: expected a thing of one link, got joints; use it as an object")
        return _parts(urdf, {link: (0, np.eye(4)) for link in urdf.links}, path, MappingProxyType({}), [])


def find_urdf(path: Path) -> Path:
    """The URDF of an object: the path itself, or the folder's ``mobility.urdf``, or its only URDF.

    Raises:
        ObjectError: there is none, there are several, or it is a xacro file.
    """
    if path.suffix == ".xacro":
        raise ObjectError(
            f"{path}: expected a URDF, got xacro, which has to be expanded; run: xacro {path.name} > {path.stem}"
        )
    if path.is_file():
        return path
    if not path.is_dir():
        raise ObjectError(f"{path}: expected an object folder, found none; check the path and the object's id")
    named = path / "mobility.urdf"
    found = [named] if named.is_file() else sorted(path.glob("*.urdf"))
    if len(found) > 1:
        raise ObjectError(
            f"{path}: expected one URDF, found {', '.join(f.name for f in found)}; name one of the files itself"
        )
    if not found:
        xacro = next(iter(sorted(path.glob("*.xacro"))), None)
        if xacro is not None:
            find_urdf(xacro)
        raise ObjectError(f"{path}: expected a URDF file, found none; name a folder that holds mobility.urdf")
    return found[0]


def object_id_of(path: Path) -> str:
    """What the object at a path is called: by its folder, or by its URDF where a folder's URDF is named itself.

    Raises:
        ObjectError: there is no URDF.
    """
    urdf_path = find_urdf(path)
    by_folder = urdf_path.stem in ("mobility", urdf_path.parent.name) or path.is_dir()
    return urdf_path.resolve().parent.name if by_folder else urdf_path.stem


def load_object(path: Path) -> SimObject:
    """Reads an object: a folder of PartNet-Mobility's shape, or any folder or URDF of a user's own.

    Only the URDF and the meshes it names are needed. Meshes that are missing or have no faces are left out and listed
    in ``warnings``. A URDF of another name than ``mobility.urdf``, and any with an ``entities.json`` beside it, is the
    user's own: its units are metres unless that file tells a size (see :mod:`quest.sim.description`).

    Args:
        path: the folder, or the URDF.

    Raises:
        ObjectError: the folder, its URDF or its description is missing or broken, all meshes are missing, or nothing
            moves.
    """
    with reading(path, ObjectError, "use another object"):
        urdf_path, object_id = find_urdf(Path(path)), object_id_of(Path(path))
        folder, warnings = urdf_path.parent, []
        urdf = read_urdf(urdf_path)
        meta = _read_json(folder / "meta.json", warnings)
        described = folder / DESCRIPTION_NAME
        description = read_description(described) if described.is_file() else NOTHING_SAID
        own = described.is_file() or urdf_path.name != "mobility.urdf"
        if not own:
            urdf = with_scaled_origins(urdf, warnings)
            description = CORRECTIONS.get(folder.name, description)
        model_cat = meta.get("model_cat") if isinstance(meta, dict) else None
        category = str(description.category or model_cat or _category_of_base(folder))
        return object_from_urdf(
            urdf, object_id, category, source=_source_of(folder, object_id, warnings) if own else "partnet-mobility",
            where=urdf_path, description=description, part_names=_names_of_meshes(folder, warnings), warnings=warnings,
        )  # fmt: skip


def _source_of(folder: Path, object_id: str, warnings: list[str]) -> Source:
    """Of an object that says itself what it is: the split knows some models of furniture libraries by name."""
    credit = _read_json(folder / CREDIT_NAME, warnings)
    model = credit.get("model") if isinstance(credit, dict) else None
    listed = (objects.get(object_id) for objects in object_split().sweethome3d.values())
    return "sweethome3d" if model is not None and model in listed else "own"


def object_from_urdf(
    urdf: Urdf,
    object_id: str,
    category: str,
    *,
    source: Source,
    where: Path | str = "",
    description: Description = NOTHING_SAID,
    part_names: Mapping[str, str] = MappingProxyType({}),
    warnings: Sequence[str] = (),
) -> SimObject:
    """An object in metres, closed, with its front towards +x and its entities found.

    Args:
        urdf: its links and joints.
        object_id: what it is called.
        category: in PartNet-Mobility's words.
        source: where it comes from; PartNet-Mobility's objects get a plausible size.
        where: what the URDF was read from, for messages.
        description: what a user says of it.
        part_names: what parts are, by the stems of their mesh files, where the URDF does not name them.
        warnings: what is wrong with it so far.

    Raises:
        ObjectError: all meshes are missing, nothing moves, or there is more of something than masks can tell.
    """
    where, told = where or object_id, list(warnings)
    articulation, body_of_link = _articulation(urdf, where, part_names, told)
    articulation = closed(articulation)
    scale = _scale(articulation, source, category, description, told)
    front_rad = None if description.front is None else FRONTS[description.front]
    articulation = placed(scaled(articulation, scale), front_rad, by_lids=source in _AS_TOLD)
    half_diagonal_m = float(np.linalg.norm(articulation.extent_m)) / 2
    pointed_out = place(description, articulation, body_of_link, scale)
    entities = find_entities(articulation, half_diagonal_m, category=category, placed=pointed_out)
    if all(e.label == "hinge" or e.fixed for e in entities):
        raise ObjectError(
            f"{where}: expected a moving link with a handle, rim or front, found none; use another object"
        )
    if len(entities) > _MOST_ENTITIES:
        raise ObjectError(
            f"{where}: expected at most {_MOST_ENTITIES} handles, knobs, rims, fronts and hinges, got {len(entities)}"
        )
    return SimObject(source, object_id, category, articulation, entities, half_diagonal_m, scale, tuple(told))


def object_digest(path: Path) -> str:
    """Short hash of all that an object is read from.

    That is its URDF, the files beside it that are read, the meshes, and the materials and pictures that these name.

    Raises:
        ObjectError: the URDF is missing or broken.
    """
    urdf_path = find_urdf(path)
    beside = [urdf_path.parent / name for name in (DESCRIPTION_NAME, "meta.json", *_PART_NAMES)]
    visuals = [visual for of_link in read_urdf(urdf_path).links.values() for visual in of_link]
    meshes = sorted({visual.mesh for visual in visuals if isinstance(visual.mesh, Path)})
    digest = hashlib.sha256()
    looks = sorted({file for mesh in meshes for file in _looks(mesh)})
    for file in (urdf_path, *beside, *meshes, *looks):
        data = file.read_bytes() if file.is_file() else b""
        digest.update(f"{file.name}\0{len(data)}\n".encode() + data)
    return digest.hexdigest()[:12]


def _looks(mesh: Path) -> Iterator[Path]:
    """Material files that a Wavefront mesh names, and the pictures that these name."""
    for library in _named_in(mesh, ("mtllib",)) if mesh.suffix.lower() == ".obj" else ():
        yield library
        yield from _named_in(library, ("map_", "bump", "disp", "decal", "norm", "refl"))


def _named_in(path: Path, words: tuple[str, ...]) -> Iterator[Path]:
    """Files named last in the lines that begin with one of these words."""
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    for line in text.splitlines():
        parts = line.split()
        if len(parts) > 1 and parts[0].lower().startswith(words):
            yield path.parent / parts[-1]


def _scale(
    articulation: Articulation, source: str, category: str, description: Description, warnings: list[str]
) -> float:
    """Metres per unit of the URDF: as told, else a plausible one for PartNet-Mobility, else 1."""
    if description.height_m is not None:
        return size_scale(articulation, "height", description.height_m)
    if description.size_m is not None:
        return size_scale(articulation, "length", description.size_m)
    if source == "partnet-mobility":
        if category == "Unknown":
            warnings.append("category unknown (no meta.json): assumed to be 0.8 m long")
        return real_scale(articulation, category)
    longest = float(articulation.extent_m.max())
    if source in _AS_TOLD and not _PLAUSIBLE_M[0] <= longest <= _PLAUSIBLE_M[1]:
        warnings.append(
            f"is {longest:.3g} m long if its units are metres: tell size_m in {DESCRIPTION_NAME} if they are not; "
            "beyond 6.55 m takes have no depth"
        )
    return 1.0


def _category_of_base(folder: Path) -> str:
    path = folder / "semantics.txt"
    words = path.read_text(encoding="utf-8", errors="replace").split() if path.exists() else []
    return next((_CATEGORY_OF_BASE[w] for w in words if w in _CATEGORY_OF_BASE), "Unknown")


def _read_json(path: Path, warnings: list[str]) -> Any:
    if not path.exists():
        return None
    try:
        return read_json(path, ObjectError)
    except ObjectError as error:
        warnings.append(f"left out: {error}")
        return None


def _articulation(
    urdf: Urdf, where: Path | str, part_names: Mapping[str, str], warnings: list[str]
) -> tuple[Articulation, dict[str, tuple[int, Float[np.ndarray, "4 4"]]]]:
    """Bodies of links that fixed joints hold together, in URDF units, with the root where the URDF puts it.

    Also tells the body that each link belongs to, and the link's pose in it.
    """
    moving = [j for j in urdf.joints if j.kind != "fixed" and j.upper > j.lower]
    if not moving:
        raise ObjectError(f"{where}: expected a joint that moves, found none; use another object")
    if len(moving) > _MOST_JOINTS:
        raise ObjectError(f"{where}: expected at most {_MOST_JOINTS} joints that move, got {len(moving)}")
    children = {j.child for j in urdf.joints}
    body = {name: 0 for name in urdf.links if name not in children}
    body_from_link = {name: np.eye(4) for name in body}
    joints: list[ArticulatedJoint] = []
    for j in urdf.joints:
        parent_from_joint = body_from_link[j.parent] @ j.parent_from_joint
        if j in moving:
            kind = "revolute" if j.kind == "revolute" else "prismatic"
            rest = float(np.clip(0.0, j.lower, j.upper))
            record = Joint(j.name, kind, j.lower, j.upper)
            joints.append(ArticulatedJoint(record, body[j.parent], parent_from_joint, j.axis, rest))
            body[j.child], body_from_link[j.child] = len(joints), np.eye(4)
        else:
            body[j.child], body_from_link[j.child] = body[j.parent], parent_from_joint
        if j.mimics is not None:
            warnings.append(f"joint {j.name} mimics {j.mimics}: here it moves on its own")
    names = ("base", *(j.child for j in moving))
    body_of_link = {link: (body[link], body_from_link[link]) for link in urdf.links}
    parts = _parts(urdf, body_of_link, where, part_names, warnings)
    return Articulation(names, parts, tuple(joints), np.eye(4)), body_of_link


def _parts(
    urdf: Urdf,
    body_of_link: Mapping[str, tuple[int, Float[np.ndarray, "4 4"]]],
    where: Path | str,
    part_names: Mapping[str, str],
    warnings: list[str],
) -> tuple[Part, ...]:
    """The visuals of all links that have a mesh."""
    parts, missing = [], []
    for link, visuals in urdf.links.items():
        for visual in visuals:
            surface = _surface(visual)
            if surface is None:
                missing.append(visual.mesh.name if isinstance(visual.mesh, Path) else visual.shape)
                continue
            name, (body, body_from_link) = _part_name(visual, link, part_names), body_of_link[link]
            body_from_part = body_from_link @ visual.link_from_visual
            in_body = surface.copy().apply_transform(body_from_part)
            looks = visual.mesh, visual.scale, visual.scale, visual.shape, visual.rgba
            parts.append(Part(name, visual.name, body, body_from_part, *looks, in_body))
    if not parts:
        raise ObjectError(
            f"{where}: expected meshes beside it, found none of the {len(missing)} that it names "
            f"(first: {missing[0] if missing else 'none named'}); copy the object's textured_objs folder too"
        )
    if missing:
        warnings.append(
            f"{len(missing)} meshes are missing or have no faces and were left out: {', '.join(missing[:5])}"
        )
    return tuple(parts)


def _part_name(visual: UrdfVisual, link: str, part_names: Mapping[str, str]) -> str:
    """What a visual is: its own name, else its link's if that says handle or knob, else the annotation's."""
    if part_label(link) and not part_label(visual.name):
        return link
    return visual.name or part_names.get(visual.mesh.stem if isinstance(visual.mesh, Path) else "", "")


def _names_of_meshes(folder: Path, warnings: list[str]) -> dict[str, str]:
    """Part name per mesh stem, from ``result_after_merging.json`` or ``mobility_v2.json``; the deepest part wins."""
    names: dict[str, str] = {}

    def visit(nodes: Any, inherited: str) -> None:
        for node in nodes if isinstance(nodes, list) else []:
            if not isinstance(node, dict):
                continue
            own = f"{node.get('name', '')}-{node.get('id', '')}"
            # The pieces of a handle (a bar, its mounts) stay pieces of that handle.
            name = inherited if part_label(inherited) else own
            for mesh in node.get("objs") or []:
                names[str(mesh)] = name
            visit(node.get("children") or node.get("parts"), name)

    for file in _PART_NAMES:
        visit(_read_json(folder / file, warnings), "")
    return names


def _surface(visual: UrdfVisual) -> trimesh.Trimesh | None:
    """Geometry of a visual in its own frame, in URDF units; None if it is missing or empty."""
    if visual.shape == "box":
        return trimesh.creation.box(extents=visual.size)
    if visual.shape == "cylinder":
        return trimesh.creation.cylinder(radius=visual.size[0], height=visual.size[1], sections=24)
    if visual.shape == "sphere":
        return trimesh.creation.icosphere(subdivisions=2, radius=visual.size[0])
    if isinstance(visual.mesh, MeshData):
        return trimesh.Trimesh(visual.mesh.vertices, visual.mesh.faces, process=False)
    assert visual.mesh is not None
    if not visual.mesh.is_file():
        return None
    try:
        mesh = trimesh.load(visual.mesh, process=False, force="mesh", skip_materials=True)
        unit_m = _collada_unit_m(visual.mesh)
    except Exception:  # its many readers raise whatever a damaged file or a missing package makes them
        return None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        return None
    used = trimesh.Trimesh(np.asarray(mesh.vertices) * unit_m * np.array(visual.scale), mesh.faces, process=False)
    if np.prod(visual.scale) < 0:
        used.invert()  # mirrored: the faces look inwards
    used.remove_unreferenced_vertices()
    return used


def _collada_unit_m(path: Path) -> float:
    """Metres per unit that a COLLADA file tells, which SAPIEN heeds and trimesh does not; 1 for other files."""
    if path.suffix.lower() != ".dae":
        return 1.0
    unit = next((e for e in ElementTree.parse(path).iter() if e.tag.rpartition("}")[2] == "unit"), None)
    return 1.0 if unit is None else float(unit.get("meter", 1.0))
