"""What a procedural object is made of before it is written: meshes, parts, links and joints.

Axes while an object is built: x to the right of someone who stands before it, y into the object (the
front looks along -y), z up, the ground at z = 0. Metres and radians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh whose vertices are not shared across sharp edges.

    Attributes:
        vertices: positions in metres.
        faces: vertex indices, counter-clockwise seen from outside.
        normals: unit normal per vertex.
        uv: texture coordinate per vertex; one unit is half a metre, u runs along the grain.
    """

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "M 3"]
    normals: Float[np.ndarray, "N 3"]
    uv: Float[np.ndarray, "N 2"]

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


def join(meshes: list[Mesh]) -> Mesh:
    """One mesh out of several; closed meshes stay closed."""
    assert meshes, "nothing to join"
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
    )


HANDLE_ROLES = ("handle", "knob")
"""Roles of parts that one takes hold of."""


@dataclass(frozen=True)
class Part:
    """One visual of a link.

    Attributes:
        role: what it is (``handle``, ``knob``, ``drawer_front``, ``frame`` ...); its visual is called ``role-N``.
        mesh: geometry in the frame of its link.
        surface: which material of :data:`SURFACES` it wears before any appearance is drawn.
    """

    role: str
    mesh: Mesh
    surface: str = "body"


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
"""Base colours (linear RGB) that the written ``.mtl`` gives to each kind of surface."""


@dataclass(frozen=True)
class Link:
    """A moving link and the joint that carries it on the body.

    Attributes:
        name: name of the link; its joint is called ``<name>_joint``.
        parts: visuals, in the frame whose origin is ``origin``.
        kind: ``revolute`` or ``prismatic``.
        origin: joint origin in the object's frame, metres.
        axis: unit direction of the joint in the object's frame.
        upper: upper limit in radians or metres; the lower one is 0, which is closed.
    """

    name: str
    parts: tuple[Part, ...]
    kind: Literal["revolute", "prismatic"]
    origin: tuple[float, float, float]
    axis: tuple[float, float, float]
    upper: float

    @property
    def has_handle(self) -> bool:
        """Whether a handle or a knob is among the parts."""
        return any(part.role in HANDLE_ROLES for part in self.parts)


@dataclass(frozen=True)
class ObjectModel:
    """A whole object: a resting body and the links that move on it.

    Attributes:
        model_cat: category in PartNet-Mobility's words, such as ``StorageFurniture``.
        body: visuals that do not move, in the object's frame.
        links: moving links, each a child of the body.
    """

    model_cat: str
    body: tuple[Part, ...]
    links: tuple[Link, ...]

    def moved(self, offset: tuple[float, float, float]) -> ObjectModel:
        """The whole object shifted by ``offset`` metres."""
        body = tuple(replace(part, mesh=part.mesh.moved(offset)) for part in self.body)
        links = []
        for link in self.links:
            x, y, z = np.asarray(link.origin) + np.asarray(offset)
            links.append(replace(link, origin=(float(x), float(y), float(z))))
        return ObjectModel(self.model_cat, body, tuple(links))
