"""How each body moves: its pose, its velocity, and the joint that its poses so far trace out.

A Kalman filter whose state is a small turn about the middle of a body and a shift, and their rates; rates stop by
themselves, and change by a white acceleration. A measured pose comes with its information (:mod:`rigid_motion`). A
joint is the twist along which nearly all poses so far lie: across it a pose is as uncertain as they were.

Reference: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001; Murray, Li
and Sastry, A Mathematical Introduction to Robotic Manipulation, chapter 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from quest.filter.noise import Noise
from quest.filter.view import move


@dataclass(frozen=True)
class Bodies:
    """B bodies; body 0 is the world, which never moves."""

    pose: Float[np.ndarray, "B 4 4"]
    """``world_from_body``: the identity where the body was at rest."""
    middle: Float[np.ndarray, "B 3"]
    """Of the points that told the pose, metres."""
    velocity: Float[np.ndarray, "B 6"]
    """Rotation vector, radians per second, and motion of the middle, metres per second."""
    covariance: Float[np.ndarray, "B 12 12"]
    """Of a rotation vector about the middle, a shift, and :attr:`velocity`."""
    moment: Float[np.ndarray, "B 6 6"]
    """Sum of the products of the twists that the body went through: one large eigenvalue is a joint's screw."""
    seen_s: Float[np.ndarray, " B"]
    """For how long these were gathered, seconds."""
    screw: Float[np.ndarray, "B 6"]
    """That screw, of length 1 in metres at :attr:`Noise.arm_m`; positive where the body went farthest from rest."""
    reach: Float[np.ndarray, "B 2"]
    """How far along it the body has been, least and farthest, metres at :attr:`Noise.arm_m`."""

    @classmethod
    def world(cls) -> Bodies:
        """Nothing but the world."""
        shapes = ((1, 3), (1, 6), (1, 12, 12), (1, 6, 6), (1,), (1, 6), (1, 2))
        return cls(np.eye(4)[None], *(np.zeros(shape) for shape in shapes))

    def __len__(self) -> int:
        return len(self.pose)

    def with_one(self, pose: Float[np.ndarray, "4 4"], middle: Float[np.ndarray, "3"], noise: Noise) -> Bodies:
        """One body more, that began to move."""
        spread = np.array([noise.turn_rad_s] * 3 + [noise.speed_m_s] * 3)
        covariance = np.diag(np.concatenate([np.full(6, 1e-6), spread**2]))
        new = (pose, middle, np.zeros(6), covariance, np.zeros((6, 6)), np.zeros(()), np.zeros(6), np.zeros(2))
        return Bodies(*(np.concatenate([old, one[None]]) for old, one in zip(vars(self).values(), new, strict=True)))


def go_on(bodies: Bodies, dt_s: float, noise: Noise) -> Bodies:
    """Where the bodies are after some time, if nothing is seen."""
    keep = np.exp(-dt_s / noise.stops_s)
    way_s = noise.stops_s * (1 - keep)
    turn = Rotation.from_rotvec(bodies.velocity[:, :3] * way_s).as_matrix()
    middle = bodies.middle + bodies.velocity[:, 3:] * way_s
    pose = bodies.pose.copy()
    pose[:, :3, :3] = turn @ pose[:, :3, :3]
    pose[:, :3, 3] = middle + np.einsum("bij,bj->bi", turn, pose[:, :3, 3] - bodies.middle)
    onward = np.eye(12)
    onward[:6, 6:] = way_s * np.eye(6)
    onward[6:, 6:] *= keep
    power = np.array([noise.turn_rad_s] * 3 + [noise.speed_m_s] * 3) ** 2 * 2 / noise.stops_s
    shape = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    added = np.kron(shape, np.diag(power))
    covariance = onward @ bodies.covariance @ onward.T + added
    covariance[0] = 0
    return replace(bodies, pose=pose, middle=middle, velocity=bodies.velocity * keep, covariance=covariance)


def about(bodies: Bodies, index: int, middle: Float[np.ndarray, "3"]) -> Bodies:
    """The same with a body's motion told about another point."""
    arm = middle - bodies.middle[index]
    change = np.eye(6)
    change[3:, :3] = -_cross(arm)
    both = np.kron(np.eye(2), change)
    new = {name: getattr(bodies, name).copy() for name in ("middle", "velocity", "covariance")}
    new["middle"][index] = middle
    new["velocity"][index] = change @ bodies.velocity[index]
    new["covariance"][index] = both @ bodies.covariance[index] @ both.T
    return replace(bodies, **new)


def update(
    bodies: Bodies,
    index: int,
    pose: Float[np.ndarray, "4 4"],
    information: Float[np.ndarray, "6 6"],
    dt_s: float,
    noise: Noise,
) -> Bodies:
    """Take in a body's most probable pose, to which its prediction was added as a prior.

    Bodies are as predicted, each about the middle of what told the pose. The information is of the frame alone, of a
    turn about the middle and a shift.
    """
    new = {name: value.copy() for name, value in vars(bodies).items()}
    predicted = bodies.covariance[index]
    step = pose @ np.linalg.inv(bodies.pose[index])
    there = move(step, bodies.middle[index])
    innovation = np.concatenate([Rotation.from_matrix(step[:3, :3]).as_rotvec(), there - bodies.middle[index]])
    new["velocity"][index] += predicted[6:, :6] @ np.linalg.solve(predicted[:6, :6], innovation)
    gain = np.linalg.solve(np.eye(6) + information @ predicted[:6, :6], information)
    new["covariance"][index] = predicted - predicted[:, :6] @ gain @ predicted[:6]
    new["pose"][index], new["middle"][index] = pose, there
    way = twist(pose)
    unsure = np.trace(new["covariance"][index][3:6, 3:6]) / noise.joint_m**2
    new["moment"][index] += np.outer(way, way) * dt_s / (1 + unsure)
    new["seen_s"][index] += dt_s / (1 + unsure)
    size = at_arm(noise)
    _, vector = np.linalg.eigh(new["moment"][index] * np.outer(size, size))
    direction = vector[:, -1] * (1 if vector[:, -1] @ bodies.screw[index] >= 0 else -1)
    along = direction @ (way * size)
    least, most = min(along, bodies.reach[index, 0]), max(along, bodies.reach[index, 1])
    new["screw"][index] = direction if most >= -least else -direction
    new["reach"][index] = (least, most) if most >= -least else (-most, -least)
    return replace(bodies, **new)


def at_arm(noise: Noise) -> Float[np.ndarray, "6"]:
    """By which a twist is multiplied so that all of it is in metres."""
    return np.array([noise.arm_m] * 3 + [1.0] * 3)


def on_joint(bodies: Bodies, index: int, noise: Noise) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"]]:
    """A turn about the middle and a shift that bring a body back onto its joint's screw, and their information."""
    size = at_arm(noise)
    value, vector = np.linalg.eigh(bodies.moment[index] * np.outer(size, size))
    if value[-1] <= 0:
        return np.zeros(6), np.zeros((6, 6))
    direction = vector[:, -1] / size
    along = float(vector[:, -1] @ (twist(bodies.pose[index]) * size))
    there = screw(along * direction) @ np.linalg.inv(bodies.pose[index])
    back = np.concatenate(
        [Rotation.from_matrix(there[:3, :3]).as_rotvec(), move(there, bodies.middle[index]) - bodies.middle[index]]
    )
    tangent = np.concatenate([direction[:3], direction[3:] + np.cross(direction[:3], bodies.middle[index])]) * size
    tangent /= np.linalg.norm(tangent)
    # What the twists so far tell of the screw is worth nothing before they are longer than the error of a pose.
    doubt = (value[:-1].sum() + noise.joint_m**2 * noise.stops_s) / value[-1]
    across = noise.joint_m**2 + along**2 * doubt
    hold = (np.eye(6) - np.outer(tangent, tangent)) / across
    return back, hold * np.outer(size, size)


def twist(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    """The logarithm of a rigid motion: rotation vector, radians, and shift, metres."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return np.concatenate([turn, np.linalg.solve(_left(turn), pose[:3, 3])])


def screw(twist: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion of a twist."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    pose[:3, 3] = _left(twist[:3]) @ twist[3:]
    return pose


def _left(turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """By which a screw's shift becomes the motion of the origin."""
    angle, cross = float(np.linalg.norm(turn)), _cross(turn)
    if angle < 1e-6:
        return np.eye(3) + cross / 2
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross


def _cross(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
