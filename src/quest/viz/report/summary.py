"""One line per query, and the alarms one by one."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Shaped

from quest.types import State, Tracks
from quest.viz.palette import RGB, query_colour

UNKNOWN = "unknown"


@dataclass(frozen=True)
class Line:
    """A query in the table of all; words, because that is how they are shown."""

    name: str
    """Of the query."""
    colour: RGB
    """In every picture."""
    label: str
    """Empty where it has none."""
    seen: str
    """Share of frames from the first answer on."""
    moved: str
    """Farthest distance from where it was first, metres."""
    joint: str
    """Kind and range."""
    lost_p: str
    """Largest P(lost)."""
    alarms: str
    """How many were raised."""
    end: str
    """State at the end."""


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


def runs(values: Shaped[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """First index, and index after the last, of every run of equal values."""
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(pairwise(edges))


def alarm_spans(tracks: Tracks) -> list[AlarmSpan]:
    """All alarms in the order of their opening."""
    if tracks.alarm is None or tracks.lost_p is None:
        return []
    spans = []
    for k in range(len(tracks.names)):
        for first, end in runs(tracks.alarm[:, k]):
            if tracks.alarm[first, k]:
                spans.append(AlarmSpan(k, first, end - 1, _largest(tracks.lost_p[first:end, k])))
    return sorted(spans, key=lambda span: (span.first, span.query))


def summarise(tracks: Tracks, alarms: list[AlarmSpan]) -> list[Line]:
    """The table of all queries."""
    raised = Counter(span.query for span in alarms)
    return [_line(tracks, k, raised[k]) for k in range(len(tracks.names))]


def _line(tracks: Tracks, k: int, alarms: int) -> Line:
    bound = np.isfinite(tracks.uv_px[:, k]).all(axis=-1)
    head = (tracks.names[k], query_colour(k), tracks.labels[k] or "")
    if not bound.any():
        return Line(*head, "", "", "", "", "", "not found")
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
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else math.nan
