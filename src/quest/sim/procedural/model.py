"""What a procedural object is made of: chance, parts, links and joints; and its URDF, in memory.

Axes while an object is built: x to the right of someone who stands before it, y into the object (the
front looks along -y), z up, the ground at z = 0. Metres and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Float, Float32
from numpy.random import Generator

from quest.sim.procedural.shapes import Mesh
from quest.sim.urdf import MeshData, Urdf, UrdfJoint, UrdfVisual, pose_matrix
from quest.types import GRIPS

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
    def grips(self) -> tuple[Part, ...]:
        """Its handles and knobs."""
        return tuple(part for part in self.parts if part.role in GRIPS)

    @property
    def rest(self) -> tuple[Part, ...]:
        """All else."""
        return tuple(part for part in self.parts if part.role not in GRIPS)


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
        x, y, z = offset
        links = (replace(k, origin=(k.origin[0] + x, k.origin[1] + y, k.origin[2] + z)) for k in self.links)
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
