"""How an object stands in the world: in metres, closed, on the floor, its front towards +x."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from quest.sim.articulation import Articulation, apply
from quest.sim.urdf import Urdf

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
    "Kettle": ("length", 0.28),
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
# What is deeper than that at its category's height is a small one of its kind, such as a refrigerator under a counter.
_DEPTH_M = {"Refrigerator": (0.9, 0.65)}


def real_scale(articulation: Articulation, category: str) -> float:
    """Metres per unit that give an object the size that things of its category have; a guess for unknown ones.

    It stands as it does in PartNet-Mobility: its front along an axis, z up.
    """
    extent = articulation.extent_m
    dimension, metres = _REAL_SIZE_M.get(category, _DEFAULT_SIZE_M)
    scale = size_scale(articulation, dimension, metres)
    deepest, usual = _DEPTH_M.get(category, (np.inf, np.inf))
    along = abs(np.cos(_front_azimuth(articulation)))
    depth = float(extent[0] if along > 0.5 else extent[1])
    return usual / depth if scale * depth > deepest else scale


def size_scale(articulation: Articulation, dimension: Literal["height", "length"], metres: float) -> float:
    """Metres per unit that make an object's height, or its longest extent, so many metres at rest."""
    extent = articulation.extent_m
    length = float(extent[2] if dimension == "height" else extent.max())
    return metres / max(length, 1e-9)


def closed(articulation: Articulation) -> Articulation:
    """The object with doors that are modelled half open at their limit where it takes less room."""

    def room(trial: Articulation) -> float:
        return float(np.prod(trial.extent_m))

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


def _shifted(pose: Float[np.ndarray, "4 4"], factor: float) -> Float[np.ndarray, "4 4"]:
    """A pose whose place is scaled about the origin."""
    pose = pose.copy()
    pose[:3, 3] *= factor
    return pose


def scaled(articulation: Articulation, scale: float) -> Articulation:
    """An object scaled about the world's origin."""
    parts = []
    for p in articulation.parts:
        sx, sy, sz = (s * scale for s in p.scale)
        pose, surface = _shifted(p.body_from_part, scale), p.surface.copy().apply_scale(scale)
        parts.append(replace(p, body_from_part=pose, scale=(sx, sy, sz), uv_scale=(sx, sy, sz), surface=surface))
    joints = []
    for j in articulation.joints:
        factor = scale if j.joint.kind == "prismatic" else 1.0
        record = replace(j.joint, lower=j.joint.lower * factor, upper=j.joint.upper * factor)
        pose = _shifted(j.parent_from_joint, scale)
        joints.append(replace(j, joint=record, parent_from_joint=pose, rest=j.rest * factor))
    root = _shifted(articulation.world_from_root, scale)
    return replace(articulation, parts=tuple(parts), joints=tuple(joints), world_from_root=root)


def placed(articulation: Articulation, front_rad: float | None = None, *, by_lids: bool = False) -> Articulation:
    """The object standing on the floor around the origin, its front towards +x.

    ``front_rad`` is the azimuth of its front as it stands now; None to find out from its doors and drawers or, with
    ``by_lids``, from the free edges of lids; if these do not tell it is -x, as in PartNet-Mobility.
    """
    yaw = -(_front_azimuth(articulation, by_lids=by_lids) if front_rad is None else front_rad)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    turned = replace(articulation, world_from_root=turn @ articulation.world_from_root)
    points = turned.world_points(turned.rest)
    low, high = points.min(axis=0), points.max(axis=0)
    shift = np.eye(4)
    shift[:3, 3] = [-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]]
    return replace(turned, world_from_root=shift @ turned.world_from_root)


def _front_azimuth(articulation: Articulation, *, by_lids: bool = False) -> float:
    """Where the object's doors and drawers open to, as a multiple of a right angle; PartNet's -x if that is unclear."""
    poses = articulation.poses(articulation.rest)
    lines = articulation.axes(poses)
    lids, total, opened = np.zeros(2), np.zeros(2), 0.0
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
        if joint.joint.kind == "revolute":
            arm = centre - lines[j, :3]
            lids += (arm - (arm @ lines[j, 3:]) * lines[j, 3:])[:2]
    if np.linalg.norm(total) < 0.3 * opened or opened == 0.0:
        if not by_lids or not lids.any():
            return np.pi
        total = lids
    return float(np.round(np.arctan2(total[1], total[0]) / (np.pi / 2)) * (np.pi / 2))


def with_scaled_origins(urdf: Urdf, warnings: list[str]) -> Urdf:
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

    links = {
        name: tuple(replace(v, link_from_visual=_shifted(v.link_from_visual, factor)) for v in vs)
        for name, vs in urdf.links.items()
    }
    joints = []
    for j in urdf.joints:
        travel, pose = factor if j.kind == "prismatic" else 1.0, _shifted(j.parent_from_joint, factor)
        joints.append(replace(j, parent_from_joint=pose, lower=j.lower * travel, upper=j.upper * travel))
    return Urdf(links, tuple(joints))
