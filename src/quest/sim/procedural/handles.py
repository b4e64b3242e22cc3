"""Handles and knobs in many shapes, mounted on a front that looks along -y.

A handle's mesh lies along x, stands on y = 0 and reaches towards -y. Some run along their whole front, as those of many
refrigerators, ovens and kitchens do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from quest.sim.procedural.model import Link, Mesh, ObjectModel, Part, join
from quest.sim.procedural.shapes import box, centred_box, lathe, prism_between, tube
from quest.types import GRIPS

SUNK_M = 0.001
"""How deep feet reach into the front, so that no gap shows between them."""

_TO_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Turns what is drawn in the x-y plane and extruded along z into the y-z plane, extruded along x."""


def cup(half: float, thickness: float, reach: float) -> Mesh:
    """A cup pull: a quarter of a barrel over a flange, open below."""
    wall = min(0.3 * thickness, 0.2 * reach)
    angle = np.linspace(0, np.pi / 2, 9)
    # Columns are y and z: from the front's face, above, to the lip at the outer end, below.
    quarter = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    outer = reach * quarter - np.array([0.0, 0.5 * reach])
    inner = (reach - wall) * quarter - np.array([0.0, 0.5 * reach])
    outer[0, 0] = inner[0, 0] = SUNK_M
    shell = prism_between(outer, inner, -half, half)
    core = np.tile([[SUNK_M, -0.49 * reach]], (9, 1)) + 0.02 * (outer - outer[0])
    ends = [prism_between(outer, core, side * half - wall / 2, side * half + wall / 2) for side in (-1, 1)]
    barrel = join([shell, *ends]).rotated(_TO_X)
    return join([barrel, box((-half, -0.003, 0.5 * reach), (half, SUNK_M, 0.75 * reach))])


def bow(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A bow: a flat arc between two feet."""
    radius = thickness / 2
    x = np.linspace(-1, 1, 17)
    path = np.stack([(half - radius) * x, -(reach - radius) * (1 - np.abs(x) ** 2.6), 0 * x], axis=1)
    path[[0, -1], 1] = SUNK_M
    return tube(path, radius_m=0.7 * radius, flatness=1.6 * flatness)


def d_pull(half: float, thickness: float, reach: float) -> Mesh:
    """A D: a bar whose ends are bent back to the front with round corners."""
    radius = thickness / 2
    out = reach - radius
    bend = min(0.55 * out, 0.5 * half)
    angle = np.linspace(0, np.pi / 2, 6)
    left = np.stack([-half + radius + bend * (1 - np.cos(angle)), -out + bend * (1 - np.sin(angle))], axis=1)
    right = left[::-1] * [-1, 1]
    ends = np.array([[-half + radius, SUNK_M]])
    path = np.concatenate([ends, left, right, ends * [-1, 1]])
    return tube(np.column_stack([path, np.zeros(len(path))]), radius_m=radius, sides=12)


def t_bar(half: float, thickness: float, reach: float) -> Mesh:
    """A bar on one post."""
    radius, half = 0.6 * thickness, min(half, 0.04)
    bar = tube(np.array([[x, -reach + radius, 0.0] for x in (-half, 0.0, half)]), radius_m=radius)
    post = lathe(np.array([[0.9 * radius, -SUNK_M], [0.7 * radius, 0.5 * reach], [0.7 * radius, reach - radius]]))
    return join([bar, post])


def edge_pull(half: float, thickness: float, reach: float) -> Mesh:
    """A thin angle along the front, gripped from below."""
    depth = 0.6 * reach
    return join([
        box((-half, -reach, 0.0), (half, -0.002, 0.003)),
        box((-half, -reach, -depth), (half, -reach + 0.003, 0.0)),
        box((-half, -0.002, -0.004), (half, SUNK_M, 0.004 + 0.4 * thickness)),
    ])  # fmt: skip


def loop(half: float, reach: float) -> Mesh:
    """A strap of leather that stands out in a loop, held by a stud."""
    half, thick, tall = min(half, 0.016), 0.0025, 0.6 * reach
    angle = np.linspace(0, np.pi, 13)
    outer = np.stack([-reach * np.sin(angle) ** 0.8, tall * np.cos(angle)], axis=1)
    inner = outer * [(reach - thick) / reach, (tall - thick) / tall]
    outer[[0, -1], 0] = inner[[0, -1], 0] = SUNK_M
    strap = prism_between(outer, inner, -half, half).rotated(_TO_X)
    stud = lathe(np.array([[0.006, -SUNK_M], [0.006, 0.002], [0.003, 0.004]]))
    return join([strap, stud.moved((0, 0, -tall - 0.008)), box((-half, -0.002, -tall - 0.018), (half, SUNK_M, -tall))])


def lever(half: float, thickness: float, reach: float, flatness: float) -> Mesh:
    """A door's lever: a rosette, a neck, and a bar to the right of it, so that the foot is at its left end."""
    radius = thickness / 2
    long, bend = 2 * half - 2 * radius, 0.4 * reach
    angle = np.linspace(0, np.pi / 2, 6)
    corner = np.stack([bend * (1 - np.cos(angle)), -reach + radius + bend * (1 - np.sin(angle))], axis=1)
    path = np.concatenate([[[0.0, SUNK_M]], corner, [[0.6 * long, -reach + radius], [long, -reach + 1.2 * radius]]])
    bar = tube(np.column_stack([path, np.zeros(len(path))]), radius_m=radius, flatness=flatness, sides=12)
    rosette = lathe(np.array([[2.4 * radius, -SUNK_M], [2.4 * radius, 0.006], [2.0 * radius, 0.009]]))
    return join([rosette, bar]).moved((-half + radius, 0, 0))


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


def sample_style(rng: np.random.Generator, *, knobs: bool = True, scale: float = 1.0) -> HandleStyle:
    """Draw a style.

    Args:
        rng: source of randomness.
        knobs: whether knobs may come out; appliances have none.
        scale: factor on the length; appliances have longer handles than furniture.
    """
    kinds = USUAL_KINDS if knobs else USUAL_KINDS[:4]
    weights = np.array([3, 2, 3, 2, 1, 1, 1, 2, 1, 1], dtype=float)[: len(kinds)]
    kind = kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]
    is_knob = kind in _KNOBS
    return HandleStyle(
        kind=kind,
        length_m=float(rng.uniform(0.10, 0.34)) * scale,
        thickness_m=float(rng.uniform(0.014, 0.028) if is_knob else rng.uniform(0.008, 0.018)),
        reach_m=float(rng.uniform(0.024, 0.042) if is_knob else rng.uniform(0.03, 0.055)),
        flatness=float(rng.uniform(0.6, 1.6)),
        surface=str(rng.choice(["metal", "dark", "front", "white"], p=[0.5, 0.3, 0.12, 0.08])),
    )


def sample_any_style(rng: np.random.Generator, *, knobs: bool = True, scale: float = 1.0) -> HandleStyle:
    """Draw a style out of all shapes but levers, which are for doors of rooms.

    Args:
        rng: source of randomness.
        knobs: whether knobs may come out.
        scale: factor on the length.
    """
    style = sample_style(rng, knobs=knobs, scale=scale)
    if rng.random() < 0.4:
        return style
    kind = HANDLE_KINDS[int(rng.integers(10, len(HANDLE_KINDS) - 1))]
    reach = style.reach_m if style.role == "handle" else float(rng.uniform(0.028, 0.045))
    thickness = style.thickness_m if style.role == "handle" else float(rng.uniform(0.008, 0.016))
    surface = "leather" if kind == "loop" else style.surface
    return replace(style, kind=kind, reach_m=reach, thickness_m=thickness, surface=surface)


def handle_part(
    style: HandleStyle,
    *,
    at: tuple[float, float, float],
    vertical: bool,
    room_m: tuple[float, float],
) -> Part:
    """A handle mounted at a point of a front that looks along -y.

    Args:
        style: how it looks.
        at: where the middle of its foot stands, in the frame of the link, metres.
        vertical: whether a long handle runs along z rather than x.
        room_m: how much of the front is free around ``at`` along x and z; the handle shrinks to fit.

    Returns:
        A part of role ``handle`` or ``knob``.
    """
    room = room_m[1] if vertical else room_m[0]
    length = max(min(style.length_m, 0.8 * room), 0.02)
    limit = 0.4 * min(room_m)
    thickness = min(style.thickness_m, limit)
    mesh = _build(style, length, thickness)
    if vertical and style.role == "handle" and style.kind not in ("cup", "loop"):
        quarter = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        mesh = mesh.rotated(quarter)
    return Part(style.role, mesh.moved(at), style.surface)


def _build(style: HandleStyle, length: float, thickness: float) -> Mesh:
    """The handle along x, standing on y = 0 and reaching towards -y."""
    reach, half = style.reach_m, length / 2
    if style.kind in ("bar", "square_bar"):
        return _bar(half, thickness, reach, square=style.kind == "square_bar")
    if style.kind == "arched":
        radius = thickness / 2
        angle = np.linspace(0, np.pi, 17)
        path = np.stack([-(half - radius) * np.cos(angle), -(reach - radius) * np.sin(angle) ** 0.7, 0 * angle], axis=1)
        path[[0, -1], 1] = SUNK_M
        return tube(path, radius_m=radius, flatness=style.flatness)
    if style.kind == "bracket":
        height = thickness * style.flatness / 2
        return join([
            box((-half, -reach, -height), (half, -reach + 0.6 * thickness, height)),
            box((-half, -reach + 0.6 * thickness, -height), (-half + 0.6 * thickness, SUNK_M, height)),
            box((half - 0.6 * thickness, -reach + 0.6 * thickness, -height), (half, SUNK_M, height)),
        ])  # fmt: skip
    if style.kind == "lip":
        return join([
            box((-half, -0.003, -0.02), (half, SUNK_M, 0.02)),
            box((-half, -reach, 0.016), (half, -0.003, 0.02)),
            box((-half, -reach, 0.006), (half, -reach + 0.004, 0.016)),
        ])  # fmt: skip
    if style.kind == "plate":
        height = 0.03 * style.flatness / 2 + 0.012
        return join([
            box((-half, -0.004, -height), (half, SUNK_M, height)),
            _bar(0.7 * half, thickness, reach, square=False),
        ])  # fmt: skip
    if style.kind == "cup":
        return cup(min(half, 0.055), thickness, min(reach, 0.032))
    if style.kind == "bow":
        return bow(half, thickness, reach, style.flatness)
    if style.kind == "d_pull":
        return d_pull(half, thickness, reach)
    if style.kind == "t_bar":
        return t_bar(half, thickness, reach)
    if style.kind == "edge_pull":
        return edge_pull(half, thickness, min(reach, 0.03))
    if style.kind == "loop":
        return loop(half, reach)
    if style.kind == "lever":
        return lever(half, thickness, reach, style.flatness)
    if style.kind == "ring":
        return _ring(min(half, 0.035), thickness, reach)
    return _knob(style, thickness, reach)


def _bar(half: float, thickness: float, reach: float, *, square: bool) -> Mesh:
    radius = thickness / 2
    middle = -reach + radius
    bar = tube(
        np.array([[-half, middle, 0], [0, middle, 0], [half, middle, 0]], dtype=float),
        radius_m=radius,
        sides=4 if square else 10,
    )
    post = (0.8 * thickness, -middle + SUNK_M, 0.8 * thickness)
    posts = [centred_box((side * 0.82 * half, (middle + SUNK_M) / 2, 0), post) for side in (-1, 1)]
    return join([bar, *posts])


def _ring(radius: float, thickness: float, reach: float) -> Mesh:
    angle = 2 * np.pi * np.arange(24) / 24
    circle: Float[np.ndarray, "24 3"] = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    hoop = tube(circle, radius_m=0.3 * thickness, sides=8, closed=True)
    # The hoop is drawn in the x-y plane and hangs, tilted a little off the front, from a stud.
    tilt = np.pi / 2 - 0.25
    cos, sin = np.cos(tilt), np.sin(tilt)
    hoop = hoop.rotated(np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]], dtype=float))
    out = -min(reach, 0.022)
    stud = centred_box((0, (out + SUNK_M) / 2, 0), (0.9 * thickness, -out + SUNK_M, 0.9 * thickness))
    plate = lathe(np.array([[0.9 * thickness, -SUNK_M], [0.9 * thickness, 0.004]]))
    return join([plate, stud, hoop.moved((0, out + 0.3 * radius * cos, -0.95 * radius * sin))])


def _knob(style: HandleStyle, radius: float, reach: float) -> Mesh:
    if style.kind == "block":
        stem = centred_box((0, (-0.4 * reach + SUNK_M) / 2, 0), (0.8 * radius, 0.4 * reach + SUNK_M, 0.8 * radius))
        return join([stem, box((-radius, -reach, -radius), (radius, -0.4 * reach, radius))])
    if style.kind == "disc":
        profile = [(0.45, -SUNK_M), (0.45, 0.55 * reach), (1.0, 0.6 * reach), (1.0, 0.95 * reach), (0.9, reach)]
    else:
        angle = np.linspace(0.35, np.pi, 7)
        centre, half = 0.62 * reach, 0.38 * reach
        profile = [(0.4, -SUNK_M), (0.35, centre - half * np.cos(angle[0]))]
        profile += [(float(np.sin(a)) + 1e-9, float(centre - half * np.cos(a))) for a in angle[1:]]
    return lathe(np.array([(radius * r, h) for r, h in profile]))


_KINDS: tuple[HandleKind, ...] = ("bar", "square_bar", "arched", "bracket", "lip", "bow", "d_pull", "edge_pull")
_SHARE = (0.45, 0.98)
_SHORTEST_M = 0.05
_THICKER = (0.9, 2.2)
_THICKEST = 0.45
"""Of how far it sticks out."""


def with_long_handles(model: ObjectModel, rng: np.random.Generator) -> ObjectModel:
    """The object with one handle on every front that had one or more, nearly as long as the front.

    Upright on what turns about an upright axis, level on all else; where the first of the old ones was across that, and
    all of one style. Strips of a few centimetres keep theirs.

    Args:
        model: an object whose fronts look along -y.
        rng: source of randomness.
    """
    style = sample_style(rng, knobs=False)
    kind = _KINDS[int(rng.integers(len(_KINDS)))]
    thickness = min(style.thickness_m * float(rng.uniform(*_THICKER)), _THICKEST * style.reach_m)
    style = replace(style, kind=kind, thickness_m=thickness)
    share = float(rng.uniform(*_SHARE))

    def with_long(link: Link) -> Link:
        old = [part for part in link.parts if part.role in GRIPS]
        others = tuple(part for part in link.parts if part.role not in GRIPS)
        if not (old and others):
            return link
        bounds = np.stack([part.mesh.bounds for part in others])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        at, foot = old[0].mesh.bounds.mean(axis=0), float(old[0].mesh.bounds[1, 1])
        vertical = link.kind == "revolute" and abs(link.axis[2]) > 0.5
        along = 2 if vertical else 0
        at[along] = (low[along] + high[along]) / 2
        length = share * float(high[along] - low[along])
        if length < _SHORTEST_M:
            return link
        # A bowed door is foremost elsewhere.
        reach = style.reach_m + max(0.0, foot - float(low[1]))
        place, room = (float(at[0]), foot, float(at[2])), (0.1, length / 0.8) if vertical else (length / 0.8, 0.1)
        own = replace(style, length_m=length, reach_m=reach)
        return replace(link, parts=(*others, handle_part(own, at=place, vertical=vertical, room_m=room)))

    return replace(model, links=tuple(with_long(link) for link in model.links))
