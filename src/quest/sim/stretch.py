"""Objects stretched along their depth, width and height: more shapes than there are models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from quest.errors import ObjectError
from quest.sim.articulation import ArticulatedJoint, Articulation, Part
from quest.sim.objects import SimObject


def draw_stretch(rng: np.random.Generator, most: float) -> Float[np.ndarray, "3"]:
    """Random factors of depth, width and height that leave an object about as large as it is.

    Each is drawn from one ``most``-th to ``most``, evenly in its logarithm, before their product is made 1.
    """
    logs = rng.uniform(-np.log(most), np.log(most), size=3)
    return np.exp(logs - logs.mean())


def stretched(sim_object: SimObject, factors: Float[np.ndarray, "3"]) -> SimObject:
    """An object that is stretched while closed, about the world's origin, and then moves rigidly as before.

    Entities, limits of slides and axes go with it; limits of turns stay. A part whose mesh lies askew is drawn in
    its plain colour, as a scale along its own axes cannot stretch it.

    The factors are those of world x, y, z.

    Raises:
        ObjectError: a joint turns about an oblique axis and is not at zero when closed, so that stretching would turn
            what it carries.
    """
    before = sim_object.articulation
    poses = before.poses(before.rest)
    rotation = poses[:, :3, :3]
    stretch = rotation.swapaxes(1, 2) @ (factors[:, None] * rotation)  # in the axes of each body
    root = before.world_from_root.copy()
    root[:3, 3] *= factors
    parts = tuple(_part(part, stretch[part.body]) for part in before.parts)
    joints = tuple(_joint(joint, poses[joint.parent], factors, sim_object.object_id) for joint in before.joints)
    after = Articulation(before.body_names, parts, joints, root)
    points = [stretch[e.body] @ e.point for e in sim_object.entities]
    entities = tuple(
        replace(e, point=point, travel_m=after.travel_m(e.joint, point))
        for e, point in zip(sim_object.entities, points, strict=True)
    )
    half_diagonal_m = float(np.linalg.norm(after.extent_m)) / 2
    return replace(sim_object, articulation=after, entities=entities, half_diagonal_m=half_diagonal_m)


def _part(part: Part, stretch: Float[np.ndarray, "3 3"]) -> Part:
    """A part after its body was stretched."""
    body_from_part, matrix = part.body_from_part.copy(), np.eye(4)
    body_from_part[:3, 3] = stretch @ body_from_part[:3, 3]
    matrix[:3, :3] = stretch
    along = body_from_part[:3, :3].T @ stretch @ body_from_part[:3, :3]
    askew = not np.allclose(along, np.diag(np.diag(along)), atol=1e-6)
    sx, sy, sz = np.diag(along) * part.scale
    return replace(
        part,
        body_from_part=body_from_part,
        mesh=None if askew else part.mesh,
        scale=(float(sx), float(sy), float(sz)),
        surface=part.surface.copy().apply_transform(matrix),
    )


def _joint(
    joint: ArticulatedJoint, world_from_parent: Float[np.ndarray, "4 4"], factors: Float[np.ndarray, "3"], of: str
) -> ArticulatedJoint:
    """A joint of an object called ``of``, between bodies that stand where stretching put them."""
    world_from_joint = world_from_parent @ joint.parent_from_joint
    axis = world_from_joint[:3, :3].T @ (factors * (world_from_joint[:3, :3] @ joint.axis))
    length = float(np.linalg.norm(axis))
    record, rest = joint.joint, joint.rest
    if record.kind == "prismatic":
        record, rest = replace(record, lower=record.lower * length, upper=record.upper * length), rest * length
    elif rest != 0 and not np.allclose(axis / length, joint.axis, atol=1e-6):
        raise ObjectError(
            f"object {of}: joint {record.name} turns about an oblique axis and is at {rest:.3g} rad when closed; "
            "it cannot be stretched, make it without --stretch"
        )
    parent_from_joint = joint.parent_from_joint.copy()
    between = factors * (world_from_joint[:3, 3] - world_from_parent[:3, 3])
    parent_from_joint[:3, 3] = world_from_parent[:3, :3].T @ between
    return replace(joint, joint=record, rest=rest, axis=axis / length, parent_from_joint=parent_from_joint)
