"""What a procedural object is made of: chance, meshes, parts, links and joints; and its URDF, in memory.

Axes while an object is built: x to the right of someone who stands before it, y into the object (the
front looks along -y), z up, the ground at z = 0. Metres and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.random import Generator

from quest.sim.urdf import MeshData, Urdf, UrdfJoint, UrdfVisual, pose_matrix
from quest.types import GRIPS

UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns a solid of revolution, which grows towards -y, so that it grows towards +z."""
FRONT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns what is drawn in the x-y plane and extruded along +z so that it stands upright, extruded towards -y."""
SIDE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Turns what is drawn in the x-y plane and extruded along z so that x becomes y, y becomes z, and z becomes x."""

_UV_UNIT_M = 0.5
_T = TypeVar("_T")


class Dice(Generator):
    """A generator that draws plain numbers; what is drawn in which order is part of what a seed means."""

    def real(self, low: float, high: float) -> float:
        """Evenly from a range."""
        return float(self.uniform(low, high))

    def angle(self, low_deg: float, high_deg: float) -> float:
        """Radians out of a range in degrees."""
        return float(np.deg2rad(self.uniform(low_deg, high_deg)))

    def whole(self, low: int, high: int) -> int:
        """From ``low`` to ``high - 1``."""
        return int(self.integers(low, high))

    def chance(self, share: float) -> bool:
        """True in that share of draws."""
        return bool(self.random() < share)

    def pick(self, options: Sequence[_T], p: Sequence[float] | None = None) -> _T:
        """One of some options, each as likely as ``p`` says."""
        return options[int(self.choice(len(options), p=p))]


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


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh out of several; closed meshes stay closed."""
    assert meshes, "nothing to join"
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
    )


def turn_x(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about the x axis."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """An axis-aligned box between two corners, metres; the grain follows its longest edge."""
    lo, hi = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    assert (hi > lo).all(), f"box: empty between {low} and {high}"
    size = hi - lo
    vertices, normals, uv = [], [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        columns = [u, v] if size[u] >= size[v] else [v, u]
        for side in (0, 1):
            corners = np.empty((4, 3))
            corners[:, axis] = (lo, hi)[side][axis]
            corners[:, u] = np.array([lo[u], hi[u], hi[u], lo[u]])
            corners[:, v] = np.array([lo[v], lo[v], hi[v], hi[v]])
            if side == 0:
                corners = corners[::-1]
            normal = np.zeros(3)
            normal[axis] = 2 * side - 1
            vertices.append(corners)
            normals.append(np.tile(normal, (4, 1)))
            uv.append(corners[:, columns] / _UV_UNIT_M)
    faces = (4 * np.arange(6)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Mesh(np.concatenate(vertices), faces, np.concatenate(normals), np.concatenate(uv))


def centred_box(centre: tuple[float, float, float], size: tuple[float, float, float]) -> Mesh:
    """An axis-aligned box by its centre and edge lengths in metres."""
    c, half = np.asarray(centre, dtype=float), np.asarray(size, dtype=float) / 2
    return box(tuple(c - half), tuple(c + half))


def tube(
    path: Float[np.ndarray, "P 3"], *, radius_m: float, flatness: float = 1.0, sides: int = 10, closed: bool = False
) -> Mesh:
    """A tube of elliptic section along a path in the x-y plane.

    Args:
        path: points along the middle; z must be constant. With ``closed``, the last point joins the first.
        radius_m: half the width of the section along the path's normal in its plane.
        flatness: half the height (along z) over ``radius_m``.
        sides: corners of the section; 4 makes a square bar.
        closed: whether the path is a ring, which needs no caps.
    """
    path = np.asarray(path, dtype=float)
    if closed:
        path = np.concatenate([path, path[:1]])
        tangent = np.roll(path[:-1], -1, axis=0) - np.roll(path[:-1], 1, axis=0)
        tangent = np.concatenate([tangent, tangent[:1]])
    else:
        tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([tangent[:, 1], -tangent[:, 0], np.zeros(len(path))], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    angle = 2 * np.pi * np.arange(sides + 1) / sides + np.pi / sides
    stretch = 1 / np.cos(np.pi / sides) if sides == 4 else 1.0
    cos, sin = np.cos(angle) * stretch, np.sin(angle) * stretch
    offset = radius_m * (cos[None, :, None] * across[:, None] + flatness * sin[None, :, None] * up)
    normal = cos[None, :, None] * across[:, None] + sin[None, :, None] * up / max(flatness, 1e-6)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(length[:, None], radius_m * (angle - angle[0])[None, :]), axis=-1).reshape(-1, 2)
    vertices = (path[:, None] + offset).reshape(-1, 3)
    mesh = Mesh(vertices, _grid_faces(len(path), sides + 1)[:, ::-1], normal.reshape(-1, 3), uv / _UV_UNIT_M)
    if sides == 4:
        mesh = _faceted(mesh)
    if closed:
        return mesh
    first, last = (path[0] + offset[0, :-1])[::-1], path[-1] + offset[-1, :-1]
    return join([mesh, _cap(first, -tangent[0]), _cap(last, tangent[-1])])


def lathe(profile: Float[np.ndarray, "P 2"] | list, *, sides: int = 18) -> Mesh:
    """A solid of revolution about the y axis, standing on y = 0 and growing towards -y.

    The profile is (radius, height) from the foot to the tip; height grows; the radii at the ends may be 0.
    """
    profile = np.asarray(profile, dtype=float)
    if profile[0, 0] > 0:
        profile = np.concatenate([[[0.0, profile[0, 1]]], profile])
    if profile[-1, 0] > 0:
        profile = np.concatenate([profile, [[0.0, profile[-1, 1]]]])
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    radius, height = profile[:, :1], profile[:, 1:]
    corners = np.broadcast_arrays(radius * np.cos(angle), -height, radius * np.sin(angle))
    vertices = np.stack(corners, axis=-1).reshape(-1, 3)
    uv = np.stack(np.broadcast_arrays(angle * 0.02, height), axis=-1).reshape(-1, 2) / _UV_UNIT_M
    faces = _grid_faces(len(profile), sides + 1)
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return _faceted(Mesh(vertices, faces[area > 1e-12], np.zeros_like(vertices), uv))


def prism_between(
    outer: Float[np.ndarray, "P 2"], inner: Float[np.ndarray, "P 2"], low: float, high: float, *, closed: bool = False
) -> Mesh:
    """The solid between two lines in the x-y plane, from z = ``low`` to ``high``: a curved wall, or a frame.

    Args:
        outer: points of one line, metres.
        inner: as many points of the other line, at its left as seen from above.
        low: smallest z.
        high: largest z.
        closed: whether the lines are rings (``outer`` counter-clockwise around ``inner``), without ends.
    """
    if closed:
        outer, inner = np.concatenate([outer, outer[:1]]), np.concatenate([inner, inner[:1]])
    count = len(outer)
    rows = [(outer, low), (inner, low), (inner, high), (outer, high)]
    vertices = np.concatenate([np.column_stack([line, np.full(count, z)]) for line, z in rows])
    faces = []
    for row in range(4):
        a = row * count + np.arange(count - 1)
        b = (row + 1) % 4 * count + np.arange(count - 1)
        faces += [np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)]
    if not closed:
        start, end = count * np.arange(4), count * np.arange(4) + count - 1
        faces += [start[[[0, 2, 1], [0, 3, 2]]], end[[[0, 1, 2], [0, 2, 3]]]]
    mesh = polygon_flat(vertices, np.concatenate(faces))
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    if (np.cross(a, b) * c).sum() < 0:  # the lines run the other way round
        mesh = polygon_flat(vertices, np.concatenate(faces)[:, ::-1])
    return mesh


def polygon_flat(vertices: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "M 3"]) -> Mesh:
    """A mesh from bare triangles: flat shading, texture coordinates by projection along each face's main axis."""
    bare = np.asarray(vertices, dtype=float)
    zeros = np.zeros_like(bare)
    flat = _faceted(Mesh(bare, np.asarray(faces, dtype=np.int64), zeros, zeros[:, :2]))
    main = np.abs(flat.normals).argmax(axis=1)
    size = np.ptp(bare, axis=0)
    uv = np.empty((len(flat.vertices), 2))
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        columns = [u, v] if size[u] >= size[v] else [v, u]
        uv[main == axis] = flat.vertices[main == axis][:, columns] / _UV_UNIT_M
    return replace(flat, uv=uv)


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (row * columns + column).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int64)


def _faceted(mesh: Mesh) -> Mesh:
    """The same triangles with their own corners and flat normals."""
    corner = mesh.vertices[mesh.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    faces = np.arange(3 * len(corner), dtype=np.int64).reshape(-1, 3)
    return Mesh(corner.reshape(-1, 3), faces, np.repeat(normal, 3, axis=0), mesh.uv[mesh.faces].reshape(-1, 2))


def _cap(ring: Float[np.ndarray, "S 3"], normal: Float[np.ndarray, "3"]) -> Mesh:
    """A fan over a convex ring, counter-clockwise about ``normal`` once the ring is put in that order."""
    a, b = ring[1] - ring[0], ring[2] - ring[0]
    if np.dot(np.cross(a, b), normal) < 0:
        ring = ring[::-1]
    index = np.arange(1, len(ring) - 1)
    faces = np.stack([np.zeros_like(index), index, index + 1], axis=1).astype(np.int64)
    return Mesh(ring.copy(), faces, np.tile(normal, (len(ring), 1)), ring[:, [0, 2]] / _UV_UNIT_M)


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
"""Base colours (linear RGB) of each kind of surface."""


@dataclass(frozen=True)
class Link:
    """A moving link and the joint that carries it on the body."""

    parts: tuple[Part, ...]
    """Visuals, in the frame whose origin is ``origin``."""
    kind: Literal["revolute", "prismatic"]
    """How its joint moves."""
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

    def centred(self, width: float, depth: float, lift: float = 0.0) -> ObjectModel:
        """An object built from the origin, its middle above the origin, and lifted."""
        return self.moved((-width / 2, -depth / 2, lift))


def as_urdf(model: ObjectModel) -> Urdf:
    """The model as a URDF would hold it, numbers rounded as in its text: so takes have been made from the beginning.

    The root link ``base`` carries the body by a fixed joint that turns the front from -y to -x, as
    PartNet-Mobility's own base joints do.
    """
    links: dict[str, tuple[UrdfVisual, ...]] = {"base": ()}
    yaw = pose_matrix(np.zeros(3), np.array([0.0, 0.0, -1.5707963267949]))
    joints = [UrdfJoint("body_joint", "fixed", "base", "body", yaw, np.array([1.0, 0.0, 0.0]), 0.0, 0.0)]
    number = 0
    for name, parts in (("body", model.body), *((f"link_{n}", link.parts) for n, link in enumerate(model.links))):
        links[name] = tuple(as_visual(part, number + n) for n, part in enumerate(parts))
        number += len(parts)
    for n, link in enumerate(model.links):
        pose, axis = pose_matrix(_short(link.origin), np.zeros(3)), _short(link.axis)
        axis /= max(float(np.linalg.norm(axis)), 1e-9)
        upper = float(f"{link.upper:.6g}")
        joints.append(UrdfJoint(f"link_{n}_joint", link.kind, "body", f"link_{n}", pose, axis, 0.0, upper))
    return Urdf(links, tuple(joints))


def _short(values: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    return np.array([float(f"{value:.6g}") for value in values])


def as_visual(part: Part, number: int) -> UrdfVisual:
    """A part as a URDF would hold it, called after its role and a number."""
    mesh, corner = part.mesh, part.mesh.faces.ravel()
    uv = _single(mesh.uv, 5)[corner]
    uv[:, 1] = 1 - uv[:, 1]  # images begin at their upper edge
    data = MeshData(
        np.round(mesh.vertices, 6),
        mesh.faces,
        (_single(mesh.vertices, 6)[corner], _single(mesh.normals, 4)[corner], uv),
        SURFACES[part.surface],
        0.88 if part.surface == "metal" else 0.98,
    )
    return UrdfVisual(f"{part.role}-{number}", np.eye(4), data, (1.0, 1.0, 1.0), "mesh", (), None)


def _single(values: Float[np.ndarray, "N D"], decimals: int) -> Float32[np.ndarray, "N D"]:
    """Single precision as readers of mesh files come to it: the whole part plus the decimals."""
    whole, rest = np.divmod(np.rint(np.abs(values) * 10.0**decimals), 10.0**decimals)
    single = whole.astype(np.float32) + (rest * 10.0**-decimals).astype(np.float32)
    return np.copysign(single, values.astype(np.float32))
