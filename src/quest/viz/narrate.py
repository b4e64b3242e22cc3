"""What happens in a clip, in words: every sentence is computed from its tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from quest.types import State, Tracks

LEAST_OCCLUSION_S = 0.2
"""Shorter times out of sight are not told."""

_STILL = 0.05
"""A movement lasts while less than this share of its way is missing at either end."""


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


@dataclass(frozen=True)
class _Way:
    """How far something is from its first place, frame by frame, and how to say so."""

    verb: str
    """What it did, such as ``turned``."""
    gone: Float[np.ndarray, " T"]
    """Signed, in ``unit``; NaN where unknown."""
    unit: str
    """Written behind a number."""
    digits: int
    """Behind the point."""
    least: float
    """What is less counts as rest."""

    def words(self, value: float) -> str:
        return f"{abs(value):.{self.digits}f}{self.unit}"


def _movement(tracks: Tracks, k: int) -> list[str]:
    """At most one clause: how far an entity was seen to go, when, and how far it came back."""
    way = _way(tracks, k)
    known = np.flatnonzero((tracks.state[:, k] == State.TRACKING) & np.isfinite(way.gone))
    if not len(known):
        return []
    gone = way.gone[known] - way.gone[known[0]]
    farthest = int(np.abs(gone).argmax())
    most, end = float(gone[farthest]), float(gone[-1])
    if abs(most) < way.least:
        return []
    started = int(np.flatnonzero(np.abs(gone[: farthest + 1]) <= _STILL * abs(most))[-1])
    away = np.flatnonzero(np.abs(gone - end) > _STILL * abs(most))
    stopped = min(int(away[-1]) + 1, len(gone) - 1)
    first_s, last_s = (tracks.stamp_s[known[i]] for i in (started, stopped))
    back = f" and came back to {way.words(end)}" if abs(most - end) > 2 * _STILL * abs(most) else ""
    return [f"{way.verb} {way.words(most)}{back} from {first_s:.1f} s to {last_s:.1f} s"]


def _way(tracks: Tracks, k: int) -> _Way:
    kind, joints = "unknown" if tracks.joints is None else tracks.joints.kind[k], tracks.joints
    if joints is not None and kind == "revolute":
        turned, known = joints.q[:, k].astype(np.float64), np.isfinite(joints.q[:, k])
        turned[known] = np.unwrap(turned[known])  # q is within half a turn
        return _Way("turned", np.degrees(turned), "°", 0, 5.0)
    if joints is not None and kind == "prismatic":
        return _Way("slid", joints.q[:, k].astype(np.float64), " m", 2, 0.02)
    points, pixels = (values[:, k].astype(np.float64) for values in (tracks.point_world, tracks.uv_px))
    if kind == "static":
        return _Way("stayed", np.zeros(len(points)), "", 0, math.inf)
    if np.isfinite(points).any():
        return _Way("moved", _from_start(points), " m", 2, 0.02)
    return _Way("moved", _from_start(pixels), " px in the picture", 0, 8.0)


def _from_start(places: Float[np.ndarray, "T D"]) -> Float[np.ndarray, " T"]:
    """Distance from the first known place."""
    return np.linalg.norm(places - places[np.isfinite(places).all(axis=-1).argmax()], axis=-1)


def _out_of_sight(tracks: Tracks, k: int, bound: Bool[np.ndarray, " T"]) -> list[str]:
    """One clause per time in which an entity was not seen."""
    told = []
    for start, end in _runs(bound & ~tracks.visible[:, k]):
        ends = end < len(tracks)
        since_s, until_s = tracks.stamp_s[start], tracks.stamp_s[end if ends else end - 1]
        if until_s - since_s < LEAST_OCCLUSION_S:
            continue
        until = f"until it was found again at {until_s:.1f} s" if ends else "on"
        told.append(f"was out of sight from {since_s:.1f} s {until}")
    return told


def _alarms(tracks: Tracks) -> list[str]:
    if tracks.alarm is None or tracks.lost_p is None or not np.isfinite(tracks.lost_p).any():
        return []  # nothing was monitored
    opened = [(start, end, k) for k in range(len(tracks.names)) for start, end in _runs(tracks.alarm[:, k])]
    if not opened:
        return ["No alarm was raised."]
    told = []
    for start, end, k in sorted(opened):
        p = float(np.max(tracks.lost_p[start:end, k]))
        why = "" if math.isnan(p) else f" (P(lost) up to {p:.2f})"
        until = f"cleared at {tracks.stamp_s[end]:.1f} s" if end < len(tracks) else "was still open at the end"
        told.append(f"An alarm for {tracks.names[k]} opened at {tracks.stamp_s[start]:.1f} s{why} and {until}.")
    return told


def _runs(flags: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """First frame, and frame after the last, of every run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
