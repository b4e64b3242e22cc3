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
from quest.sim.procedural.model import Dice, Link, ObjectModel, Part
from quest.sim.procedural.shapes import Mesh, box, centred_box, join, polygon_flat

_OWN_HANDLE_SHARE = 0.5
_BARE_SHARE = 0.06
_SURFACES = {
    "shelf": "inside", "holder": "inside", "drawer_box": "inside", "drawer_front": "front", "door_panel": "front",
    "window": "dark", "heater": "dark", "sink": "metal", "basket": "metal", "top": "front", "frame": "body",
}  # fmt: skip


_FOLDER = object()
"""Stands for a folder for mesh files."""


def _share(name: str, low: float, high: float) -> Callable[[dict[str, Any], Dice], float]:
    """A random share of an argument that is drawn already."""
    return lambda drawn, rng: drawn[name] * rng.real(low, high)


def _doors(drawn: dict[str, Any], rng: Dice) -> tuple[str, ...]:
    if drawn["_doors"] == 1:
        return (rng.pick(["door_left", "door_right"]),)
    return tuple("door_right" if index % 2 == 0 else "door_left" for index in range(drawn["_doors"]))


_SHAPE = {
    "straight_ratio": (0.3, 2.0), "curvature_ratio": (0.2, 1.0), "num_segments_cross_section": [4, 8],
    "num_segments_curvature": 8, "aspect_ratio_cross_section": (0.5, 1.2), "tmp_mesh_dir": _FOLDER,
}  # fmt: skip
_CABINET_HANDLE = {
    "_curved": lambda drawn, rng: rng.chance(0.6),
    "handle_shape_args": lambda drawn, rng: _SHAPE if drawn["_curved"] else None,
    "handle_width": (0.1, 0.22), "handle_height": (0.015, 0.035), "handle_depth": (0.025, 0.045),
}  # fmt: skip
_FRONT_HANDLE = {
    "handle_length": _share("width", 0.45, 0.85), "handle_thickness": (0.018, 0.04), "handle_depth": (0.035, 0.06),
    "handle_offset": (0.03, 0.06), "handle_shape_args": {**_SHAPE, "straight_ratio": (0.6, 2.0)},
}  # fmt: skip

KITCHEN: dict[str, tuple[str, str, dict[str, Any]]] = {
    "base_cabinet": ("StorageFurniture", "BaseCabinetAsset", {
        "_doors": range(1, 4), "num_drawers_vertical": [1, 1, 2],
        "width": lambda drawn, rng: rng.real(0.38, 0.48) * max(drawn["_doors"], 3 - drawn["num_drawers_vertical"]),
        "depth": (0.5, 0.7), "height": (0.8, 0.95),
        "num_drawers_horizontal": lambda drawn, rng: max(drawn["_doors"], 2) if rng.chance(0.8) else 1,
        "drawer_height": (0.16, 0.2), "lower_compartment_types": _doors, "num_shelves": range(3), **_CABINET_HANDLE,
    }),
    "wall_cabinet": ("StorageFurniture", "WallCabinetAsset", {
        "_doors": range(2, 5), "width": lambda drawn, rng: rng.real(0.32, 0.45) * drawn["_doors"],
        "depth": (0.28, 0.38), "height": (0.55, 0.95), "compartment_types": _doors, "num_shelves": range(1, 4),
        **_CABINET_HANDLE,
    }),
    "island": ("StorageFurniture", "KitchenIslandAsset", {
        "depth": (0.6, 0.9), "width": (1.1, 1.6), "height": (0.85, 0.95), "depth_storage": _share("depth", 0.5, 0.7),
        **_CABINET_HANDLE,
    }),
    "sink_cabinet": ("StorageFurniture", "SinkCabinetAsset", {
        "width": (0.7, 1.1), "depth": (0.58, 0.75), "height": (0.82, 0.95), "sink_width": _share("width", 0.55, 0.8),
        "sink_depth": _share("depth", 0.5, 0.6), "sink_tmp_mesh_dir": _FOLDER, "use_primitives_for_sink": True,
        **_CABINET_HANDLE,
    }),
    "microwave": ("Microwave", "MicrowaveAsset", {
        "width": (0.42, 0.6), "height": (0.26, 0.36), "depth": (0.32, 0.42), "thickness": (0.02, 0.04),
        "display_panel_width": _share("width", 0.18, 0.28), "handle_left": lambda drawn, rng: rng.chance(0.3),
        "handle_depth": (0.03, 0.06), "handle_thickness": (0.015, 0.035),
        "handle_length": _share("height", 0.5, 0.85), "handle_straight_ratio": (0.3, 1.5),
        "handle_num_segments_cross_section": [4, 8], "tmp_mesh_dir": _FOLDER,
    }),
    "refrigerator": ("Refrigerator", "RefrigeratorAsset", {
        "height": (1.2, 1.9), "handle_vertical": lambda drawn, rng: rng.chance(0.8), "width": (0.55, 0.9),
        "depth": (0.55, 0.75),
        "freezer_compartment_height":
            lambda drawn, rng: drawn["height"] * rng.real(0.25, 0.4) if rng.chance(0.8) else 0.0,
        "thickness": (0.04, 0.07), "num_shelves": range(2, 5), "num_door_shelves": range(2, 4),
        "handle_left": lambda drawn, rng: rng.chance(0.5),
        "handle_length":
            lambda drawn, rng: rng.real(0.2, 0.28) if drawn["handle_vertical"] else drawn["width"] * rng.real(0.3, 0.5),
        "handle_thickness": (0.025, 0.06), "handle_depth": (0.03, 0.06), "handle_shape_args": _SHAPE,
        "door_shape_args": {
            "straight_ratio": (0.85, 0.95), "curvature_ratio": 0.9, "num_segments": 9, "tmp_mesh_dir": _FOLDER,
        },
    }),
    "range": ("Oven", "RangeAsset", {
        "width": (0.55, 0.9), "height": (0.85, 0.95), "storage_height": (0.16, 0.24), "depth": (0.58, 0.72),
        "oven_height": lambda drawn, rng: drawn["height"] - drawn["storage_height"] - 0.1, **_FRONT_HANDLE,
    }),
    "dishwasher": ("Dishwasher", "DishwasherAsset", {
        "width": (0.45, 0.75), "depth": (0.55, 0.7), "height": (0.8, 0.92), "basket_wire_mesh_gap": 0.09,
        **_FRONT_HANDLE,
    }),
}  # fmt: skip
"""PartNet-Mobility's word for each category, scene-synthesizer's, and a recipe of what to ask of it.

A recipe is gone through in order. A pair is a range, a list a choice, a ``range`` a choice of whole numbers; a function
knows what is drawn so far; names with an underscore are not asked for.
"""


def build_kitchen(category: str, rng: Dice) -> ObjectModel:
    """A kitchen cabinet or an appliance of :data:`KITCHEN` with random proportions.

    Raises:
        MissingExtraError: scene-synthesizer is not installed.
    """
    try:
        from scene_synthesizer import procedural_assets
    except ImportError as error:
        raise MissingExtraError(
            f"procedural {category}: scene-synthesizer is missing; install the extra: {install_command('sim')}"
        ) from error
    model_cat, name, recipe = KITCHEN[category]
    with tempfile.TemporaryDirectory(prefix="quest-") as folder:
        asset = getattr(procedural_assets, name)(**_drawn(recipe, rng, folder))
        return _convert(asset._model.robot, rng, model_cat)


def _drawn(recipe: dict[str, Any], rng: Dice, folder: str) -> dict[str, Any]:
    drawn: dict[str, Any] = {}
    for name, value in recipe.items():
        if callable(value):
            value = value(drawn, rng)
        elif isinstance(value, tuple):
            value = rng.real(*value)
        elif isinstance(value, list | range):
            value = rng.pick(value)
        drawn[name] = _drawn(value, rng, folder) if isinstance(value, dict) else folder if value is _FOLDER else value
    return {name: value for name, value in drawn.items() if not name.startswith("_")}


def _convert(robot: Any, rng: Dice, model_cat: str) -> ObjectModel:
    """A yourdfpy robot whose moving links hang on one root, as our own model; dish racks stay with the body."""
    joints = {joint.child: joint for joint in robot.joints}
    furniture = model_cat == "StorageFurniture"
    own_style = sample_style(rng, knobs=furniture, scale=1.0 if furniture else 2.0)
    use_own = rng.chance(_OWN_HANDLE_SHARE)
    bare = rng.chance(_BARE_SHARE)
    surface = rng.pick(["metal", "dark", "white"], p=[0.55, 0.3, 0.15])
    opening = rng.angle(80, 115)
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
        links.append(Link(tuple(parts), joint.type, (x, y, z), (ax, ay, az), float(upper)))
    model = ObjectModel(model_cat, tuple(_group(body, moving=False)), tuple(links))
    lowest = min(float(part.mesh.bounds[0, 2]) for part in model.body)
    return model.moved((0.0, 0.0, -lowest))


def _pane(panel: Mesh, rng: Dice) -> Mesh:
    """A thin pane on the face of a door, clear of the strip where its handle stands."""
    (x0, y, z0), (x1, _, z1) = panel.bounds
    margin = np.array([0.2 * (x1 - x0), rng.real(0.1, 0.25) * (z1 - z0)])
    return box((x0 + margin[0], y - 0.002, z0 + margin[1]), (x1 - margin[0], y + 0.002, z1 - margin[1]))


def _visual_mesh(visual: Any) -> Mesh:
    """A yourdfpy visual in the frame of its link."""
    import trimesh

    geometry = visual.geometry
    origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin)
    if geometry.box is not None:
        return _transformed(centred_box((0, 0, 0), geometry.box.size), origin)
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
    (width, _, height), (x, _, z) = high - low, (low + high) / 2
    vertical = bool(height > width)
    room = (0.12, 1.4 * height) if vertical else (1.4 * width, 0.12)
    return handle_part(style, at=(x, _surface_y(front, x, z), z), vertical=vertical, room_m=room)


def _surface_y(mesh: Mesh, x: float, z: float) -> float:
    """Smallest y of a surface above the point (x, z) of the front; of its bounding box where there is none."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
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
