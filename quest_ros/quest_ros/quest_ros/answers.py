"""What the tracker answers, as messages: tracks, markers for RViz, and diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from quest.filter.joints import Joint, JointKind
from quest.filter.view import move
from quest.track import StreamState
from quest.types import State

Types = Callable[[str], Any]
"""Gives the class of messages of a name such as ``sensor_msgs/msg/Image``; its fields are keyword arguments."""

_COLOURS = {State.TRACKING: (0.1, 0.8, 0.2), State.HELD: (1.0, 0.7, 0.0), State.LOST: (0.9, 0.1, 0.1)}
_LEAST_ARROW = 5
"""Length of the arrow of a joint's axis, in diameters of the marker, at least."""


class Place(NamedTuple):
    """When and where answers are."""

    stamp_ns: int
    """Time of the picture."""
    frame_id: str
    """Frame of points and joints."""
    frame_from_world: Float[np.ndarray, "4 4"] | None
    """From the world of the tracker to it; None where they are the same."""

    def point(self, point: np.ndarray) -> Float[np.ndarray, "3"]:
        """A point of the world in this frame."""
        point = point.astype(np.float64)
        return point if self.frame_from_world is None else move(self.frame_from_world, point)

    def joint(self, joint: Joint | None) -> Joint | None:
        """A joint of the world in this frame."""
        return joint if joint is None or self.frame_from_world is None else joint.moved(self.frame_from_world)


class Status(NamedTuple):
    """One line of the diagnostics: its level is ``OK``, ``WARN`` or ``ERROR``; values are more to know, by name."""

    name: str
    level: str
    message: str
    values: tuple[tuple[str, str], ...] = ()


def time_of(types: Types, stamp_ns: int) -> Any:
    """A time in nanoseconds as builtin_interfaces/Time."""
    return types("builtin_interfaces/msg/Time")(sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)


def header_of(types: Types, stamp_ns: int, frame_id: str) -> Any:
    """A header."""
    return types("std_msgs/msg/Header")(stamp=time_of(types, stamp_ns), frame_id=frame_id)


def tracks_of(types: Types, state: StreamState, place: Place, *, stream: int, frame: int, dropped: int) -> Any:
    """An answer as quest_msgs/Tracks, with the number of the stream, the picture's index in it, and those left out."""
    return types("quest_msgs/msg/Tracks")(
        header=header_of(types, place.stamp_ns, place.frame_id),
        stream=stream,
        frame=frame,
        dropped=dropped,
        has_depth=bool(state.has_depth),
        flags=list(state.flags),
        tracks=[_track(types, state, k, place) for k in range(len(state.query))],
    )


def _track(types: Types, state: StreamState, k: int, place: Place) -> Any:
    Track, alarm = types("quest_msgs/msg/Track"), state.alarm[k]
    return Track(
        query=int(state.query[k]),
        name=state.names[k],
        label=state.labels[k] or "",
        state=getattr(Track, state.state[k].name),
        visible=bool(state.visible[k]),
        x_px=float(state.uv_px[k, 0]) - 0.5,
        y_px=float(state.uv_px[k, 1]) - 0.5,
        point=_xyz(types, "Point", place.point(state.point_world[k])),
        p_lost=float(state.lost_p[k]),
        confidence=float(state.confidence[k]),
        joint=_joint(types, state.joint[k], float(state.q[k]), place),
        alarm=alarm is not None,
        alarm_reason="" if alarm is None else alarm.reason,
        alarm_stamp=time_of(types, 0 if alarm is None else round(alarm.stamp_s * 1e9)),
        alarm_extrapolated=alarm is not None and bool(alarm.extrapolated),
    )


def _joint(types: Types, joint: Joint | None, q: float, place: Place) -> Any:
    Message, nothing, joint = types("quest_msgs/msg/Joint"), np.full(3, np.nan), place.joint(joint)
    moves = joint is not None and joint.kind is not JointKind.STATIC
    return Message(
        kind=Message.UNKNOWN if joint is None else getattr(Message, joint.kind.name),
        axis=_xyz(types, "Vector3", joint.axis if joint is not None and moves else nothing),
        origin=_xyz(types, "Point", nothing if joint is None else joint.origin),
        coordinate=q,
        lower=float(joint.lower) if joint is not None and moves else np.nan,
        upper=float(joint.upper) if joint is not None and moves else np.nan,
        covariance=np.full(36, np.nan) if joint is None else joint.line_covariance.astype(np.float64).ravel(),
    )


def markers_of(types: Types, state: StreamState, place: Place, size_m: float, gone: Iterable[tuple[str, int]]) -> Any:
    """An answer as visualization_msgs/MarkerArray: a ball, a name and the joint's axis for each point that is known.

    ``size_m`` is the diameter of a ball, ``gone`` are namespaces and numbers of the markers that are shown so far:
    those that are not shown again are deleted.
    """
    Marker, markers = types("visualization_msgs/msg/Marker"), []

    def add(what: str, number: int, kind: int, scale: Sequence[float], colour: Sequence[float], **fields: Any) -> None:
        markers.append(
            Marker(
                header=header_of(types, place.stamp_ns, place.frame_id),
                ns=what,
                id=number,
                type=kind,
                action=Marker.ADD,
                scale=_xyz(types, "Vector3", scale),
                color=types("std_msgs/msg/ColorRGBA")(r=colour[0], g=colour[1], b=colour[2], a=1.0),
                **fields,
            )
        )

    above = np.array([0.0, 0.0, 1.5] if place.frame_from_world is None else [0.0, -1.5, 0.0]) * size_m
    for k, number in enumerate(state.query):
        point = place.point(state.point_world[k])
        if not np.isfinite(point).all():
            continue
        colour, number = _COLOURS[state.state[k]], int(number)
        add("points", number, Marker.SPHERE, (size_m, size_m, size_m), colour, pose=_pose(types, point))
        text = f"{state.names[k]}: {_words(state, k)}"
        pose = _pose(types, point + above)
        add("names", number, Marker.TEXT_VIEW_FACING, (0.0, 0.0, size_m), colour, pose=pose, text=text)
        if (line := _axis(place.joint(state.joint[k]), size_m)) is not None:
            ends, width = [_xyz(types, "Point", end) for end in line], size_m / 4
            pose = _pose(types, np.zeros(3))
            add("joints", number, Marker.ARROW, (width, 2 * width, 0.0), colour, points=ends, pose=pose)
    for what, number in sorted(set(gone) - {(marker.ns, marker.id) for marker in markers}):
        header = header_of(types, place.stamp_ns, place.frame_id)
        markers.append(Marker(header=header, ns=what, id=number, action=Marker.DELETE))
    return types("visualization_msgs/msg/MarkerArray")(markers=markers)


def _axis(joint: Joint | None, size_m: float) -> np.ndarray | None:
    """Ends of the arrow of a joint: along what was seen of the path if it slides, along the axis if it turns."""
    if joint is None or joint.kind is JointKind.STATIC:
        return None
    if joint.kind is JointKind.PRISMATIC:
        low, high = joint.lower, max(joint.upper, joint.lower + _LEAST_ARROW * size_m)
    else:
        high = max(_LEAST_ARROW * size_m, joint.radius) / 2
        low = -high
    return joint.origin + np.array([[low], [high]]) * joint.axis


def diagnostics_of(types: Types, statuses: Sequence[Status], *, stamp_ns: int, node: str, hardware: str) -> Any:
    """Statuses as diagnostic_msgs/DiagnosticArray; the node begins all names, the hardware is the camera's frame."""
    Message, KeyValue = types("diagnostic_msgs/msg/DiagnosticStatus"), types("diagnostic_msgs/msg/KeyValue")
    return types("diagnostic_msgs/msg/DiagnosticArray")(
        header=header_of(types, stamp_ns, ""),
        status=[
            Message(
                level=getattr(Message, status.level),
                name=f"{node}: {status.name}",
                message=status.message,
                hardware_id=hardware,
                values=[KeyValue(key=key, value=value) for key, value in status.values],
            )
            for status in statuses
        ],
    )


def statuses_of(state: StreamState) -> list[Status]:
    """A status for each query: an open alarm is an error; what is held or lost without one is a warning."""
    statuses = []
    for k, number in enumerate(state.query):
        alarm = state.alarm[k]
        level = "ERROR" if alarm is not None else "OK" if state.state[k] is State.TRACKING else "WARN"
        message = _words(state, k) if alarm is None else f"alarm: {alarm.reason}"
        values = [("query", str(number)), ("label", state.labels[k] or ""), ("state", state.state[k].value)]
        values += [("p_lost", f"{state.lost_p[k]:.3f}"), ("confidence", f"{state.confidence[k]:.3f}")]
        statuses.append(Status(state.names[k], level, message, tuple(values)))
    return statuses


def _words(state: StreamState, k: int) -> str:
    """State of a query, with P(lost) where it is known."""
    lost = f", P(lost) {state.lost_p[k]:.2f}" if np.isfinite(state.lost_p[k]) else ""
    return f"{state.state[k].value}{lost}"


def _xyz(types: Types, name: str, values: Sequence[float] | np.ndarray) -> Any:
    x, y, z = (float(value) for value in values)
    return types(f"geometry_msgs/msg/{name}")(x=x, y=y, z=z)


def _pose(types: Types, point: np.ndarray) -> Any:
    turn = types("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0)
    return types("geometry_msgs/msg/Pose")(position=_xyz(types, "Point", point), orientation=turn)
