"""Handles and knobs in many shapes, mounted on a front that looks along -y.

A handle's mesh lies along x, stands on y = 0 and reaches towards -y. Some run along their whole front, as those of many
refrigerators, ovens and kitchens do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from quest.sim.procedural.model import Dice, Link, ObjectModel, Part
from quest.sim.procedural.shapes import Mesh, box, boxes, centred_box, join, lathe, prism_between, tube

SUNK_M = 0.001
"""How deep feet reach into the front, so that no gap shows between them."""

HandleKind = Literal[
    "bar", "square_bar", "arched", "bracket", "lip", "plate", "ring", "knob", "disc", "block",
    "cup", "bow", "d_pull", "t_bar", "edge_pull", "loop", "lever",
]  # fmt: skip
HANDLE_KINDS: tuple[HandleKind, ...] = get_args(HandleKind)
USUAL_KINDS: tuple[HandleKind, ...] = HANDLE_KINDS[:10]
"""What :func:`sample_style` draws from; their order is part of what a seed means."""
_KNOBS = ("knob", "disc", "block")


@dataclass(frozen=True)
class HandleStyle:
    """How the handles of one object look."""

    kind: HandleKind
    """Shape."""
    length_m: float
    """Length of a long handle; the diameter of a knob follows ``thickness_m``."""
    thickness_m: float
    """Thickness of the bar, or radius of a knob."""
    reach_m: float
    """How far it sticks out of the front."""
    flatness: float
    """Height of the bar's section over its width."""
    surface: str
    """See :data:`quest.sim.procedural.model.SURFACES`."""

    @property
    def role(self) -> str:
        """``knob`` for what one grasps with finger tips, else ``handle``."""
        return "knob" if self.kind in _KNOBS else "handle"


def sample_style(rng: Dice, *, knobs: bool = True, scale: float = 1.0) -> HandleStyle:
    """Draw a style; appliances have no knobs, and handles that are ``scale`` times as long as those of furniture."""
    kinds = USUAL_KINDS if knobs else USUAL_KINDS[:4]
    weights = np.array([3, 2, 3, 2, 1, 1, 1, 2, 1, 1], dtype=float)[: len(kinds)]
    kind = rng.pick(kinds, p=(weights / weights.sum()).tolist())
    is_knob = kind in _KNOBS
    return HandleStyle(
        kind=kind,
        length_m=rng.real(0.10, 0.34) * scale,
        thickness_m=rng.real(0.014, 0.028) if is_knob else rng.real(0.008, 0.018),
        reach_m=rng.real(0.024, 0.042) if is_knob else rng.real(0.03, 0.055),
        flatness=rng.real(0.6, 1.6),
        surface=rng.pick(["metal", "dark", "front", "white"], p=[0.5, 0.3, 0.12, 0.08]),
    )


def sample_any_style(rng: Dice, *, knobs: bool = True, scale: float = 1.0) -> HandleStyle:
    """The same out of all shapes but levers, which are for doors of rooms."""
    style = sample_style(rng, knobs=knobs, scale=scale)
    if rng.chance(0.4):
        return style
    kind = HANDLE_KINDS[rng.whole(10, len(HANDLE_KINDS) - 1)]
    reach = style.reach_m if style.role == "handle" else rng.real(0.028, 0.045)
    thickness = style.thickness_m if style.role == "handle" else rng.real(0.008, 0.016)
    surface = "leather" if kind == "loop" else style.surface
    return replace(style, kind=kind, reach_m=reach, thickness_m=thickness, surface=surface)


def handle_part(
    style: HandleStyle, *, at: tuple[float, float, float], vertical: bool, room_m: tuple[float, float]
) -> Part:
    """A handle or knob mounted at a point of a front that looks along -y.

    Args:
        style: how it looks.
        at: where the middle of its foot stands, in the frame of the link, metres.
        vertical: whether a long handle runs along z rather than x.
        room_m: how much of the front is free around ``at`` along x and z; the handle shrinks to fit.
    """
    length = max(min(style.length_m, 0.8 * room_m[1 if vertical else 0]), 0.02)
    thickness = min(style.thickness_m, 0.4 * min(room_m))
    mesh = _BUILDERS[style.kind](length / 2, thickness, style.reach_m, style.flatness)
    if vertical and style.role == "handle" and style.kind not in ("cup", "loop"):
        mesh = mesh.rotated(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
    return Part(style.role, mesh.moved(at), style.surface)


# Every shape is built from half its length, its thickness, its reach and its flatness.


def _bar(half: float, thickness: float, reach: float, flatness: float, *, sides: int = 10) -> Mesh:
    radius = thickness / 2
    middle = -reach + radius
    bar = tube(np.array([[x, middle] for x in (-half, 0.0, half)]), radius_m=radius, sides=sides)
    post = (0.8 * thickness, -middle + SUNK_M, 0.8 * thickness)
    return join([bar, *(centred_box((side * 0.82 * half, (middle + SUNK_M) / 2, 0), post) for side in (-1, 1))])


def _plate(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    height = 0.03 * flatness / 2 + 0.012
    plate = box((-half, -0.004, -height), (half, SUNK_M, height))
    return join([plate, _bar(0.7 * half, thickness, reach, flatness)])


def _arched(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    radius, angle = thickness / 2, np.linspace(0, np.pi, 17)
    path = np.stack([-(half - radius) * np.cos(angle), -(reach - radius) * np.sin(angle) ** 0.7], axis=1)
    path[[0, -1], 1] = SUNK_M
    return tube(path, radius_m=radius, flatness=flatness)


def _bow(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A flat arc between two feet."""
    radius, x = thickness / 2, np.linspace(-1, 1, 17)
    path = np.stack([(half - radius) * x, -(reach - radius) * (1 - np.abs(x) ** 2.6)], axis=1)
    path[[0, -1], 1] = SUNK_M
    return tube(path, radius_m=0.7 * radius, flatness=1.6 * flatness)


def _bracket(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    height, bar = thickness * flatness / 2, 0.6 * thickness
    return boxes(
        ((-half, -reach, -height), (half, -reach + bar, height)),
        ((-half, -reach + bar, -height), (-half + bar, SUNK_M, height)),
        ((half - bar, -reach + bar, -height), (half, SUNK_M, height)),
    )


def _lip(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    return boxes(
        ((-half, -0.003, -0.02), (half, SUNK_M, 0.02)),
        ((-half, -reach, 0.016), (half, -0.003, 0.02)),
        ((-half, -reach, 0.006), (half, -reach + 0.004, 0.016)),
    )


def _edge_pull(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A thin angle along the front, gripped from below."""
    reach = min(reach, 0.03)
    return boxes(
        ((-half, -reach, 0.0), (half, -0.002, 0.003)),
        ((-half, -reach, -0.6 * reach), (half, -reach + 0.003, 0.0)),
        ((-half, -0.002, -0.004), (half, SUNK_M, 0.004 + 0.4 * thickness)),
    )


def _ring(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A hoop that hangs, tilted a little off the front, from a stud."""
    radius, tilt, angle = min(half, 0.035), np.pi / 2 - 0.25, 2 * np.pi * np.arange(24) / 24
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    hoop = tube(circle, radius_m=0.3 * thickness, sides=8, closed=True).tilted(tilt)
    out = -min(reach, 0.022)
    stud = centred_box((0, (out + SUNK_M) / 2, 0), (0.9 * thickness, -out + SUNK_M, 0.9 * thickness))
    plate = lathe([[0.9 * thickness, -SUNK_M], [0.9 * thickness, 0.004]])
    return join([plate, stud, hoop.moved((0, out + 0.3 * radius * np.cos(tilt), -0.95 * radius * np.sin(tilt)))])


def _knob(half: float, radius: float, reach: float, flatness: float) -> Mesh:
    angle = np.linspace(0.35, np.pi, 7)
    centre, round_ = 0.62 * reach, 0.38 * reach
    profile = [(0.4, -SUNK_M), (0.35, centre - round_ * np.cos(angle[0]))]
    profile += [(np.sin(a) + 1e-9, centre - round_ * np.cos(a)) for a in angle[1:]]
    return lathe([(radius * r, h) for r, h in profile])


def _disc(half: float, radius: float, reach: float, flatness: float) -> Mesh:
    profile = [(0.45, -SUNK_M), (0.45, 0.55 * reach), (1.0, 0.6 * reach), (1.0, 0.95 * reach), (0.9, reach)]
    return lathe([(radius * r, h) for r, h in profile])


def _block(half: float, radius: float, reach: float, flatness: float) -> Mesh:
    stem = centred_box((0, (-0.4 * reach + SUNK_M) / 2, 0), (0.8 * radius, 0.4 * reach + SUNK_M, 0.8 * radius))
    return join([stem, box((-radius, -reach, -radius), (radius, -0.4 * reach, radius))])


def _cup(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A quarter of a barrel over a flange, open below."""
    half, reach = min(half, 0.055), min(reach, 0.032)
    wall = min(0.3 * thickness, 0.2 * reach)
    angle = np.linspace(0, np.pi / 2, 9)
    # Columns are y and z: from the front's face, above, to the lip at the outer end, below.
    quarter = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    outer, inner = (r * quarter - np.array([0.0, 0.5 * reach]) for r in (reach, reach - wall))
    outer[0, 0] = inner[0, 0] = SUNK_M
    shell = prism_between(outer, inner, -half, half)
    core = np.tile([[SUNK_M, -0.49 * reach]], (9, 1)) + 0.02 * (outer - outer[0])
    ends = [prism_between(outer, core, side * half - wall / 2, side * half + wall / 2) for side in (-1, 1)]
    barrel = join([shell, *ends]).turned("side")
    return join([barrel, box((-half, -0.003, 0.5 * reach), (half, SUNK_M, 0.75 * reach))])


def _d_pull(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A bar whose ends are bent back to the front with round corners."""
    radius, angle = thickness / 2, np.linspace(0, np.pi / 2, 6)
    out = reach - radius
    bend = min(0.55 * out, 0.5 * half)
    left = np.stack([-half + radius + bend * (1 - np.cos(angle)), -out + bend * (1 - np.sin(angle))], axis=1)
    left = np.concatenate([[[-half + radius, SUNK_M]], left])
    return tube(np.concatenate([left, left[::-1] * [-1, 1]]), radius_m=radius, sides=12)


def _t_bar(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A bar on one post."""
    radius, half = 0.6 * thickness, min(half, 0.04)
    bar = tube(np.array([[x, -reach + radius] for x in (-half, 0.0, half)]), radius_m=radius)
    post = lathe([[0.9 * radius, -SUNK_M], [0.7 * radius, 0.5 * reach], [0.7 * radius, reach - radius]])
    return join([bar, post])


def _loop(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A strap of leather that stands out in a loop, held by a stud."""
    half, thick, tall = min(half, 0.016), 0.0025, 0.6 * reach
    angle = np.linspace(0, np.pi, 13)
    outer = np.stack([-reach * np.sin(angle) ** 0.8, tall * np.cos(angle)], axis=1)
    inner = outer * [(reach - thick) / reach, (tall - thick) / tall]
    outer[[0, -1], 0] = inner[[0, -1], 0] = SUNK_M
    strap = prism_between(outer, inner, -half, half).turned("side")
    stud = lathe([[0.006, -SUNK_M], [0.006, 0.002], [0.003, 0.004]])
    return join([strap, stud.moved((0, 0, -tall - 0.008)), box((-half, -0.002, -tall - 0.018), (half, SUNK_M, -tall))])


def _lever(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A door's lever: a rosette, a neck, and a bar to the right of it, so that the foot is at its left end."""
    radius, angle = thickness / 2, np.linspace(0, np.pi / 2, 6)
    long, bend = 2 * half - 2 * radius, 0.4 * reach
    corner = np.stack([bend * (1 - np.cos(angle)), -reach + radius + bend * (1 - np.sin(angle))], axis=1)
    path = np.concatenate([[[0.0, SUNK_M]], corner, [[0.6 * long, -reach + radius], [long, -reach + 1.2 * radius]]])
    rosette = lathe([[2.4 * radius, -SUNK_M], [2.4 * radius, 0.006], [2.0 * radius, 0.009]])
    bar = tube(path, radius_m=radius, flatness=flatness, sides=12)
    return join([rosette, bar]).moved((-half + radius, 0, 0))


_BUILDERS: dict[HandleKind, Callable[[float, float, float, float], Mesh]] = {
    "bar": _bar, "square_bar": partial(_bar, sides=4), "arched": _arched, "bracket": _bracket, "lip": _lip,
    "plate": _plate, "ring": _ring, "knob": _knob, "disc": _disc, "block": _block, "cup": _cup, "bow": _bow,
    "d_pull": _d_pull, "t_bar": _t_bar, "edge_pull": _edge_pull, "loop": _loop, "lever": _lever,
}  # fmt: skip
_LONG_KINDS: tuple[HandleKind, ...] = ("bar", "square_bar", "arched", "bracket", "lip", "bow", "d_pull", "edge_pull")


def with_long_handles(model: ObjectModel, rng: Dice) -> ObjectModel:
    """The object with one handle on every front that had one or more, nearly as long as the front.

    The fronts look along -y. Handles are upright on what turns about an upright axis, level on all else, where the
    first of the old ones was across that, and all of one style. Strips of a few centimetres keep theirs.
    """
    style = sample_style(rng, knobs=False)
    kind = rng.pick(_LONG_KINDS)
    thickness = min(style.thickness_m * rng.real(0.9, 2.2), 0.45 * style.reach_m)
    style = replace(style, kind=kind, thickness_m=thickness)
    share = rng.real(0.45, 0.98)

    def with_long(link: Link) -> Link:
        if not (link.grips and link.rest):
            return link
        low, high = join([part.mesh for part in link.rest]).bounds
        old = link.grips[0].mesh.bounds
        vertical = link.kind == "revolute" and abs(link.axis[2]) > 0.5
        along = 2 if vertical else 0
        length = share * float(high[along] - low[along])
        if length < 0.05:
            return link
        x, foot, z = old.mean(axis=0)[0], float(old[1, 1]), old.mean(axis=0)[2]
        middle = (low[along] + high[along]) / 2
        at, room = ((x, foot, middle), (0.1, length / 0.8)) if vertical else ((middle, foot, z), (length / 0.8, 0.1))
        # A bowed door is foremost elsewhere.
        own = replace(style, length_m=length, reach_m=style.reach_m + max(0.0, foot - float(low[1])))
        return replace(link, parts=(*link.rest, handle_part(own, at=at, vertical=vertical, room_m=room)))

    return replace(model, links=tuple(with_long(link) for link in model.links))
