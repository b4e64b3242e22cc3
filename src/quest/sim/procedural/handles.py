"""Handles and knobs in many shapes, mounted on a front that looks along -y."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from quest.sim.procedural import handle_shapes
from quest.sim.procedural.handle_shapes import SUNK_M
from quest.sim.procedural.model import Mesh, Part, join
from quest.sim.procedural.shapes import box, centred_box, lathe, tube

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
    """How the handles of one object look.

    Attributes:
        kind: shape.
        length_m: length of a long handle; the diameter of a knob follows ``thickness_m``.
        thickness_m: thickness of the bar, or radius of a knob.
        reach_m: how far it sticks out of the front.
        flatness: height of the bar's section over its width.
        surface: see :data:`quest.sim.procedural.model.SURFACES`.
    """

    kind: HandleKind
    length_m: float
    thickness_m: float
    reach_m: float
    flatness: float
    surface: str

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
        return handle_shapes.cup(min(half, 0.055), thickness, min(reach, 0.032))
    if style.kind == "bow":
        return handle_shapes.bow(half, thickness, reach, style.flatness)
    if style.kind == "d_pull":
        return handle_shapes.d_pull(half, thickness, reach)
    if style.kind == "t_bar":
        return handle_shapes.t_bar(half, thickness, reach)
    if style.kind == "edge_pull":
        return handle_shapes.edge_pull(half, thickness, min(reach, 0.03))
    if style.kind == "loop":
        return handle_shapes.loop(half, reach)
    if style.kind == "lever":
        return handle_shapes.lever(half, thickness, reach, style.flatness)
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
