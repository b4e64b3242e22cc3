"""Closed meshes with texture coordinates: boxes, tubes along a path, solids of revolution."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from quest.sim.procedural.model import Mesh, join

_UV_UNIT_M = 0.5


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """An axis-aligned box between two corners; the grain follows its longest edge.

    Args:
        low: smallest corner, metres.
        high: largest corner, metres.
    """
    lo, hi = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    assert (hi > lo).all(), f"box: empty between {low} and {high}"
    size = hi - lo
    vertices, faces, normals, uv = [], [], [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            corners = np.empty((4, 3))
            corners[:, axis] = (lo, hi)[side][axis]
            corners[:, u] = np.array([lo[u], hi[u], hi[u], lo[u]])
            corners[:, v] = np.array([lo[v], lo[v], hi[v], hi[v]])
            if side == 0:
                corners = corners[::-1]
            normal = np.zeros(3)
            normal[axis] = 2 * side - 1
            along, across = (u, v) if size[u] >= size[v] else (v, u)
            start = 4 * len(faces)
            vertices.append(corners)
            faces.append([[start, start + 1, start + 2], [start, start + 2, start + 3]])
            normals.append(np.tile(normal, (4, 1)))
            uv.append(corners[:, [along, across]] / _UV_UNIT_M)
    return Mesh(
        np.concatenate(vertices), np.concatenate(faces).astype(np.int64), np.concatenate(normals), np.concatenate(uv)
    )


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
    rings, around = len(path), sides + 1
    uv = np.stack(np.broadcast_arrays(length[:, None], radius_m * (angle - angle[0])[None, :]), axis=-1).reshape(-1, 2)
    vertices = (path[:, None] + offset).reshape(-1, 3)
    faces = _grid_faces(rings, around)[:, ::-1]
    mesh = Mesh(vertices, faces, normal.reshape(-1, 3), uv / _UV_UNIT_M)
    if sides == 4:
        mesh = _faceted(mesh)
    if closed:
        return mesh
    caps = [
        _cap((path[0] + offset[0, :-1])[::-1], -tangent[0]),
        _cap(path[-1] + offset[-1, :-1], tangent[-1]),
    ]
    return join([mesh, *caps])


def lathe(profile: Float[np.ndarray, "P 2"], *, sides: int = 18) -> Mesh:
    """A solid of revolution about the y axis, standing on y = 0 and growing towards -y.

    Args:
        profile: (radius, height) from the foot to the tip; height grows; the radii at the ends may be 0.
        sides: corners of the circle.
    """
    profile = np.asarray(profile, dtype=float)
    if profile[0, 0] > 0:
        profile = np.concatenate([[[0.0, profile[0, 1]]], profile])
    if profile[-1, 0] > 0:
        profile = np.concatenate([profile, [[0.0, profile[-1, 1]]]])
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    radius, height = profile[:, :1], profile[:, 1:]
    vertices = np.stack(np.broadcast_arrays(radius * np.cos(angle), -height, radius * np.sin(angle)), axis=-1).reshape(
        -1, 3
    )
    uv = np.stack(np.broadcast_arrays(angle * 0.02, height), axis=-1).reshape(-1, 2) / _UV_UNIT_M
    faces = _grid_faces(len(profile), sides + 1)
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    mesh = Mesh(vertices, faces[area > 1e-12], np.zeros_like(vertices), uv)
    return _faceted(mesh)


UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns a solid of revolution, which grows towards -y, so that it grows towards +z."""


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


def polygon_flat(mesh_vertices: Float[np.ndarray, "N 3"], mesh_faces: np.ndarray) -> Mesh:
    """A mesh from bare triangles: flat shading, texture coordinates by projection along each face's main axis."""
    bare = np.asarray(mesh_vertices, dtype=float)
    mesh = Mesh(bare, np.asarray(mesh_faces, dtype=np.int64), np.zeros_like(bare), np.zeros((len(bare), 2)))
    flat = _faceted(mesh)
    main = np.abs(flat.normals).argmax(axis=1)
    size = np.ptp(bare, axis=0)
    uv = np.empty((len(flat.vertices), 2))
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        along, across = (u, v) if size[u] >= size[v] else (v, u)
        uv[main == axis] = flat.vertices[main == axis][:, [along, across]] / _UV_UNIT_M
    return Mesh(flat.vertices, flat.faces, flat.normals, uv)


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
    return Mesh(
        corner.reshape(-1, 3),
        np.arange(3 * len(corner), dtype=np.int64).reshape(-1, 3),
        np.repeat(normal, 3, axis=0),
        mesh.uv[mesh.faces].reshape(-1, 2),
    )


def _cap(ring: Float[np.ndarray, "S 3"], normal: Float[np.ndarray, "3"]) -> Mesh:
    """A fan over a convex ring, counter-clockwise about ``normal`` once the ring is put in that order."""
    a, b = ring[1] - ring[0], ring[2] - ring[0]
    if np.dot(np.cross(a, b), normal) < 0:
        ring = ring[::-1]
    index = np.arange(1, len(ring) - 1)
    faces = np.stack([np.zeros_like(index), index, index + 1], axis=1).astype(np.int64)
    return Mesh(ring.copy(), faces, np.tile(normal, (len(ring), 1)), ring[:, [0, 2]] / _UV_UNIT_M)
