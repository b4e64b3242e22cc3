"""The joints of tracks as lines in the world: the axis, and the path over the range that was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from quest.filter.joints import JointKind
from quest.track.state import StreamState
from quest.types import Tracks

_PIECES = 48
_AXIS_SHARE = 0.6
_SHORTEST_AXIS_M = 0.05


@dataclass(frozen=True)
class JointLines:
    """Where a joint can bring an entity, metres in the world."""

    path: Float[np.ndarray, "N 3"]
    """From the smallest to the largest coordinate that was seen."""
    axis: Float[np.ndarray, "2 3"] | None
    """Ends of a piece of the axis of turning, level with the path; None for sliding, where the path says it."""
    arms: tuple[Float[np.ndarray, "2 3"], ...] = ()
    """From the axis to both ends of the path; empty for sliding."""


def joint_lines(tracks: Tracks) -> tuple[JointLines | None, ...]:
    """The lines of each query's joint through the query's own points; None where it does not move or is not known."""
    return tuple(_lines_of(tracks, k) for k in range(len(tracks.names)))


def _lines_of(tracks: Tracks, k: int) -> JointLines | None:
    joints = tracks.joints
    if joints is None or joints.kind[k] not in ("prismatic", "revolute"):
        return None
    point, q = tracks.point_world[:, k].astype(np.float64), joints.q[:, k].astype(np.float64)
    known = np.isfinite(point).all(axis=1) & np.isfinite(q)
    known = known & tracks.visible[:, k] if (known & tracks.visible[:, k]).any() else known
    if not known.any():
        return None
    axis, origin = joints.axis[k].astype(np.float64), joints.origin[k].astype(np.float64)
    seen = float(joints.q_min_seen[k]), float(joints.q_max_seen[k])
    return _through(point[known], q[known], joints.kind[k], axis, origin, seen)


def state_lines(state: StreamState) -> tuple[JointLines | None, ...]:
    """The same of the joints that a stream knows in a frame, through each query's point there."""
    return tuple(
        None
        if joint is None or joint.kind is JointKind.STATIC or not np.isfinite([*point, q]).all()
        else _through(
            point[None].astype(np.float64),
            np.array([q], np.float64),
            joint.kind.value,
            joint.axis,
            joint.origin,
            (joint.lower, joint.upper),
        )
        for joint, point, q in zip(state.joint, state.point_world, state.q, strict=True)
    )


def _through(
    point: Float[np.ndarray, "T 3"],
    q: Float[np.ndarray, " T"],
    kind: str,
    axis: Float[np.ndarray, "3"],
    origin: Float[np.ndarray, "3"],
    seen: tuple[float, float],
) -> JointLines:
    """The lines of a joint through points that are where it is at ``q``."""
    along = np.linspace(*seen, _PIECES)
    if kind == "prismatic":
        return JointLines(np.median(point - q[:, None] * axis, axis=0) + along[:, None] * axis, None)
    height = (point - origin) @ axis
    flat = point - origin - height[:, None] * axis
    # Where the entity is at q = 0: every point, turned back.
    back = np.cos(q)[:, None] * flat - np.sin(q)[:, None] * np.cross(axis, flat)
    start, centre = np.median(back, axis=0), origin + np.median(height) * axis
    path = centre + np.cos(along)[:, None] * start + np.sin(along)[:, None] * np.cross(axis, start)
    half = max(_AXIS_SHARE * float(np.linalg.norm(start)), _SHORTEST_AXIS_M) * axis
    arms = tuple(np.stack((centre, path[end])) for end in (0, -1))
    return JointLines(path, np.stack((centre - half, centre + half)), arms)
