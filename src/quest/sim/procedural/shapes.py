"""Meshes of procedural objects: boxes, walls, tubes, solids of revolution and prisms.

Axes are those of :mod:`quest.sim.procedural.model`; lengths are metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

_TURNS = {
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "front": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "side": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}
_UV_UNIT_M = 0.5

Vector = Sequence[float] | np.ndarray
"""Coordinates x, y, z, metres."""


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

    def moved(self, offset: Vector) -> Mesh:
        """The mesh shifted by ``offset`` metres."""
        return replace(self, vertices=self.vertices + np.asarray(offset, dtype=float))

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> Mesh:
        """The mesh turned about the origin by a rotation matrix."""
        return replace(self, vertices=self.vertices @ rotation.T, normals=self.normals @ rotation.T)

    def turned(self, way: Literal["up", "front", "side"]) -> Mesh:
        """The mesh turned by a quarter or two.

        Args:
            way: ``up`` makes a solid of revolution, which grows towards -y, grow towards +z. ``front`` makes what is
                drawn in the x-y plane and extruded along z stand upright, extruded towards -y; ``side`` makes its x
                become y, its y become z, and its z become x.
        """
        return self.rotated(_TURNS[way])

    def tilted(self, angle_rad: float) -> Mesh:
        """The mesh turned about the x axis."""
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        return self.rotated(np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]))

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Smallest and largest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh out of several; closed meshes stay closed."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)])
    vertices, normals, uv = (np.concatenate([getattr(m, key) for m in meshes]) for key in ("vertices", "normals", "uv"))
    return Mesh(vertices, faces, normals, uv)


def copies(mesh: Mesh, offsets: Iterable[Vector]) -> Mesh:
    """The same mesh at several places."""
    return join([mesh.moved(offset) for offset in offsets])


def box(low: Vector, high: Vector) -> Mesh:
    """An axis-aligned box between two corners, metres; the grain follows its longest edge."""
    lo, hi = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    assert (hi > lo).all(), f"box: empty between {low} and {high}"
    vertices, normals, uv = [], [], []
    for axis, side in product(range(3), (0, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corners = np.empty((4, 3))
        corners[:, axis] = (lo, hi)[side][axis]
        corners[:, u] = np.array([lo[u], hi[u], hi[u], lo[u]])
        corners[:, v] = np.array([lo[v], lo[v], hi[v], hi[v]])
        vertices.append(corners if side else corners[::-1])
        normals.append(np.tile(np.where(np.arange(3) == axis, 2.0 * side - 1, 0.0), (4, 1)))
        uv.append(_flat_uv(vertices[-1], axis, hi - lo))
    faces = (4 * np.arange(6)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Mesh(np.concatenate(vertices), faces, np.concatenate(normals), np.concatenate(uv))


def boxes(*corners: tuple[Vector, Vector]) -> Mesh:
    """Several boxes, each between two corners."""
    return join([box(low, high) for low, high in corners])


def centred_box(centre: Vector, size: Vector) -> Mesh:
    """An axis-aligned box by its centre and edge lengths in metres."""
    c, half = np.asarray(centre, dtype=float), np.asarray(size, dtype=float) / 2
    return box(c - half, c + half)


def walls(low: Vector, high: Vector, thick: float | Sequence[float], sides: str) -> Mesh:
    """Slabs along sides of a box, inside it, each as large as those that come earlier leave room for.

    ``sides`` are such as ``-x +x -z``: left, right, bottom; ``thick`` is how thick all of them are, or each, metres.
    """
    corners, slabs = [list(low), list(high)], []
    for side, wall in zip(sides.split(), np.broadcast_to(thick, len(sides.split())), strict=True):
        axis, (slab_low, slab_high) = "xyz".index(side[1]), (list(corner) for corner in corners)
        if side[0] == "-":
            slab_high[axis] = corners[0][axis] = slab_low[axis] + wall
        else:
            slab_low[axis] = corners[1][axis] = slab_high[axis] - wall
        slabs.append(box(slab_low, slab_high))
    return join(slabs)


def tube(
    path: Float[np.ndarray, "P 2"], *, radius_m: float, flatness: float = 1.0, sides: int = 10, closed: bool = False
) -> Mesh:
    """A tube of elliptic section along a path in the x-y plane.

    Args:
        path: points along the middle. With ``closed``, the last point joins the first, and there are no caps.
        radius_m: half the width of the section along the path's normal in its plane.
        flatness: half the height (along z) over ``radius_m``.
        sides: corners of the section; 4 makes a square bar.
        closed: whether the path is a ring.
    """
    path = np.column_stack([path, np.zeros(len(path))])
    if closed:
        tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
        path, tangent = (np.concatenate([each, each[:1]]) for each in (path, tangent))
    else:
        tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([tangent[:, 1], -tangent[:, 0], np.zeros(len(path))], axis=1)[:, None]
    up = np.array([0.0, 0.0, 1.0])
    angle = 2 * np.pi * np.arange(sides + 1) / sides + np.pi / sides
    stretch = 1 / np.cos(np.pi / sides) if sides == 4 else 1.0
    cos, sin = ((f(angle) * stretch)[None, :, None] for f in (np.cos, np.sin))
    offset = radius_m * (cos * across + flatness * sin * up)
    normal = cos * across + sin * up / max(flatness, 1e-6)
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


def lathe(profile: Float[np.ndarray, "P 2"] | Sequence[Sequence[float]], *, sides: int = 18) -> Mesh:
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
    flat = _faceted(Mesh(vertices, faces.astype(np.int64), np.zeros_like(vertices), np.zeros((len(vertices), 2))))
    main = np.abs(flat.normals).argmax(axis=1)
    for axis in range(3):
        flat.uv[main == axis] = _flat_uv(flat.vertices[main == axis], axis, np.ptp(vertices, axis=0))
    return flat


def _flat_uv(points: Float[np.ndarray, "N 3"], axis: int, size: Float[np.ndarray, "3"]) -> Float[np.ndarray, "N 2"]:
    """Texture coordinates along the two other axes, the one along which something is larger first."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    return points[:, [u, v] if size[u] >= size[v] else [v, u]] / _UV_UNIT_M


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
    if np.dot(np.cross(ring[1] - ring[0], ring[2] - ring[0]), normal) < 0:
        ring = ring[::-1]
    index = np.arange(1, len(ring) - 1)
    faces = np.stack([np.zeros_like(index), index, index + 1], axis=1).astype(np.int64)
    return Mesh(ring.copy(), faces, np.tile(normal, (len(ring), 1)), ring[:, [0, 2]] / _UV_UNIT_M)
