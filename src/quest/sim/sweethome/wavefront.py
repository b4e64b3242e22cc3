"""Wavefront files by group and material, so that a door can leave its cabinet: what other readers do not keep."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

_MOST = 3_000_000
"""Corners of faces, or vertices."""
_FARTHEST = 1e9


@dataclass(frozen=True)
class Wavefront:
    """Polygons of a Wavefront file; face ``i`` has the corners from ``starts[i]`` to ``starts[i + 1]``."""

    vertices: Float[np.ndarray, "N 3"]
    uv: Float[np.ndarray, "U 2"]
    normals: Float[np.ndarray, "K 3"]
    corners: Int[np.ndarray, "C 3"]
    """Vertex, texture coordinate and normal of every corner; -1 is none."""
    starts: Int[np.ndarray, " S"]
    group: Int[np.ndarray, " F"]
    material: Int[np.ndarray, " F"]
    groups: tuple[str, ...]
    """Names that ``group`` counts."""
    materials: tuple[str, ...]
    """Names that ``material`` counts."""
    libraries: tuple[str, ...]
    """Names of the material files."""

    @cached_property
    def face_of_corner(self) -> Int[np.ndarray, " C"]:
        """The face that each corner belongs to."""
        return np.repeat(np.arange(len(self.group)), np.diff(self.starts))

    @cached_property
    def pieces(self) -> tuple[Int[np.ndarray, " F"], Float[np.ndarray, "P 2 3"]]:
        """Which connected piece of its group each face belongs to, and the lower and upper corner of each piece.

        Vertices at one place are one.
        """
        grid = np.round(self.vertices / max(float(np.ptp(self.vertices, axis=0).max()), 1e-9) * 1e5).astype(np.int64)
        place = np.unique(grid, axis=0, return_inverse=True)[1].reshape(-1)[self.corners[:, 0]]
        node = np.unique(place * len(self.groups) + self.group[self.face_of_corner], return_inverse=True)[1].reshape(-1)
        first = node[self.starts[:-1]][self.face_of_corner]
        edges = coo_matrix((np.ones(len(node), dtype=bool), (first, node)), shape=(node.max() + 1,) * 2)
        count, of_node = connected_components(edges, directed=False)
        of_corner = of_node[node]
        points, bounds = self.vertices[self.corners[:, 0]], np.empty((count, 2, 3))
        bounds[:, 0], bounds[:, 1] = np.inf, -np.inf
        np.minimum.at(bounds[:, 0], of_corner, points)
        np.maximum.at(bounds[:, 1], of_corner, points)
        return of_corner[self.starts[:-1]], bounds

    def points(self, faces: Bool[np.ndarray, " F"]) -> Float[np.ndarray, "M 3"]:
        """Vertices of some faces."""
        return self.vertices[np.unique(self.corners[faces[self.face_of_corner], 0])]

    def text(self, faces: Bool[np.ndarray, " F"], library: str, material_names: Sequence[str]) -> str:
        """Some faces as a Wavefront file of their own, with its materials in ``library``."""
        corners = self.corners[faces[self.face_of_corner]]
        lines, columns = [f"mtllib {library}"], []
        for column, (word, values) in enumerate((("v", self.vertices), ("vt", self.uv), ("vn", self.normals))):
            used = np.unique(corners[:, column])
            used = used[used >= 0]
            lines += [f"{word} {' '.join(f'{x:.6g}' for x in row)}" for row in values[used].tolist()]
            columns.append(np.where(corners[:, column] < 0, 0, np.searchsorted(used, corners[:, column]) + 1).tolist())
        words = [f"{v}/{t or ''}/{n or ''}".rstrip("/") for v, t, n in zip(*columns, strict=True)]
        at, last = 0, -1
        for face in np.flatnonzero(faces):
            if self.material[face] != last:
                last = self.material[face]
                lines.append(f"usemtl {material_names[last]}")
            size = int(self.starts[face + 1] - self.starts[face])
            lines.append("f " + " ".join(words[at : at + size]))
            at += size
        return "\n".join(lines) + "\n"


def read_wavefront(text: str) -> Wavefront:
    """Vertices, faces, groups and materials of a Wavefront file; lines and curves are left out.

    Raises:
        ValueError: a number is none, an index leads nowhere, or it has no face or too many.
    """
    values: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": []}
    corners: list[tuple[int, int, int]] = []
    starts, group, material, libraries = [0], [], [], []
    groups, materials = {"": 0}, {"": 0}
    current_group = current_material = 0
    for line in text.replace("\\\n", " ").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word in values:
            values[word].append(rest.split()[: 2 if word == "vt" else 3])
        elif word == "f":
            size = [len(values[key]) for key in ("v", "vt", "vn")]
            found = [_corner(each, size) for each in rest.split()]
            if len(found) > 2:
                corners += found
                starts.append(len(corners))
                group.append(current_group)
                material.append(current_material)
        elif word in ("g", "o"):
            current_group = groups.setdefault(rest.strip(), len(groups))
        elif word == "usemtl":
            current_material = materials.setdefault(rest.strip(), len(materials))
        elif word == "mtllib":
            libraries.append(rest.strip())
        if len(corners) > _MOST or any(len(rows) > _MOST for rows in values.values()):
            raise ValueError(f"it has more than {_MOST} vertices or corners of faces")
    if not group:
        raise ValueError("it has no face")
    v, vt, vn = (_array(rows, 2 if key == "vt" else 3) for key, rows in values.items())
    if not (np.abs(v) < _FARTHEST).all():
        raise ValueError("a vertex is no three finite numbers")
    vt, vn = np.nan_to_num(vt), np.nan_to_num(vn)
    return Wavefront(
        v, vt, vn, np.array(corners), np.array(starts), np.array(group), np.array(material),
        tuple(groups), tuple(materials), tuple(libraries),
    )  # fmt: skip


def _array(rows: Iterable[list[str]], width: int) -> Float[np.ndarray, "N W"]:
    return np.array([[float(word) for word in row] for row in rows]).reshape(-1, width)


def _corner(word: str, size: Sequence[int]) -> tuple[int, int, int]:
    indices = [int(i) if i else 0 for i in word.split("/")[:3]]
    found = [i - 1 if i > 0 else i + n if i < 0 else -1 for i, n in zip([*indices, 0, 0][:3], size, strict=True)]
    v, vt, vn = (i if 0 <= i < n else -1 for i, n in zip(found, size, strict=True))
    if v < 0:
        raise ValueError(f"a face names corner {word!r} of {size[0]} vertices")
    return v, vt, vn


def read_materials(text: str) -> dict[str, dict[str, str]]:
    """What a material file says of each material, word by word."""
    found: dict[str, dict[str, str]] = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "newmtl":
            current = found.setdefault(rest.strip(), {})
        elif word:
            current[word] = rest.strip()
    return found
