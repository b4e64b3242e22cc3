"""Rigid bodies and the joints between them: geometry and forward kinematics, in metres.

Links joined by fixed joints are one body, so that a handle bolted to a door moves as part of that
door. Body 0 is everything that never moves; body ``1 + j`` is what joint ``j`` carries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from quest.sim.urdf import MeshData
from quest.types import Joint

if TYPE_CHECKING:
    import trimesh

MAX_TURN_RAD = np.deg2rad(110)
"""How far a revolute joint is turned from rest at most."""


@dataclass(frozen=True)
class Part:
    """One visual mesh or primitive of a body."""

    name: str
    """Name that tells what it is (``handle-14``, ``drawer_front-31``); empty if unknown."""
    visual: str
    """Name that the URDF gives the visual itself; empty if none."""
    body: int
    body_from_part: Float[np.ndarray, "4 4"]
    """Pose in the body, metres."""
    mesh: Path | MeshData | None
    """Mesh file or mesh, or None for a primitive."""
    scale: tuple[float, float, float]
    """Factors from the mesh's units to metres, per axis."""
    uv_scale: tuple[float, float, float]
    """The same before the object was stretched: for texture coordinates, which takes of one object share."""
    shape: str
    """``mesh``, ``box``, ``cylinder`` or ``sphere``."""
    rgba: tuple[float, float, float, float] | None
    """Colour given by the URDF, or None."""
    surface: trimesh.Trimesh
    """The geometry in the body's frame, metres."""


@dataclass(frozen=True)
class ArticulatedJoint:
    """A moving joint; it carries body ``1 + its index``."""

    joint: Joint
    """Name, kind and limits (radians or metres)."""
    parent: int
    parent_from_joint: Float[np.ndarray, "4 4"]
    """Pose of the joint frame in the parent body, metres."""
    axis: Float[np.ndarray, "3"]
    """Unit direction in the joint frame; the axis passes through its origin."""
    rest: float
    """Closed position: zero, clamped into the limits."""

    def travel(self) -> tuple[float, float]:
        """How far the joint can go below and above its rest position, both >= 0, radians or metres."""
        cap = MAX_TURN_RAD if self.joint.kind == "revolute" else np.inf
        return min(self.rest - self.joint.lower, cap), min(self.joint.upper - self.rest, cap)

    def opening(self) -> float:
        """Signed travel from rest to the limit that is farther away."""
        below, above = self.travel()
        return above if above >= below else -below

    def motion(self, position: Float[np.ndarray, "*T"]) -> Float[np.ndarray, "*T 4 4"]:
        """Displacement of the joint's child at some positions, in the joint frame."""
        matrix = np.tile(np.eye(4), (*position.shape, 1, 1))
        if self.joint.kind == "prismatic":
            matrix[..., :3, 3] = position[..., None] * self.axis
            return matrix
        # Rodrigues' formula.
        x, y, z = self.axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        sin, cos = np.sin(position)[..., None, None], np.cos(position)[..., None, None]
        matrix[..., :3, :3] += sin * cross + (1 - cos) * cross @ cross
        return matrix


@dataclass(frozen=True)
class Articulation:
    """The bodies and joints of one object."""

    body_names: tuple[str, ...]
    """Name per body."""
    parts: tuple[Part, ...]
    """All visuals, of all bodies."""
    joints: tuple[ArticulatedJoint, ...]
    """Moving joints, parents before children; joint ``j`` carries body ``1 + j``."""
    world_from_root: Float[np.ndarray, "4 4"]
    """Where the root body stands in the world (z up, floor at 0, front towards +x)."""

    @property
    def rest(self) -> Float[np.ndarray, " J"]:
        """Position of every joint when closed."""
        return np.array([j.rest for j in self.joints])

    def poses(self, position: Float[np.ndarray, "*T J"]) -> Float[np.ndarray, "*T B 4 4"]:
        """``world_from_body`` of every body at given joint positions."""
        poses = np.empty((*position.shape[:-1], 1 + len(self.joints), 4, 4))
        poses[..., 0, :, :] = self.world_from_root
        for j, joint in enumerate(self.joints):
            parent = poses[..., joint.parent, :, :] @ joint.parent_from_joint
            poses[..., 1 + j, :, :] = parent @ joint.motion(position[..., j])
        return poses

    def axes(self, poses: Float[np.ndarray, "*T B 4 4"]) -> Float[np.ndarray, "*T J 6"]:
        """Origin and unit direction of every joint's axis in the world, given the bodies' poses."""
        lines = np.empty((*poses.shape[:-3], len(self.joints), 6))
        for j, joint in enumerate(self.joints):
            frame = poses[..., joint.parent, :, :] @ joint.parent_from_joint
            lines[..., j, :3], lines[..., j, 3:] = frame[..., :3, 3], frame[..., :3, :3] @ joint.axis
        return lines

    def body_parts(self, body: int) -> list[int]:
        """Indices of the parts of a body."""
        return [i for i, part in enumerate(self.parts) if part.body == body]

    @cached_property
    def body_points(self) -> list[Float[np.ndarray, "N 3"]]:
        """Vertices of every body in its own frame."""
        empty = np.zeros((0, 3))
        return [
            np.concatenate([empty, *(np.asarray(self.parts[i].surface.vertices) for i in self.body_parts(b))])
            for b in range(len(self.body_names))
        ]

    @cached_property
    def body_hulls(self) -> list[Float[np.ndarray, "N 3"]]:
        """A few points of every body, in its own frame, that bound it: corners of its hull, thinned to 200."""
        hulls = []
        for points in self.body_points:
            if len(points) > 8:
                # Extreme points along fixed directions: no hull library fails on flat bodies this way.
                directions = np.random.default_rng(0).normal(size=(200, 3))
                points = points[np.unique((points @ directions.T).argmax(axis=0))]
            hulls.append(points)
        return hulls

    def swept(self, poses: Float[np.ndarray, "T B 4 4"], *, moments: int = 16) -> Float[np.ndarray, "N 3"]:
        """World points that bound the object at some of its poses."""
        some = poses[np.unique(np.linspace(0, len(poses) - 1, moments).astype(int))]
        hulls = enumerate(self.body_hulls)
        return np.concatenate([apply(pose[b], hull) for b, hull in hulls if len(hull) for pose in some])

    @property
    def each_opened(self) -> Float[np.ndarray, "K J"]:
        """Positions of all joints at rest, and with each of them open by itself."""
        return np.stack((self.rest, *(self.rest + np.diag([j.opening() for j in self.joints]))))

    def world_points(self, position: Float[np.ndarray, " J"]) -> Float[np.ndarray, "N 3"]:
        """All vertices in the world at given joint positions."""
        poses = self.poses(position)
        return np.concatenate([apply(pose, points) for pose, points in zip(poses, self.body_points, strict=True)])

    @property
    def extent_m(self) -> Float[np.ndarray, "3"]:
        """Depth, width and height in the world at rest."""
        return np.ptp(self.world_points(self.rest), axis=0)

    def travel_m(self, joint: int, point: Float[np.ndarray, "3"]) -> float:
        """How far a point of a joint's body gets from its place at rest when only that joint moves.

        The point is in the body's frame, metres; joint -1 stands for the base, which never moves.
        """
        if joint < 0:
            return 0.0
        start = apply(self.poses(self.rest)[1 + joint], point)
        travel = 0.0
        for share in (0.25, 0.5, 0.75, 1.0):
            moved = self.rest
            moved[joint] += share * self.joints[joint].opening()
            travel = max(travel, float(np.linalg.norm(apply(self.poses(moved)[1 + joint], point) - start)))
        return travel

    def velocity(self, joint: int, point: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
        """World velocity, per unit of opening, of world points on a joint's body when everything is at rest."""
        line = self.axes(self.poses(self.rest))[joint]
        sign = 1.0 if self.joints[joint].opening() >= 0 else -1.0
        if self.joints[joint].joint.kind == "prismatic":
            return np.broadcast_to(sign * line[3:], point.shape)
        return sign * np.cross(line[3:], point - line[:3])


def apply(matrix: Float[np.ndarray, "4 4"], point: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
    """Points after a rigid or affine transform."""
    return point @ matrix[:3, :3].T + matrix[:3, 3]
