"""Motion scripts played by physics: joints with mass and friction are driven along them and follow as well as they can.

PhysX gets the object as an articulation with a fixed base. Somebody pulls at every joint that moves: a spring and a
damper between the joint and the script (a PD drive), which lag behind, overshoot, and let a heavy lid sag. A joint that
has not been moved yet is latched where it rests. Links do not touch each other; a joint touches its stops.

What a body weighs is a guess: each of its parts is taken for a box, solid if it is thin, else a shell, of a density
that goes with the object's category. Inertia is that of these boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from quest.errors import InputError, ObjectError
from quest.extras import require
from quest.sim.articulation import Articulation, Part, apply
from quest.sim.motion import FRAMES_PER_S, HOLD_FRAMES
from quest.sim.objects import SimObject

SUBSTEPS = 16
"""Steps of physics per frame: 480 Hz."""

# kg / m^3, of what the moving parts are mostly made of: boards; sheet metal with foam and glass; steel; plastic.
_DENSITY = {
    "StorageFurniture": 650.0,
    "Table": 650.0,
    "Door": 500.0,
    "Box": 300.0,
    "Refrigerator": 400.0,
    "Microwave": 900.0,
    "Oven": 1200.0,
    "Dishwasher": 900.0,
    "WashingMachine": 900.0,
    "Safe": 4000.0,
    "Scissors": 6000.0,
    "Stapler": 3000.0,
    "Eyeglasses": 1200.0,
    "Laptop": 1500.0,
}
_DEFAULT_DENSITY = 800.0
_DENSITY_FACTOR = (0.6, 1.6)
_SHELL_M = 0.02
_LEAST_MASS_KG = 1e-3
_LEAST_EDGE_M = 2e-3
_PULL_HZ = (2.5, 7.0)
_PULL_DAMPING = (0.5, 1.1)
_FRICTION = (0.0, 0.02)
_FRICTION_FULL_AT_PER_S = 0.15  # of the joint's travel
_DRAG_PER_S = (0.2, 3.0)
_FORESIGHT = (0.5, 1.0)
_SUPPORT = (0.7, 1.0)
_LATCH_PER_S = 2000.0
_MOST_SAG = 0.03
_GRAVITY_M_S2 = 9.81
_WITHIN = 1e-6


@dataclass(frozen=True)
class JointFeel:
    """How joints resist, and how firmly they are pulled."""

    pull_hz: Float[np.ndarray, " J"]
    """Natural frequency of the drive with the link that it pulls: stiffness per inertia. The drive is firmer where the
    weight that it holds would draw it more than 3 % of the joint's travel out."""
    pull_damping: Float[np.ndarray, " J"]
    """Damping ratio of the drive; 1 is critical."""
    friction: Float[np.ndarray, " J"]
    """Dry friction: how far the script must be ahead, as a share of the joint's travel, before it gives way."""
    drag_per_s: Float[np.ndarray, " J"]
    """Viscous drag per inertia."""
    foresight: Float[np.ndarray, " J"]
    """Part of the script's velocity that the drive goes along with; without, it only pulls where it lags."""
    support: Float[np.ndarray, " J"]
    """Part of the weight that springs, counterweights or stiff hinges carry; the drive holds the rest."""

    @classmethod
    def drawn(cls, joints: int, rng: np.random.Generator) -> JointFeel:
        """A feel for each of some joints."""
        ranges = (_PULL_HZ, _PULL_DAMPING, _FRICTION, _DRAG_PER_S, _FORESIGHT, _SUPPORT)
        return cls(*(rng.uniform(*r, joints) for r in ranges))


@dataclass(frozen=True)
class Heft:
    """What a body weighs."""

    mass_kg: float
    centre: Float[np.ndarray, "3"]
    """Its centre of mass, in the body's frame."""
    inertia: Float[np.ndarray, "3 3"]
    """About its centre of mass, in the body's axes, kg m^2."""

    @classmethod
    def of(cls, parts: list[Part], density: float) -> Heft:
        """Of parts taken for boxes.

        A part weighs as much as its bounding box, or as a shell of 2 cm of its surface if that is less. A body without
        parts weighs a gram.
        """
        if not parts:
            return cls(_LEAST_MASS_KG, np.zeros(3), _LEAST_MASS_KG * np.eye(3) * _LEAST_EDGE_M**2)
        bounds = np.array([part.surface.bounds for part in parts])
        edges = np.maximum(bounds[:, 1] - bounds[:, 0], _LEAST_EDGE_M)
        shell = np.array([part.surface.area for part in parts]) / 2 * _SHELL_M
        volume = np.minimum(edges.prod(axis=1), np.maximum(shell, _LEAST_EDGE_M**3))
        share, middle = volume / volume.sum(), bounds.mean(axis=1)
        centre = share @ middle
        offset = middle - centre
        spread = np.diag(share @ edges**2 / 12) + np.einsum("n,ni,nj->ij", share, offset, offset)
        mass = max(density * float(volume.sum()), _LEAST_MASS_KG)
        return cls(mass, centre, mass * (np.trace(spread) * np.eye(3) - spread))


def play_physically(
    sim_object: SimObject,
    script: Float[np.ndarray, "S J"],
    rng: np.random.Generator,
    *,
    substeps: int = SUBSTEPS,
) -> Float[np.ndarray, "S J"]:
    """Joint positions, 30 a second, that physics gives when joints are driven along a script.

    The first :data:`quest.sim.motion.HOLD_FRAMES` frames are the script's, and so is every joint until the script moves
    it. Then positions differ from the script's, but stay within the joint's limits (and 110 degrees from rest). PhysX
    itself keeps to them but for rounding in single precision, which is cut off. Masses, friction, and the firmness of
    the pull are drawn from ``rng``; ``substeps`` are steps of physics per frame, at least 8.

    Raises:
        InputError: the script does not fit the object's joints, leaves their limits, or moves in the hold.
        ObjectError: the simulation of this object diverges.
        MissingExtraError: SAPIEN is not installed.
    """
    articulation = sim_object.articulation
    _check(sim_object, script, substeps)
    feel = JointFeel.drawn(len(articulation.joints), rng)
    density = _DENSITY.get(sim_object.category, _DEFAULT_DENSITY) * rng.uniform(*_DENSITY_FACTOR)
    departs = [int(np.argmax(c)) if c.any() else len(script) for c in (script != script[0]).T]
    if min(departs, default=len(script)) == len(script):
        return script.copy()
    bodies = [
        Heft.of([articulation.parts[i] for i in articulation.body_parts(b)], density)
        for b in range(len(articulation.body_names))
    ]
    scene, system = _articulated(articulation, bodies, 1 / (FRAMES_PER_S * substeps))
    played = _drive(scene, system, articulation, bodies, script, np.array(departs), feel, substeps)
    if not np.isfinite(played).all():
        raise ObjectError(
            f"{sim_object.object_id}: expected joints that can be simulated, but their physics diverges; play this "
            "object without physics, or use another"
        )
    low, high = _stops(articulation)
    return np.clip(played, low, high)


def _check(sim_object: SimObject, script: Float[np.ndarray, "S J"], substeps: int) -> None:
    joints = sim_object.articulation.joints
    name = f"{sim_object.object_id}: physics"
    if script.ndim != 2 or script.shape[1] != len(joints) or len(script) == 0 or not np.isfinite(script).all():
        raise InputError(
            f"{name}: expected finite positions of {len(joints)} joints at every frame, got an array of shape "
            f"{script.shape}; make the script for this object"
        )
    if substeps < 8:
        raise InputError(f"{name}: expected at least 8 steps per frame, got {substeps}")
    if (script[:HOLD_FRAMES] != script[0]).any():
        raise InputError(f"{name}: expected a script in which nothing moves in the first {HOLD_FRAMES} frames")
    low, high = _stops(sim_object.articulation)
    out = np.flatnonzero(((script < low - _WITHIN) | (script > high + _WITHIN)).any(axis=0))
    if len(out):
        j = int(out[0])
        raise InputError(
            f"{name}: expected joint {joints[j].joint.name!r} within {low[j]:.3f} and {high[j]:.3f}, got "
            f"{script[:, j].min():.3f} to {script[:, j].max():.3f}; make the script for this object"
        )


def _stops(articulation: Articulation) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " J"]]:
    travel = np.array([j.travel() for j in articulation.joints]).reshape(-1, 2)
    return articulation.rest - travel[:, 0], articulation.rest + travel[:, 1]


def _articulated(articulation: Articulation, bodies: list[Heft], step_s: float) -> tuple[Any, Any]:
    """A scene, and in it the object as an articulation whose links weigh something and touch nothing."""
    sapien = require("sapien")
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(step_s)
    builder = scene.create_articulation_builder()
    builder.set_initial_pose(sapien.Pose(articulation.world_from_root))
    low, high = _stops(articulation)
    links = []
    for body, heft in enumerate(bodies):
        link = builder.create_link_builder(links[articulation.joints[body - 1].parent] if body else None)
        moments, axes = np.linalg.eigh(heft.inertia)
        principal = np.eye(4)
        principal[:3, :3] = axes * np.sign(np.linalg.det(axes))
        principal[:3, 3] = heft.centre
        link.set_mass_and_inertia(heft.mass_kg, sapien.Pose(principal), moments)
        link.set_name(f"body-{body}")
        if body:
            joint = articulation.joints[body - 1]
            frame = _along_x(joint.axis)
            link.set_joint_name(f"joint-{body - 1}")
            link.set_joint_properties(
                "prismatic" if joint.joint.kind == "prismatic" else "revolute_unwrapped",
                [[low[body - 1], high[body - 1]]],
                sapien.Pose(joint.parent_from_joint @ frame),
                sapien.Pose(frame),
            )
        links.append(link)
    return scene, builder.build(fix_root_link=True)


def _along_x(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """A frame whose x axis is ``axis``: what PhysX's joints turn about and slide along."""
    helper = np.eye(3)[int(np.abs(axis).argmin())]
    y = np.cross(axis, helper)
    y /= np.linalg.norm(y)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack((axis, y, np.cross(axis, y)))
    return frame


def _drive(
    scene: Any,
    system: Any,
    articulation: Articulation,
    bodies: list[Heft],
    script: Float[np.ndarray, "S J"],
    departs: np.ndarray,
    feel: JointFeel,
    substeps: int,
) -> Float[np.ndarray, "S J"]:
    """Joint positions at every frame; joint ``j`` is latched before frame ``departs[j]``."""
    by_name = {joint.name: joint for joint in system.active_joints}
    joints = [by_name[f"joint-{j}"] for j in range(len(articulation.joints))]
    # PhysX may order joints otherwise than the object does.
    order = np.array([int(joint.name.removeprefix("joint-")) for joint in system.active_joints])
    travel = np.subtract(*_stops(articulation)[::-1])
    inertia, weight = _inertia_and_weight(articulation, bodies)
    held = (1 - feel.support) * weight / (inertia * _MOST_SAG * np.maximum(travel, 1e-9))
    pull = np.sqrt(np.maximum((2 * np.pi * feel.pull_hz) ** 2, held))
    drive_per_s = 2 * feel.pull_damping * pull
    # PhysX's own drives by acceleration go by what a joint would weigh if its parents hung loose: too soft in chains.
    for joint, moved in zip(joints, inertia, strict=True):
        joint.set_friction(0.0)
        joint.set_drive_properties(float(moved * _LATCH_PER_S**2), float(2 * moved * _LATCH_PER_S))
    # The drive's damping works on the difference to the script's velocity, the drag on the velocity itself.
    ahead = feel.foresight * drive_per_s / (drive_per_s + feel.drag_per_s)
    slowing = feel.friction * travel * pull**2
    # Dry friction sets in over some speed; over less than it takes away in one step, it would ring.
    full_at = np.maximum(np.maximum(_FRICTION_FULL_AT_PER_S * travel, slowing / (FRAMES_PER_S * substeps)), 1e-9)
    curve = PchipInterpolator(np.arange(len(script)), script, axis=0)
    speed = curve.derivative()
    first = int(departs.min()) - 1
    played = script.copy()
    system.set_qpos(script[0][order])
    system.set_qvel(np.zeros(len(joints)))
    for t in range(first, len(script) - 1):
        moments = t + np.arange(1, substeps + 1) / substeps
        targets, velocities = curve(moments), speed(moments) * FRAMES_PER_S * ahead
        latched = departs[order] > t + 1
        for j in np.flatnonzero(departs == t + 1):
            damping = inertia[j] * (drive_per_s[j] + feel.drag_per_s[j])
            joints[j].set_drive_properties(float(inertia[j] * pull[j] ** 2), float(damping))
        for target, velocity in zip(targets, velocities, strict=True):
            for joint, x, v in zip(joints, target.tolist(), velocity.tolist(), strict=True):
                joint.set_drive_target(x)
                joint.set_drive_velocity_target(v)
            friction = (inertia * slowing)[order] * np.tanh(system.get_qvel() / full_at[order])
            system.set_qf(feel.support[order] * system.compute_passive_force(True, False) - friction)
            scene.step()
            if latched.any():
                system.set_qpos(np.where(latched, script[0][order], system.get_qpos()))
                system.set_qvel(np.where(latched, 0.0, system.get_qvel()))
        played[t + 1, order] = np.where(latched, played[t + 1, order], system.get_qpos())
    return played


def _inertia_and_weight(
    articulation: Articulation, bodies: list[Heft]
) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " J"]]:
    """What every joint has to move, with all that hangs on it at rest, and to hold: kg and N, or kg m^2 and N m.

    The weight is the most that it can be in any position of the joint.
    """
    poses = articulation.poses(articulation.rest)
    lines = articulation.axes(poses)
    inertia, weight = np.zeros(len(articulation.joints)), np.zeros(len(articulation.joints))
    for body, heft in enumerate(bodies[1:], start=1):
        centre = apply(poses[body], heft.centre)
        about_centre = poses[body, :3, :3] @ heft.inertia @ poses[body, :3, :3].T
        carrier = body
        while carrier:
            j = carrier - 1
            origin, axis = lines[j, :3], lines[j, 3:]
            if articulation.joints[j].joint.kind == "prismatic":
                inertia[j] += heft.mass_kg
                weight[j] += heft.mass_kg * _GRAVITY_M_S2 * abs(axis[2])
            else:
                arm = np.cross(axis, centre - origin)
                inertia[j] += axis @ about_centre @ axis + heft.mass_kg * arm @ arm
                weight[j] += heft.mass_kg * _GRAVITY_M_S2 * np.linalg.norm(arm) * np.hypot(axis[0], axis[1])
            carrier = articulation.joints[j].parent
    return inertia, weight
