"""Object folders, of PartNet-Mobility or of that shape, as records that can be moved and rendered."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float

from quest.errors import ObjectError
from quest.sim.articulation import ArticulatedJoint, Articulation, Part, apply
from quest.sim.entities import MOVES_AT_LEAST, SimEntity, find_entities, part_label
from quest.sim.urdf import Urdf, UrdfVisual, read_urdf
from quest.types import Joint

OBJECTS_VARIABLE = "QUEST_OBJECTS"
"""Environment variable that names the folder of PartNet-Mobility folders."""

# Which extent of an object at rest has which real length, metres. "height" is vertical, "length" the longest extent.
_REAL_SIZE_M: dict[str, tuple[Literal["height", "length"], float]] = {
    "StorageFurniture": ("height", 0.8),
    "Table": ("height", 0.75),
    "Refrigerator": ("height", 1.7),
    "Microwave": ("height", 0.3),
    "Oven": ("height", 0.9),
    "Dishwasher": ("height", 0.85),
    "Door": ("height", 2.0),
    "Bucket": ("height", 0.3),
    "Kettle": ("height", 0.25),
    "Eyeglasses": ("length", 0.14),
    "Stapler": ("length", 0.15),
    "Scissors": ("length", 0.18),
    "Laptop": ("length", 0.34),
    "WashingMachine": ("height", 0.85),
    "TrashCan": ("height", 0.4),
    "Box": ("length", 0.4),
    "Safe": ("height", 0.5),
    "Suitcase": ("length", 0.6),
}
_DEFAULT_SIZE_M = ("length", 0.8)
_CATEGORY_OF_BASE = {
    "furniture_body": "StorageFurniture",
    "refrigerator_body": "Refrigerator",
    "microwave_body": "Microwave",
    "oven_body": "Oven",
}


@dataclass(frozen=True)
class SimObject:
    """An articulated object, ready to be moved and rendered.

    Attributes:
        source: ``partnet-mobility`` or ``procedural``.
        object_id: the folder's name.
        category: such as ``StorageFurniture``; ``Unknown`` if the folder does not tell.
        folder: where it was read from.
        articulation: bodies, joints and their geometry, metres.
        entities: what can be followed; hinges come last.
        half_diagonal_m: half the diagonal of the bounding box at rest.
        scale: metres per unit of the URDF.
        warnings: degradations, in words: missing meshes, a category that is not known.
    """

    source: Literal["partnet-mobility", "procedural"]
    object_id: str
    category: str
    folder: Path
    articulation: Articulation
    entities: tuple[SimEntity, ...]
    half_diagonal_m: float
    scale: float
    warnings: tuple[str, ...]

    @property
    def movable(self) -> tuple[int, ...]:
        """Joints that carry an entity (hinges aside) that moves at least 0.1 normalised units."""
        least = MOVES_AT_LEAST * self.half_diagonal_m
        return tuple(sorted({e.joint for e in self.entities if e.label != "hinge" and e.travel_m >= least}))


def find_objects(root: Path | None = None) -> list[Path]:
    """Object folders below ``root`` (default: the environment's ``QUEST_OBJECTS``), sorted.

    Raises:
        ObjectError: no root is given or set, it does not exist, or it holds no folder with a ``mobility.urdf``.
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
    folders = sorted(f.parent for f in root.glob("*/mobility.urdf"))
    if not folders:
        raise ObjectError(f"{root}: expected folders that each hold a mobility.urdf, found none")
    return folders


def load_object(folder: Path) -> SimObject:
    """Reads an object folder; only ``mobility.urdf`` and the meshes it names are needed.

    Meshes that are missing or have no faces are left out and listed in ``warnings``.

    Raises:
        ObjectError: the folder or its URDF is missing or broken, all meshes are missing, or nothing moves.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ObjectError(f"{folder}: expected an object folder, found none; check the path and the object's id")
    warnings: list[str] = []
    urdf = _with_scaled_origins(read_urdf(folder / "mobility.urdf"), warnings)
    meta = _read_json(folder / "meta.json", warnings)
    meta = meta if isinstance(meta, dict) else {}
    articulation = _closed(_articulation(urdf, folder, warnings))
    category = str(meta.get("model_cat") or _category_of_base(folder))
    if category == "Unknown":
        warnings.append("category unknown (no meta.json): assumed to be 0.8 m long")
    source = "procedural" if meta.get("source") == "procedural" else "partnet-mobility"
    scale = 1.0 if source == "procedural" else _scale(articulation, category)
    articulation = _placed(_scaled(articulation, scale))
    extent = np.ptp(articulation.world_points(articulation.rest), axis=0)
    half_diagonal_m = float(np.linalg.norm(extent)) / 2
    entities = find_entities(articulation, half_diagonal_m)
    if all(e.label == "hinge" for e in entities):
        raise ObjectError(
            f"{folder}: expected a moving link with a handle, rim or front, found none; use another object"
        )
    return SimObject(
        source, folder.name, category, folder, articulation, entities, half_diagonal_m, scale, tuple(warnings)
    )  # fmt: skip


def _read_json(path: Path, warnings: list[str]) -> Any:
    if not path.exists():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        warnings.append(f"{path.name} is not readable ({error}) and was left out")
        return None


def _category_of_base(folder: Path) -> str:
    path = folder / "semantics.txt"
    words = path.read_text(encoding="utf-8", errors="replace").split() if path.exists() else []
    return next((_CATEGORY_OF_BASE[w] for w in words if w in _CATEGORY_OF_BASE), "Unknown")


def _with_scaled_origins(urdf: Urdf, warnings: list[str]) -> Urdf:
    """Mends a URDF whose meshes were all scaled down but whose origins and travels were not.

    PartNet-Mobility's visuals stand where the joint's origin is taken back, so that all meshes share one frame. If
    such meshes carry one scale factor, origins in the old units put the axes far outside the object.
    """
    visuals = [v for vs in urdf.links.values() for v in vs if v.mesh is not None]
    factors = {f for v in visuals for f in v.scale}
    if len(factors) != 1 or factors == {1.0}:
        return urdf
    origins = {j.child: j.parent_from_joint[:3, 3] for j in urdf.joints if j.kind != "fixed"}
    taken_back = [
        np.allclose(v.link_from_visual[:3, 3], -origin, atol=1e-6) and np.linalg.norm(origin) > 0
        for child, origin in origins.items()
        for v in urdf.links[child]
    ]
    if not taken_back or not all(taken_back):
        return urdf
    (factor,) = factors
    warnings.append(f"all meshes are scaled by {factor:g} but joint origins are not: origins were scaled alike")

    def scaled(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        pose = pose.copy()
        pose[:3, 3] *= factor
        return pose

    links = {
        name: tuple(replace(v, link_from_visual=scaled(v.link_from_visual)) for v in vs)
        for name, vs in urdf.links.items()
    }
    joints = []
    for j in urdf.joints:
        travel = factor if j.kind == "prismatic" else 1.0
        joints.append(
            replace(j, parent_from_joint=scaled(j.parent_from_joint), lower=j.lower * travel, upper=j.upper * travel)
        )
    return Urdf(links, tuple(joints))


def _articulation(urdf: Urdf, folder: Path, warnings: list[str]) -> Articulation:
    """Bodies of links that fixed joints hold together, in URDF units, with the root where the URDF puts it."""
    moving = [j for j in urdf.joints if j.kind != "fixed" and j.upper > j.lower]
    if not moving:
        raise ObjectError(f"{folder / 'mobility.urdf'}: expected a joint that moves, found none; use another object")
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
    names = ("base", *(j.child for j in moving))
    part_names = _names_of_meshes(folder, warnings)
    parts, missing = [], []
    for link, visuals in urdf.links.items():
        for visual in visuals:
            surface = _surface(visual)
            if surface is None:
                missing.append(visual.mesh.name if visual.mesh else visual.shape)
                continue
            name = _part_name(visual, link, part_names)
            parts.append(_part(visual, name, body[link], body_from_link[link], surface))
    if not parts:
        raise ObjectError(
            f"{folder}: expected meshes beside mobility.urdf, found none of the {len(missing)} that it names "
            f"(first: {missing[0] if missing else 'none named'}); copy the object's textured_objs folder too"
        )
    if missing:
        warnings.append(
            f"{len(missing)} meshes are missing or have no faces and were left out: {', '.join(missing[:5])}"
        )
    return Articulation(names, tuple(parts), tuple(joints), np.eye(4))


def _part_name(visual: UrdfVisual, link: str, part_names: dict[str, str]) -> str:
    """What a visual is: its own name, else its link's if that says handle or knob, else the annotation's."""
    if part_label(visual.name):
        return visual.name
    if part_label(link):
        return link
    return visual.name or part_names.get(visual.mesh.stem if visual.mesh else "", "")


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

    for file in ("mobility_v2.json", "result_after_merging.json"):
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
    assert visual.mesh is not None
    if not visual.mesh.is_file():
        return None
    try:
        mesh = trimesh.load(visual.mesh, process=False, force="mesh", skip_materials=True)
    except (ValueError, IndexError, KeyError, OSError):
        return None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        return None
    used = trimesh.Trimesh(np.asarray(mesh.vertices) * np.array(visual.scale), mesh.faces, process=False)
    used.remove_unreferenced_vertices()
    return used


def _part(
    visual: UrdfVisual, name: str, body: int, body_from_link: Float[np.ndarray, "4 4"], surface: trimesh.Trimesh
) -> Part:
    body_from_part = body_from_link @ visual.link_from_visual
    in_body = surface.copy().apply_transform(body_from_part)
    return Part(name, body, body_from_part, visual.mesh, visual.scale, visual.shape, visual.size, visual.rgba, in_body)


def _scale(articulation: Articulation, category: str) -> float:
    extent = np.ptp(articulation.world_points(articulation.rest), axis=0)
    dimension, metres = _REAL_SIZE_M.get(category, _DEFAULT_SIZE_M)
    length = float(extent[2] if dimension == "height" else extent.max())
    return metres / max(length, 1e-9)


def _closed(articulation: Articulation) -> Articulation:
    """The object with doors that are modelled half open at their limit where it takes less room."""

    def room(trial: Articulation) -> float:
        return float(np.prod(np.ptp(trial.world_points(trial.rest), axis=0)))

    for index, joint in enumerate(articulation.joints):
        below, above = joint.travel()
        # A joint that starts at a limit, or nearly, is closed there.
        if joint.joint.kind != "revolute" or min(below, above) < 0.25 * max(below, above):
            continue
        for limit in (joint.joint.lower, joint.joint.upper):
            joints = list(articulation.joints)
            joints[index] = replace(joint, rest=limit)
            trial = replace(articulation, joints=tuple(joints))
            if room(trial) < 0.85 * room(articulation):
                articulation = trial
    return articulation


def _scaled(articulation: Articulation, scale: float) -> Articulation:
    def pose(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        scaled = matrix.copy()
        scaled[:3, 3] *= scale
        return scaled

    parts = []
    for p in articulation.parts:
        sx, sy, sz = p.scale
        parts.append(
            replace(
                p,
                body_from_part=pose(p.body_from_part),
                scale=(sx * scale, sy * scale, sz * scale),
                size_m=tuple(s * scale for s in p.size_m),
                surface=p.surface.copy().apply_scale(scale),
            )
        )
    joints = []
    for j in articulation.joints:
        factor = scale if j.joint.kind == "prismatic" else 1.0
        record = replace(j.joint, lower=j.joint.lower * factor, upper=j.joint.upper * factor)
        joints.append(replace(j, joint=record, parent_from_joint=pose(j.parent_from_joint), rest=j.rest * factor))
    return replace(
        articulation, parts=tuple(parts), joints=tuple(joints), world_from_root=pose(articulation.world_from_root)
    )


def _placed(articulation: Articulation) -> Articulation:
    """The object standing on the floor around the origin, its front towards +x."""
    yaw = -_front_azimuth(articulation)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    turned = replace(articulation, world_from_root=turn @ articulation.world_from_root)
    points = turned.world_points(turned.rest)
    low, high = points.min(axis=0), points.max(axis=0)
    shift = np.eye(4)
    shift[:3, 3] = [-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]]
    return replace(turned, world_from_root=shift @ turned.world_from_root)


def _front_azimuth(articulation: Articulation) -> float:
    """Where the object's doors and drawers open to, as a multiple of a right angle; PartNet's -x if that is unclear."""
    poses = articulation.poses(articulation.rest)
    total = np.zeros(2)
    opened = 0.0
    for j, joint in enumerate(articulation.joints):
        points = articulation.body_points[1 + j]
        below, above = joint.travel()
        # A joint that can go both ways from its place at rest does not tell where the front is.
        if len(points) == 0 or min(below, above) > 0.25 * max(below, above):
            continue
        # The middle of the bounding box, not of the vertices, which crowd where the modeller was fond of detail.
        centre = apply(poses[1 + j], (points.min(axis=0) + points.max(axis=0)) / 2)
        step = articulation.velocity(j, centre) * abs(joint.opening())
        total += step[:2]
        opened += float(np.linalg.norm(step))
    if np.linalg.norm(total) < 0.3 * opened or opened == 0.0:
        return np.pi
    return float(np.round(np.arctan2(total[1], total[0]) / (np.pi / 2)) * (np.pi / 2))
