"""What happens in a clip, in words: every sentence, and every cell of the table, is computed from its tracks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Shaped

from quest.types import State, Tracks
from quest.viz.palette import RGB, query_colour

LEAST_OCCLUSION_S = 0.2
"""Shorter times out of sight are not told."""
UNKNOWN = "unknown"
_STILL = 0.05
"""A movement lasts while less than this share of its way is missing at either end."""


@dataclass(frozen=True)
class AlarmSpan:
    """An alarm from its opening to its end."""

    query: int
    """Index of the query."""
    first: int
    """Frame in which it opened."""
    last: int
    """Last frame in which it was open."""
    lost_p: float
    """Largest P(lost) meanwhile; NaN where unknown."""


@dataclass(frozen=True)
class Line:
    """A query in the table of all; words, because that is how they are shown."""

    name: str
    """Of the query."""
    colour: RGB
    """In every picture."""
    label: str
    """Empty where it has none."""
    seen: str = ""
    """Share of frames from the first answer on."""
    moved: str = ""
    """Farthest distance from where it was first, metres."""
    joint: str = ""
    """Kind and range."""
    lost_p: str = ""
    """Largest P(lost)."""
    alarms: str = ""
    """How many were raised."""
    end: str = "not found"
    """State at the end."""


def spans(values: Shaped[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """First index, and index after the last, of every run of equal values, without those of 0 or False."""
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return [(first, end) for first, end in pairwise(edges) if end > first and values[first]]


def alarm_spans(tracks: Tracks) -> list[AlarmSpan]:
    """All alarms in the order of their opening."""
    alarm, lost_p = tracks.alarm, tracks.lost_p
    if alarm is None or lost_p is None:
        return []
    opened = sorted((first, k, end) for k in range(len(tracks.names)) for first, end in spans(alarm[:, k]))
    return [AlarmSpan(k, first, end - 1, _largest(lost_p[first:end, k])) for first, k, end in opened]


def summarise(tracks: Tracks, alarms: Sequence[AlarmSpan]) -> list[Line]:
    """The table of all queries."""
    raised = Counter(span.query for span in alarms)
    return [_line(tracks, k, raised[k]) for k in range(len(tracks.names))]


def _line(tracks: Tracks, k: int, alarms: int) -> Line:
    bound = np.isfinite(tracks.uv_px[:, k]).all(axis=-1)
    head = (tracks.names[k], query_colour(k), tracks.labels[k] or "")
    if not bound.any():
        return Line(*head)
    points = tracks.point_world[:, k]
    points = points[np.isfinite(points).all(axis=-1) & (tracks.state[:, k] != State.LOST)]
    lost_p = math.nan if tracks.lost_p is None else _largest(tracks.lost_p[:, k])
    return Line(
        *head,
        seen=f"{tracks.visible[bound, k].mean():.0%}",
        moved=f"{np.linalg.norm(points - points[0], axis=-1).max():.3f} m" if len(points) else UNKNOWN,
        joint=UNKNOWN if tracks.joints is None else tracks.joints.describe(k),
        lost_p=UNKNOWN if math.isnan(lost_p) else f"{lost_p:.2f}",
        alarms=UNKNOWN if math.isnan(lost_p) else str(alarms),
        end=str(tracks.state[-1, k]),
    )


def _largest(values: np.ndarray) -> float:
    return (
        float(np.max(values, where=np.isfinite(values), initial=-math.inf)) if np.isfinite(values).any() else math.nan
    )


def narrate(tracks: Tracks) -> list[str]:
    """One sentence per entity that moves or goes out of sight, one for all others, and one per alarm, in this order.

    Args:
        tracks: with or without joints, world points and a monitor; what they lack is not told.
    """
    sentences, still = [], []
    for k, name in enumerate(tracks.names):
        bound = np.asarray(np.isfinite(tracks.uv_px[:, k]).all(axis=-1))
        if not bound.any():
            sentences.append(f"{name} was never found.")
            continue
        told = [*_movement(tracks, k), *_out_of_sight(tracks, k, bound)]
        if tracks.state[-1, k] == State.LOST:
            told.append("is lost at the end")
        if told:
            sentences.append(f"{name} {_listed(told)}.")
        else:
            still.append(name)
    if still:
        sentences.append(f"{_listed(still)} stayed where {'it was' if len(still) == 1 else 'they were'}, in sight.")
    return [*sentences, *_alarms(tracks)]


def _movement(tracks: Tracks, k: int) -> list[str]:
    """At most one clause: how far an entity was seen to go, when, and how far it came back."""
    verb, gone, unit, digits, least = _way(tracks, k)
    known = np.flatnonzero((tracks.state[:, k] == State.TRACKING) & np.isfinite(gone))
    if not len(known):
        return []
    gone = gone[known] - gone[known[0]]
    farthest = int(np.abs(gone).argmax())
    most, end = float(gone[farthest]), float(gone[-1])
    if abs(most) < least:
        return []
    started = int(np.flatnonzero(np.abs(gone[: farthest + 1]) <= _STILL * abs(most))[-1])
    away = np.flatnonzero(np.abs(gone - end) > _STILL * abs(most))
    stopped = min(int(away[-1]) + 1, len(gone) - 1)
    first_s, last_s = (tracks.stamp_s[known[i]] for i in (started, stopped))
    came_back = abs(most - end) > 2 * _STILL * abs(most)
    back = f" and came back to {abs(end):.{digits}f}{unit}" if came_back else ""
    return [f"{verb} {abs(most):.{digits}f}{unit}{back} from {first_s:.1f} s to {last_s:.1f} s"]


def _way(tracks: Tracks, k: int) -> tuple[str, Float[np.ndarray, " T"], str, int, float]:
    """What it did, how far it is from its first place (NaN where unknown), unit, digits, and the least that is told."""
    joints = tracks.joints
    kind = "unknown" if joints is None else joints.kind[k]
    if joints is not None and kind == "revolute":
        turned, known = joints.q[:, k].astype(np.float64), np.isfinite(joints.q[:, k])
        turned[known] = np.unwrap(turned[known])  # q is within half a turn
        return "turned", np.degrees(turned), "°", 0, 5.0
    if joints is not None and kind == "prismatic":
        return "slid", joints.q[:, k].astype(np.float64), " m", 2, 0.02
    points, pixels = (values[:, k].astype(np.float64) for values in (tracks.point_world, tracks.uv_px))
    if kind == "static":
        return "stayed", np.zeros(len(points)), "", 0, math.inf
    if np.isfinite(points).any():
        return "moved", _from_start(points), " m", 2, 0.02
    return "moved", _from_start(pixels), " px in the picture", 0, 8.0


def _from_start(places: Float[np.ndarray, "T D"]) -> Float[np.ndarray, " T"]:
    """Distance from the first known place."""
    return np.linalg.norm(places - places[np.isfinite(places).all(axis=-1).argmax()], axis=-1)


def _out_of_sight(tracks: Tracks, k: int, bound: Bool[np.ndarray, " T"]) -> list[str]:
    """One clause per time in which an entity was not seen."""
    told = []
    for start, end in spans(bound & ~tracks.visible[:, k]):
        ends = end < len(tracks)
        since_s, until_s = tracks.stamp_s[start], tracks.stamp_s[end if ends else end - 1]
        if until_s - since_s >= LEAST_OCCLUSION_S:
            until = f"until it was found again at {until_s:.1f} s" if ends else "on"
            told.append(f"was out of sight from {since_s:.1f} s {until}")
    return told


def _alarms(tracks: Tracks) -> list[str]:
    if tracks.alarm is None or tracks.lost_p is None or not np.isfinite(tracks.lost_p).any():
        return []  # nothing was monitored
    told = []
    for span in alarm_spans(tracks):
        why = "" if math.isnan(span.lost_p) else f" (P(lost) up to {span.lost_p:.2f})"
        cleared = span.last + 1 < len(tracks)
        until = f"cleared at {tracks.stamp_s[span.last + 1]:.1f} s" if cleared else "was still open at the end"
        name, since_s = tracks.names[span.query], tracks.stamp_s[span.first]
        told.append(f"An alarm for {name} opened at {since_s:.1f} s{why} and {until}.")
    return told or ["No alarm was raised."]


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
