"""The plots of a report, as Plotly takes them: traces and layouts of plain values."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from quest.types import State, Tracks
from quest.viz.joint_lines import JointLines, joint_lines
from quest.viz.narrate import spans
from quest.viz.palette import BACKGROUND, HELD, LINE, LOST, MUTED, RGB, TEXT, query_colour

ROW_PX = 58
"""Height of a query's time line."""
MOST_NAMED = 12
"""With more lines than this a plot has no legend: a line says its name where one points at it."""
_STATES = ("", State.TRACKING.value, State.HELD.value, State.LOST.value)
"""The later, the worse; the first is not bound yet."""
_SMALLEST_BOX_M = 0.1
_TOP, _FOOT, _STRIP = 0.32, 0.74, 0.86
"""Where in its row P(lost) is 1 and 0, and the middle of the strip of states."""

MOST_BINS = 1000
"""Per line: about as many as a screen is wide, in pixels."""
_MOST_TOGETHER = 64 * MOST_BINS
_FEWEST_BINS = 50

Trace = dict[str, Any]


@dataclass(frozen=True)
class Drift:
    """How far tracks are from the truth, each beside the entity that it was assigned to."""

    entity: tuple[str | None, ...]
    """Name of the entity per query; None where none was near it at first."""
    distance: Float[np.ndarray, "T K"]
    """Normalised units; NaN where the query has no entity, and before it is bound."""
    accuracy: Float[np.ndarray, " K"]
    """Share of frames in which the answer is nearest to its own entity and within :attr:`gate`; NaN likewise."""
    gate: float
    """Normalised units; an answer that is farther from every entity has no identity."""
    unit_m: float
    """Metres of a normalised unit."""
    missing: float
    """Distance of an answer without a world point, normalised units."""


@dataclass(frozen=True)
class Thinning:
    """Frames in bins of equal length, for plots of fewer frames than there are, without a loss of peaks and alarms.

    Without need for it every frame is a bin of its own.
    """

    frames: int
    """How many there are."""
    width: int
    """Frames in a bin; the last may have fewer."""

    @classmethod
    def of(cls, frames: int, lines: int) -> Thinning:
        """Bins that keep a page with so many lines bounded."""
        bins = max(_FEWEST_BINS, min(MOST_BINS, _MOST_TOGETHER // max(lines, 1)))
        return cls(frames, -(-frames // bins))

    def starts(self) -> Int[np.ndarray, " B"]:
        """First frame of each bin."""
        return np.arange(0, self.frames, self.width)

    def every(self) -> Int[np.ndarray, " N"]:
        """One frame per bin, and the last one."""
        return np.unique([*self.starts(), self.frames - 1])

    def extremes(self, values: Float[np.ndarray, " T"]) -> Int[np.ndarray, " N"]:
        """Frames with the smallest and the largest value of each bin; NaN where a bin has nothing else."""
        lost = np.isnan(values)
        low = self._binned(np.where(lost, np.inf, values), np.inf).argmin(axis=1)
        high = self._binned(np.where(lost, -np.inf, values), -np.inf).argmax(axis=1)
        return np.unique(np.concatenate([self.starts() + low, self.starts() + high]))

    def largest(self, values: Shaped[np.ndarray, " T"]) -> Shaped[np.ndarray, " B"]:
        """Largest of the values of each bin, which are not negative."""
        return self._binned(values, 0).max(axis=1)

    def _binned(self, values: np.ndarray, fill: float) -> np.ndarray:
        padded = np.full(len(self.starts()) * self.width, fill, dtype=values.dtype)
        padded[: self.frames] = values
        return padded.reshape(-1, self.width)


@dataclass(frozen=True)
class Plot:
    """A figure of Plotly with its text."""

    id: str
    """Of its element in the page."""
    about: str
    """What it shows, for those who do not see it."""
    height: int
    """Pixels."""
    data: list[Trace]
    """Traces."""
    layout: dict[str, Any]
    """Layout."""
    timed: bool = True
    """Whether x is time, so that it has a cursor."""


def time_lines(tracks: Tracks, thinning: Thinning) -> Plot | None:
    """A row per query: P(lost), the alarms that are open, and the state."""
    queries = len(tracks.names)
    if not queries:
        return None
    edge_s = _edges_s(tracks.stamp_s)
    rows = np.arange(queries)
    levels = np.stack([rows + _TOP] * 2 + [rows * np.nan] + [rows + _FOOT] * 2 + [rows * np.nan], 1)
    ends_s = [float(edge_s[0]), float(edge_s[-1]), None]
    data = [_line("scale", LINE, 1) | {"x": ends_s * 2 * queries, "y": _values(levels), "hoverinfo": "skip"}]
    data += [trace for k in range(queries) for trace in _time_line(tracks, k, thinning, edge_s)]
    labels = [
        {"x": 0, "xref": "paper", "xanchor": "left", "y": k + 0.16, "showarrow": False, "text": _plain(name)}
        | {"font": {"color": _css(query_colour(k)), "size": 13}}
        for k, name in enumerate(tracks.names)
    ]
    ticks = {"tickvals": [y for k in range(queries) for y in (k + _TOP, k + _FOOT)], "ticktext": ["1", "0"] * queries}
    rows_axis = {"range": [queries, 0], "fixedrange": True, "showgrid": False, "zeroline": False, **ticks}
    height = ROW_PX * queries + 56
    more = {"yaxis": rows_axis | {"tickfont": {"size": 10}}, "barmode": "overlay", "annotations": labels}
    about = f"Time lines of P(lost), alarms and states of {', '.join(tracks.names)}; the tables say the same in words."
    return Plot("time-lines", about, height, data, _layout(height, _seconds(edge_s), **more))


def _time_line(tracks: Tracks, k: int, thinning: Thinning, edge_s: np.ndarray) -> list[Trace]:
    """The alarms of a query, the strip of its states, and P(lost); of the frames in a bin the worst is shown."""

    def bars(y: float, width: float, runs: Sequence[tuple[int, int]], marker: Trace, hover: Trace) -> Trace:
        """A bar over every run of bins."""
        ends = np.array(runs, dtype=int).reshape(-1, 2) * thinning.width
        from_s, until_s = edge_s[np.minimum(ends, thinning.frames)].T
        bar = {"type": "bar", "orientation": "h", "name": _plain(tracks.names[k]), "y": [y] * len(runs)}
        bar |= {"base": _values(from_s), "x": _values(until_s - from_s), "width": width, "marker": marker}
        return bar | hover

    traces = []
    if tracks.alarm is not None and tracks.alarm[:, k].any():
        line, fill = {"color": _css(LOST), "width": 1}, f"rgba({','.join(map(str, LOST))},0.28)"
        hover = {"hovertemplate": "alarm from %{base:.2f} s for %{x:.2f} s"}
        runs = spans(thinning.largest(tracks.alarm[:, k]))
        traces.append(bars(k + 0.62, 0.7, runs, {"color": fill, "line": line}, hover))
    bound = np.isfinite(tracks.uv_px[:, k]).all(axis=-1)
    codes = sum(np.where(tracks.state[:, k] == state, code, 0) for code, state in enumerate(_STATES))
    worst = thinning.largest(np.where(bound, codes, 0))
    runs = spans(worst)
    fills = [_css(colour) for colour in (TEXT, query_colour(k), HELD, LOST)]
    marker = {"color": [fills[worst[first]] for first, _ in runs], "line": {"width": 0}}
    said = {"customdata": [_STATES[worst[first]] for first, _ in runs]}
    hover = said | {"hovertemplate": "%{customdata} from %{base:.2f} s for %{x:.2f} s"}
    traces.append(bars(k + _STRIP, 0.12, runs, marker, hover))
    if tracks.lost_p is not None and np.isfinite(tracks.lost_p[:, k]).any():
        lost_p = tracks.lost_p[:, k].astype(np.float64)
        shown = lost_p[thinning.extremes(lost_p)]
        said = {"customdata": _values(shown, digits=3), "hovertemplate": "P(lost) %{customdata} at %{x:.2f} s"}
        y = {"y": _values(k + _FOOT + (_TOP - _FOOT) * shown)}
        traces.append(_over_time(tracks, k, lost_p, thinning) | y | said)
    return traces


def coordinates(tracks: Tracks, thinning: Thinning) -> list[Plot]:
    """Where on their joints the queries are: degrees of those that turn, metres of those that slide."""
    joints, plots = tracks.joints, []
    if joints is None:
        return []
    for kind, factor, axis in (("revolute", 180 / np.pi, "angle, degrees"), ("prismatic", 1.0, "way, m")):
        data = []
        for k in [k for k, each in enumerate(joints.kind) if each == kind]:
            values = joints.q[:, k].astype(np.float64)
            if kind == "revolute":
                values[np.isfinite(values)] = np.unwrap(values[np.isfinite(values)])
            data.append(_over_time(tracks, k, values * factor, thinning))
        if data:
            about = f"Coordinate of {kind} joints over time, {axis}"
            plots.append(_lines_plot(f"joint-{kind}", about, tracks, data, axis))
    return plots


def drift_plot(tracks: Tracks, drift: Drift, thinning: Thinning) -> Plot:
    """Distance from the truth over time."""
    known = [k for k, entity in enumerate(drift.entity) if entity is not None]
    data = [_over_time(tracks, k, drift.distance[:, k], thinning) for k in known]
    about = "Distance of each answer from its true entity over time, normalised units"
    plot = _lines_plot("drift", about, tracks, data, "distance, normalised")
    line = {"color": _css(MUTED), "dash": "dash", "width": 1}
    gate = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": drift.gate, "y1": drift.gate, "line": line}
    plot.layout["yaxis"] |= {"rangemode": "tozero"}
    plot.layout["shapes"] = [gate]
    return plot


def world(tracks: Tracks, thinning: Thinning) -> Plot | None:
    """Tracks, joints and the camera's path in the world; None where nothing of them is known."""
    frames, data = thinning.every(), []
    lost = tracks.state == State.LOST
    for k, (name, joint) in enumerate(zip(tracks.names, joint_lines(tracks), strict=True)):
        known = np.isfinite(tracks.point_world[:, k]).all(axis=-1) & ~lost[:, k]
        if not known.any():
            continue
        points = np.where(known[:, None], tracks.point_world[:, k].astype(np.float64), np.nan)
        colour, last = query_colour(k), int(np.flatnonzero(known)[-1])
        data.append(_space(name, points[np.unique([*frames, last])], colour, 4, str(k)))
        data.append(_space(name, points[last][None], colour, 0, str(k), showlegend=False) | _mark(colour))
        data += [] if joint is None else _joint_traces(name, joint, colour, str(k))
    poses = np.zeros((0, 4, 4)) if tracks.cam_from_world is None else tracks.cam_from_world.astype(np.float64)
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    if len(poses):
        seen_from = poses[frames] if len(poses) == len(tracks) else poses
        centres = -np.einsum("nji,nj->ni", seen_from[:, :3, :3], seen_from[:, :3, 3])
        data.append(_space("camera", centres, TEXT, 3, "camera", showlegend=False))
        data.append(_space("camera", centres[-1:], TEXT, 0, "camera") | _mark(TEXT, symbol="diamond"))
    if not data:
        return None
    margin = dict.fromkeys("lrtb", 0)
    layout = _layout(520, {}, scene=_scene(data, poses), showlegend=_named(data), margin=margin)
    about = "Tracks, joints and the camera in the world, metres, all axes at one scale; the tables hold the numbers."
    return Plot("world", about, 520, data, layout, timed=False)


def _scene(data: list[Trace], poses: Float[np.ndarray, "N 4 4"]) -> dict[str, Any]:
    """A box round everything, its axes at one scale, seen from the side of the first camera and upright as there."""
    axis = {"backgroundcolor": _css(BACKGROUND), "gridcolor": _css(LINE), "zerolinecolor": _css(LINE)}
    points = np.concatenate([np.array([trace[name] for name in "xyz"], dtype=np.float64).T for trace in data])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    longest = max(float((high - low).max()), _SMALLEST_BOX_M)
    half = np.maximum((high - low) * 1.1, 0.4 * longest) / 2  # a box without depth cannot be turned
    middle, scene = (low + high) / 2, {}
    for i, name in enumerate("xyz"):
        around = [float(middle[i] - half[i]), float(middle[i] + half[i])]
        scene[f"{name}axis"] = {"title": {"text": f"{name}, m"}, "range": around, "color": _css(MUTED), **axis}
    right, down, forward = (poses[0] if len(poses) else np.eye(4))[:3, :3]
    eye = 1.5 * (0.35 * right - 0.45 * down - forward)
    looks = {name: dict(zip("xyz", to.tolist(), strict=True)) for name, to in (("up", -down), ("eye", eye))}
    ratio = dict(zip("xyz", (half / half.max()).tolist(), strict=True))
    return scene | {"aspectmode": "manual", "aspectratio": ratio, "dragmode": "orbit", "camera": looks}


def _joint_traces(name: str, joint: JointLines, colour: RGB, group: str) -> list[Trace]:
    traces = [_space(f"{name}: range", joint.path, colour, 9, group, showlegend=False) | {"opacity": 0.45}]
    if joint.axis is not None:
        axis = _space(f"{name}: axis", joint.axis, colour, 3, group, showlegend=False)
        traces.append(axis | {"line": {**axis["line"], "dash": "dash"}})
    return traces + [_space(f"{name}: range", arm, colour, 1, group, showlegend=False) for arm in joint.arms]


def _space(name: str, points: Float[np.ndarray, "N 3"], colour: RGB, width: int, group: str, **more: Any) -> Trace:
    """A line in space."""
    places = {axis: _values(points[:, i]) for i, axis in enumerate("xyz")}
    hover = {"hovertemplate": "x %{x:.3f} m<br>y %{y:.3f} m<br>z %{z:.3f} m"}
    return _line(name, colour, width) | {"type": "scatter3d", "legendgroup": group} | places | hover | more


def _mark(colour: RGB, **more: Any) -> Trace:
    """What makes a line a mark."""
    return {"mode": "markers", "marker": {"size": 5, "color": _css(colour), **more}}


def _over_time(tracks: Tracks, k: int, values: Float[np.ndarray, " T"], thinning: Thinning) -> Trace:
    frames = thinning.extremes(values)
    # A line through one point is not seen.
    trace = _line(tracks.names[k], query_colour(k), 2) | {"mode": "lines" if len(frames) > 2 else "lines+markers"}
    points = {"x": _values(tracks.stamp_s[frames]), "y": _values(values[frames])}
    return trace | points | {"hovertemplate": "%{y} at %{x:.2f} s"}


def _lines_plot(id: str, about: str, tracks: Tracks, data: list[Trace], axis: str) -> Plot:
    y = {"title": {"text": axis}, "gridcolor": _css(LINE), "zerolinecolor": _css(LINE), "automargin": True}
    layout = _layout(320, _seconds(_edges_s(tracks.stamp_s)), yaxis=y, showlegend=_named(data))
    return Plot(id, about, 320, data, layout)


def _named(data: list[Trace]) -> bool:
    return len([trace for trace in data if trace.get("showlegend", True)]) <= MOST_NAMED


def _line(name: str, colour: RGB, width: int) -> Trace:
    line = {"color": _css(colour), "width": width}
    return {"type": "scatter", "mode": "lines", "name": _plain(name), "line": line}


def _layout(height: int, xaxis: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Dark in every theme, as the video is: the queries' colours are made for it."""
    return {
        "height": height,
        "margin": {"l": 26, "r": 12, "t": 8, "b": 44},
        "paper_bgcolor": _css(BACKGROUND),
        "plot_bgcolor": _css(BACKGROUND),
        "font": {"color": _css(TEXT), "family": "system-ui, sans-serif", "size": 12},
        "hovermode": "closest",
        "hoverlabel": {"namelength": -1},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom"},
        "showlegend": False,
        "xaxis": xaxis,
        **more,
    }


def _seconds(edge_s: np.ndarray) -> dict[str, Any]:
    ends_s = [float(edge_s[0]), float(edge_s[-1])]
    return {"title": {"text": "time, s"}, "range": ends_s, "gridcolor": _css(LINE), "zeroline": False}


def _edges_s(stamp_s: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T1"]:
    """When each frame begins, and the last one ends: after the usual time, or a thirtieth of a second."""
    steps = np.diff(stamp_s)
    steps = steps[steps > 0]
    return np.append(stamp_s, stamp_s[-1] + (float(np.median(steps)) if len(steps) else 1 / 30))


def _values(values: np.ndarray, *, digits: int = 4) -> list[float | None]:
    """Numbers of JSON, which has no NaN."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    return [round(value, digits) if np.isfinite(value) else None for value in flat.tolist()]


def _plain(text: str) -> str:
    """A text whose marks Plotly does not read as such."""
    return html.escape(text, quote=False)


def _css(colour: RGB) -> str:
    return f"rgb({colour[0]},{colour[1]},{colour[2]})"
