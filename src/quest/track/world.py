"""What a stream knows in its reference frame, told in the world."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32

from quest.geometry import invert, transform
from quest.grounding import Joint, JointKind
from quest.model.framing import Reference
from quest.track.following import Following
from quest.track.placing import as_array


def to_world(point: Float[np.ndarray, "K 3"], reference: Reference) -> Float32[np.ndarray, "K 3"]:
    """Points in metres.

    Args:
        point: in the reference frame.
        reference: the reference frame.
    """
    metric = torch.from_numpy(point) * reference.scale.cpu().double() + reference.center.cpu().double()
    return transform(invert(reference.cam_from_world)[None], metric).numpy().astype(np.float32)


def world_joint(joint: Joint | None, reference: Reference | None) -> Joint | None:
    """A joint in metres; None without one, or without the depth that tells how large it is.

    Args:
        joint: in the reference frame.
        reference: the reference frame; None before the first frame.
    """
    if joint is None or reference is None or not reference.has_depth:
        return None
    world_from_cam = np.linalg.inv(reference.cam_from_world.numpy())
    rotation = world_from_cam[:3, :3]
    translation = rotation @ as_array(reference.center[0]) + world_from_cam[:3, 3]
    return joint.transformed(rotation, translation, float(reference.scale[0]))


def along_joint(query: Following, joint: Joint | None, reference: Reference | None) -> float:
    """Where on its joint a query is, by the network's own point, from which the joint was learned.

    Args:
        query: the query.
        joint: its joint, in the world.
        reference: the reference frame; None before the first frame.

    Returns:
        Radians or metres; NaN without a joint that moves, and where the answer has no point.
    """
    answered = query.answer is not None and np.isfinite(query.answer.point_world).all()
    if joint is None or reference is None or joint.kind is JointKind.STATIC or query.place is None or not answered:
        return float("nan")
    return float(joint.locate(to_world(query.place[None], reference).astype(np.float64))[0])
