"""Kitchen furniture and appliances from scene-synthesizer, turned into :class:`ObjectModel`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.errors import MissingExtraError
from quest.extras import install_command
from quest.sim.procedural.handles import HandleStyle, handle_part, sample_style
from quest.sim.procedural.model import Link, Mesh, ObjectModel, Part, join
from quest.sim.procedural.shapes import box, polygon_flat

_OWN_HANDLE_SHARE = 0.5
_BARE_SHARE = 0.06
_SURFACES = {
    "shelf": "inside", "holder": "inside", "drawer_box": "inside", "drawer_front": "front", "door_panel": "front",
    "window": "dark", "heater": "dark", "sink": "metal", "basket": "metal", "top": "front", "frame": "body",
}  # fmt: skip


def build_kitchen(category: str, rng: np.random.Generator) -> ObjectModel:
    """A kitchen cabinet or an appliance with random proportions.

    Args:
        category: one of :data:`KITCHEN`.
        rng: source of randomness.

    Raises:
        MissingExtraError: If scene-synthesizer is not installed.
    """
    try:
        from scene_synthesizer import procedural_assets
    except ImportError as error:
        raise MissingExtraError(
            f"procedural {category}: scene-synthesizer is missing; install the extra: {install_command('sim')}"
        ) from error
    model_cat, describe = KITCHEN[category]
    with tempfile.TemporaryDirectory(prefix="quest-") as folder:
        name, arguments = describe(rng, folder)
        asset = getattr(procedural_assets, name)(**arguments)
        return _convert(asset._model.robot, rng, model_cat)


def _handle_shape(
    rng: np.random.Generator, folder: str, *, straight: tuple[float, float] = (0.3, 2.0)
) -> dict[str, Any]:
    return {
        "straight_ratio": float(rng.uniform(*straight)),
        "curvature_ratio": float(rng.uniform(0.2, 1.0)),
        "num_segments_cross_section": int(rng.choice([4, 8])),
        "num_segments_curvature": 8,
        "aspect_ratio_cross_section": float(rng.uniform(0.5, 1.2)),
        "tmp_mesh_dir": folder,
    }


def _cabinet_handle(rng: np.random.Generator, folder: str) -> dict[str, Any]:
    shape = _handle_shape(rng, folder) if rng.random() < 0.6 else None
    return {
        "handle_width": float(rng.uniform(0.1, 0.22)),
        "handle_height": float(rng.uniform(0.015, 0.035)),
        "handle_depth": float(rng.uniform(0.025, 0.045)),
        "handle_shape_args": shape,
    }


def _doors(rng: np.random.Generator, count: int) -> tuple[str, ...]:
    if count == 1:
        return (str(rng.choice(["door_left", "door_right"])),)
    return tuple("door_right" if index % 2 == 0 else "door_left" for index in range(count))


def _base_cabinet(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    doors = int(rng.integers(1, 4))
    rows = int(rng.choice([1, 1, 2]))
    return "BaseCabinetAsset", {
        "width": float(rng.uniform(0.38, 0.48)) * max(doors, 2 if rows == 1 else 1),
        "depth": float(rng.uniform(0.5, 0.7)),
        "height": float(rng.uniform(0.8, 0.95)),
        "num_drawers_horizontal": max(doors, 2) if rng.random() < 0.8 else 1,
        "num_drawers_vertical": rows,
        "drawer_height": float(rng.uniform(0.16, 0.2)),
        "lower_compartment_types": _doors(rng, doors),
        "num_shelves": int(rng.integers(0, 3)),
        **_cabinet_handle(rng, folder),
    }


def _wall_cabinet(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    doors = int(rng.integers(2, 5))
    return "WallCabinetAsset", {
        "width": float(rng.uniform(0.32, 0.45)) * doors,
        "depth": float(rng.uniform(0.28, 0.38)),
        "height": float(rng.uniform(0.55, 0.95)),
        "compartment_types": _doors(rng, doors),
        "num_shelves": int(rng.integers(1, 4)),
        **_cabinet_handle(rng, folder),
    }


def _island(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    depth = float(rng.uniform(0.6, 0.9))
    return "KitchenIslandAsset", {
        "width": float(rng.uniform(1.1, 1.6)),
        "depth": depth,
        "height": float(rng.uniform(0.85, 0.95)),
        "depth_storage": depth * float(rng.uniform(0.5, 0.7)),
        **_cabinet_handle(rng, folder),
    }


def _sink_cabinet(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    width, depth = float(rng.uniform(0.7, 1.1)), float(rng.uniform(0.58, 0.75))
    return "SinkCabinetAsset", {
        "width": width,
        "depth": depth,
        "height": float(rng.uniform(0.82, 0.95)),
        "sink_width": width * float(rng.uniform(0.55, 0.8)),
        "sink_depth": depth * float(rng.uniform(0.5, 0.6)),
        "sink_tmp_mesh_dir": folder,
        "use_primitives_for_sink": True,
        **_cabinet_handle(rng, folder),
    }


def _microwave(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    width = float(rng.uniform(0.42, 0.6))
    height = float(rng.uniform(0.26, 0.36))
    return "MicrowaveAsset", {
        "width": width,
        "depth": float(rng.uniform(0.32, 0.42)),
        "height": height,
        "thickness": float(rng.uniform(0.02, 0.04)),
        "display_panel_width": width * float(rng.uniform(0.18, 0.28)),
        "handle_left": bool(rng.random() < 0.3),
        "handle_depth": float(rng.uniform(0.03, 0.06)),
        "handle_thickness": float(rng.uniform(0.015, 0.035)),
        "handle_length": height * float(rng.uniform(0.5, 0.85)),
        "handle_straight_ratio": float(rng.uniform(0.3, 1.5)),
        "handle_num_segments_cross_section": int(rng.choice([4, 8])),
        "tmp_mesh_dir": folder,
    }


def _refrigerator(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    height = float(rng.uniform(1.2, 1.9))
    upright = bool(rng.random() < 0.8)
    width = float(rng.uniform(0.55, 0.9))
    return "RefrigeratorAsset", {
        "width": width,
        "depth": float(rng.uniform(0.55, 0.75)),
        "height": height,
        "freezer_compartment_height": height * float(rng.uniform(0.25, 0.4)) if rng.random() < 0.8 else 0.0,
        "thickness": float(rng.uniform(0.04, 0.07)),
        "num_shelves": int(rng.integers(2, 5)),
        "num_door_shelves": int(rng.integers(2, 4)),
        "handle_left": bool(rng.random() < 0.5),
        "handle_vertical": upright,
        "handle_length": float(rng.uniform(0.2, 0.28)) if upright else width * float(rng.uniform(0.3, 0.5)),
        "handle_thickness": float(rng.uniform(0.025, 0.06)),
        "handle_depth": float(rng.uniform(0.03, 0.06)),
        "handle_shape_args": _handle_shape(rng, folder),
        "door_shape_args": {
            "straight_ratio": float(rng.uniform(0.85, 0.95)),
            "curvature_ratio": 0.9,
            "num_segments": 9,
            "tmp_mesh_dir": folder,
        },
    }


def _front_handle(rng: np.random.Generator, folder: str, width: float) -> dict[str, Any]:
    return {
        "handle_length": width * float(rng.uniform(0.45, 0.85)),
        "handle_thickness": float(rng.uniform(0.018, 0.04)),
        "handle_depth": float(rng.uniform(0.035, 0.06)),
        "handle_offset": float(rng.uniform(0.03, 0.06)),
        "handle_shape_args": _handle_shape(rng, folder, straight=(0.6, 2.0)),
    }


def _range(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    width, height = float(rng.uniform(0.55, 0.9)), float(rng.uniform(0.85, 0.95))
    storage = float(rng.uniform(0.16, 0.24))
    return "RangeAsset", {
        "width": width,
        "depth": float(rng.uniform(0.58, 0.72)),
        "height": height,
        "storage_height": storage,
        "oven_height": height - storage - 0.1,
        **_front_handle(rng, folder, width),
    }


def _dishwasher(rng: np.random.Generator, folder: str) -> tuple[str, dict[str, Any]]:
    width = float(rng.uniform(0.45, 0.75))
    return "DishwasherAsset", {
        "width": width,
        "depth": float(rng.uniform(0.55, 0.7)),
        "height": float(rng.uniform(0.8, 0.92)),
        "basket_wire_mesh_gap": 0.09,
        **_front_handle(rng, folder, width),
    }


KITCHEN: dict[str, tuple[str, Callable[[np.random.Generator, str], tuple[str, dict[str, Any]]]]] = {
    "base_cabinet": ("StorageFurniture", _base_cabinet),
    "wall_cabinet": ("StorageFurniture", _wall_cabinet),
    "island": ("StorageFurniture", _island),
    "sink_cabinet": ("StorageFurniture", _sink_cabinet),
    "microwave": ("Microwave", _microwave),
    "refrigerator": ("Refrigerator", _refrigerator),
    "range": ("Oven", _range),
    "dishwasher": ("Dishwasher", _dishwasher),
}
"""PartNet-Mobility's word for each category, and what to ask of scene-synthesizer."""


def _convert(robot: Any, rng: np.random.Generator, model_cat: str) -> ObjectModel:
    """A yourdfpy robot whose moving links hang on one root, as our own model; dish racks stay with the body."""
    joints = {joint.child: joint for joint in robot.joints}
    furniture = model_cat == "StorageFurniture"
    own_style = sample_style(rng, knobs=furniture, scale=1.0 if furniture else 2.0)
    use_own = bool(rng.random() < _OWN_HANDLE_SHARE)
    bare = bool(rng.random() < _BARE_SHARE)
    surface = str(rng.choice(["metal", "dark", "white"], p=[0.55, 0.3, 0.15]))
    opening = float(np.deg2rad(rng.uniform(80, 115)))
    body: list[tuple[str, Mesh]] = []
    links: list[Link] = []
    for link in robot.links:
        meshes = [(visual.name or "", _visual_mesh(visual)) for visual in link.visuals]
        joint = joints.get(link.name)
        if joint is None or "basket" in link.name:
            origin = np.eye(4) if joint is None else joint.origin
            body += [(name, _transformed(mesh, origin)) for name, mesh in meshes]
            continue
        assert np.allclose(joint.origin[:3, :3], np.eye(3)), link.name
        handles = [mesh for name, mesh in meshes if "handle" in name]
        rest = [(name, mesh) for name, mesh in meshes if "handle" not in name]
        if model_cat == "Microwave":
            rest.append(("window", _pane(rest[0][1], rng)))
        parts = _group(rest, moving=True)
        if handles and not bare:
            original = Part("handle", join(handles), surface)
            parts.append(_own_handle(own_style, original.mesh, join([m for _, m in rest])) if use_own else original)
        upper = opening if joint.type == "revolute" else 0.85 * float(joint.limit.upper)
        if abs(joint.axis[0]) > 0.5:
            upper = min(upper, np.deg2rad(92.0))  # a bottom-hinged door would hit the floor
        x, y, z = joint.origin[:3, 3].tolist()
        ax, ay, az = (np.asarray(joint.axis, dtype=float) + 0.0).tolist()
        links.append(Link(f"link_{len(links)}", tuple(parts), joint.type, (x, y, z), (ax, ay, az), float(upper)))
    model = ObjectModel(model_cat, tuple(_group(body, moving=False)), tuple(links))
    lowest = min(float(part.mesh.bounds[0, 2]) for part in model.body)
    return model.moved((0.0, 0.0, -lowest))


def _pane(panel: Mesh, rng: np.random.Generator) -> Mesh:
    """A thin pane on the face of a door, clear of the strip where its handle stands."""
    (x0, y, z0), (x1, _, z1) = panel.bounds
    margin = np.array([0.2 * (x1 - x0), float(rng.uniform(0.1, 0.25)) * (z1 - z0)])
    return box((x0 + margin[0], y - 0.002, z0 + margin[1]), (x1 - margin[0], y + 0.002, z1 - margin[1]))


def _visual_mesh(visual: Any) -> Mesh:
    """A yourdfpy visual in the frame of its link."""
    import trimesh

    geometry = visual.geometry
    origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin)
    if geometry.box is not None:
        half = np.asarray(geometry.box.size, dtype=float) / 2
        return _transformed(box(tuple(-half), tuple(half)), origin)
    if geometry.cylinder is not None:
        bare = trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=24)
    else:
        assert geometry.mesh is not None, visual.name
        bare = trimesh.load_mesh(geometry.mesh.filename, process=True)
        if geometry.mesh.scale is not None:
            bare.apply_scale(geometry.mesh.scale)
    bare.merge_vertices(merge_tex=True, merge_norm=True)
    if bare.is_watertight:
        bare.fix_normals()
    bare.apply_transform(origin)
    return polygon_flat(np.asarray(bare.vertices), np.asarray(bare.faces))


def _transformed(mesh: Mesh, matrix: Float[np.ndarray, "4 4"]) -> Mesh:
    return mesh.rotated(np.asarray(matrix)[:3, :3]).moved(np.asarray(matrix)[:3, 3])


def _role(name: str, mesh: Mesh, front_y: float, *, moving: bool) -> str:
    for word in ("window", "holder", "shelf", "heater", "sink", "basket"):
        if word in name:
            return word if word != "holder" else "shelf"
    if "board" in name:
        return "drawer_front" if mesh.bounds[0, 1] <= front_y + 1e-6 else "drawer_box"
    if moving:
        return "door_panel"
    return "top" if "countertop" in name else "frame"


def _group(meshes: list[tuple[str, Mesh]], *, moving: bool) -> list[Part]:
    """One part for each role, so that a rendering has few shapes."""
    front_y = min(float(mesh.bounds[0, 1]) for _, mesh in meshes)
    roles: dict[str, list[Mesh]] = {}
    for name, mesh in meshes:
        roles.setdefault(_role(name, mesh, front_y, moving=moving), []).append(mesh)
    return [Part(role, join(group), _SURFACES[role]) for role, group in roles.items()]


def _own_handle(style: HandleStyle, original: Mesh, front: Mesh) -> Part:
    """One of our handles where scene-synthesizer had put its own."""
    low, high = original.bounds
    size = high - low
    middle = (low + high) / 2
    foot = _surface_y(front, float(middle[0]), float(middle[2]))
    vertical = bool(size[2] > size[0])
    room = (1.4 * size[0], 0.12) if not vertical else (0.12, 1.4 * size[2])
    return handle_part(style, at=(float(middle[0]), foot, float(middle[2])), vertical=vertical, room_m=room)


def _surface_y(mesh: Mesh, x: float, z: float) -> float:
    """Smallest y of a surface above the point (x, z) of the front; of its bounding box where there is none."""
    corner = mesh.vertices[mesh.faces]
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 2] - ab[:, 2] * ac[:, 0]
    facing = np.abs(area) > 1e-12
    a, ab, ac, area = a[facing], ab[facing], ac[facing], area[facing]
    px, pz = x - a[:, 0], z - a[:, 2]
    u = (px * ac[:, 2] - pz * ac[:, 0]) / area
    v = (ab[:, 0] * pz - ab[:, 2] * px) / area
    hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
    if not hit.any():
        return float(mesh.bounds[0, 1])
    return float((a[:, 1] + u * ab[:, 1] + v * ac[:, 1])[hit].min())
