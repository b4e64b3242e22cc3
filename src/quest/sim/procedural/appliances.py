"""Appliances that scene-synthesizer lacks, and dials that turn.

The appliances are a dishwasher whose racks slide, an oven over a drawer and a washing machine. Dials are rows of knobs
on the panels of cookers, ovens, microwaves and washing machines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float

from quest.sim.procedural.handles import SUNK_M, HandleKind, HandleStyle, handle_part, sample_any_style
from quest.sim.procedural.model import Dice, Link, ObjectModel, Part
from quest.sim.procedural.shapes import Mesh, box, boxes, copies, join, lathe, prism_between, walls

_MARGIN_M = 0.004
_NARROWEST_M = 0.05
_SHAPES: tuple[HandleKind | Literal["cylinder", "turned"], ...] = (
    "knob", "disc", "block", "cylinder", "turned", "turned",
)  # fmt: skip
_DIAL_SURFACES = ("dark", "metal", "white", "body", "front")


@dataclass(frozen=True)
class _Panel:
    """Where dials sit."""

    width: float
    """Along x, metres."""
    height: float
    """Along its own upright, metres."""
    foot: tuple[float, float, float]
    """The middle of its lower front edge, in the object's frame."""
    tilt: float = 0.0
    """How far it leans back, radians."""
    depth: float = 0.05
    """How thick it is, metres."""

    def at(self, across: float, up: float) -> tuple[float, float, float]:
        """A point of its face in the object's frame; ``across`` from its middle, ``up`` from its foot, metres."""
        x, y, z = self.foot
        return (x + across, y + up * float(np.sin(self.tilt)), z + up * float(np.cos(self.tilt)))


def with_dials(model: ObjectModel, rng: Dice) -> ObjectModel:
    """The object with a panel of one to seven dials, each a link that turns; painted ones (``dial``) are gone.

    Its fronts look along -y. The panel lies above or beside the doors where the front has room there, else, and at
    times anyway, stands on top at the back.
    """
    model = replace(model, body=tuple(part for part in model.body if part.role != "dial"))
    panels = _free_panels(model, rng)
    panel = rng.pick(panels)
    face = box((-panel.width / 2, 0.0, 0.0), (panel.width / 2, panel.depth, panel.height))
    body = [Part("control_panel", face.tilted(-panel.tilt).moved(panel.foot), rng.pick(_DIAL_SURFACES))]
    row = panel.width >= panel.height
    long, short = (panel.width, panel.height) if row else (panel.height, panel.width)
    radius = min(rng.real(0.013, 0.034), 0.36 * short)
    offsets = _places(long, radius, rng)
    level = rng.real(0.4, 0.6) * short
    if rng.chance(0.5):
        body += _displays(panel, offsets, radius, row=row)
    mesh, surface = _dial(radius, rng), rng.pick(_DIAL_SURFACES)
    part = Part("knob", mesh.tilted(-panel.tilt), surface)
    out = (0.0, -float(np.cos(panel.tilt)), float(np.sin(panel.tilt)))
    places = [(offset, level) if row else (level - short / 2, offset + long / 2) for offset in offsets]
    dials = [Link((part,), "revolute", panel.at(*place), out, rng.angle(90, 300)) for place in places]
    return ObjectModel(model.model_cat, (*model.body, *body), (*model.links, *dials))


def _free_panels(model: ObjectModel, rng: Dice) -> list[_Panel]:
    """Where the front has room for a panel, and one on top at the back."""
    low, high = join([part.mesh for part in model.body]).bounds.tolist()
    fronts = [part.mesh.moved(link.origin) for link in model.links for part in link.rest]
    near, far = join(fronts).bounds.tolist()
    front, width = min(low[1], near[1]) - rng.real(0.001, 0.015), high[0] - low[0]
    middle = (low[0] + high[0]) / 2
    tall = rng.real(0.08, 0.22)
    foot = (middle, high[1] - rng.real(0.06, 0.12), high[2] - _MARGIN_M)
    panels = [_Panel(width, tall, foot, tilt=max(0.0, rng.real(-0.3, 0.6)))]
    above = high[2] - far[2] - 2 * _MARGIN_M
    if above > _NARROWEST_M:
        panels.append(_Panel(width - 2 * _MARGIN_M, above, (middle, front, far[2] + _MARGIN_M)))
    for inner, outer in ((far[0], high[0]), (near[0], low[0])):
        beside = abs(outer - inner) - 2 * _MARGIN_M
        if beside > _NARROWEST_M:
            foot = ((inner + outer) / 2, front, low[2] + _MARGIN_M)
            panels.append(_Panel(beside, high[2] - low[2] - 2 * _MARGIN_M, foot))
    return panels


def _places(long: float, radius: float, rng: Dice) -> list[float]:
    """Where along a panel dials sit, from its middle: evenly over all of it, close together, or in two groups."""
    gap = radius * rng.real(2.6, 5.0)
    most = max(1, min(7, int((long - 2 * radius) / gap)))
    count = rng.whole(1, most + 1)
    free = max(0.0, long - 2.4 * radius - (count - 1) * gap)
    way = rng.pick(["spread", "tight", "groups"])
    if count > 1 and way == "spread":
        return (np.linspace(-0.5, 0.5, count) * (long - 3 * radius)).tolist()
    steps = np.arange(count) * gap
    if count > 2 and way == "groups":
        steps[count // 2 :] += rng.real(0.3, 1.0) * free
    shift = rng.real(-0.5, 0.5) * max(0.0, long - 2.4 * radius - float(steps[-1]))
    return (steps - steps[-1] / 2 + shift).tolist()


def _displays(panel: _Panel, offsets: list[float], radius: float, *, row: bool) -> list[Part]:
    """A display in the widest gap between dials, or between them and an end, where there is room for one."""
    long, short = (panel.width, panel.height) if row else (panel.height, panel.width)
    ends = [-long / 2, *sorted(offsets), long / 2]
    wide, start = max((b - a, a) for a, b in pairwise(ends))
    if wide < 4 * radius + 0.05:
        return []
    half, middle, tall = wide / 2 - 2 * radius, start + wide / 2, 0.25 * short
    size = (half, tall) if row else (tall, half)
    across, up = (middle, short / 2) if row else (0.0, middle + long / 2)
    mesh = box((-size[0], -0.002, -size[1]), (size[0], SUNK_M, size[1])).tilted(-panel.tilt)
    return [Part("display", mesh.moved(panel.at(across, up)), "dark")]


def _dial(radius: float, rng: Dice) -> Mesh:
    """A dial on y = 0 that reaches towards -y: a knob, a cylinder, or a disc with a bar to turn it by."""
    reach = rng.real(0.6, 1.3) * radius
    kind = rng.pick(_SHAPES)
    if kind == "cylinder":
        return lathe([[radius, -SUNK_M], [radius * rng.real(0.8, 1.0), 0.9 * reach], [radius * 0.8, reach]])
    if kind == "turned":
        foot = lathe([[radius, -SUNK_M], [radius, 0.25 * reach], [0.9 * radius, 0.4 * reach]])
        half = radius * rng.real(0.15, 0.3)
        bar = box((-0.95 * radius, -reach, -half), (0.95 * radius, -0.2 * reach, half))
        angle = rng.pick([0.0, np.pi / 2, rng.real(0, np.pi)])
        cos, sin = np.cos(angle), np.sin(angle)
        return join([foot, bar.rotated(np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]))])
    style = HandleStyle(kind, radius, radius, reach, 1.0, "dark")
    return handle_part(style, at=(0, 0, 0), vertical=False, room_m=(4 * radius, 4 * radius)).mesh


_WASHER_GRIPS: tuple[HandleKind, ...] = ("bow", "d_pull", "arched")
_SURFACES = ("white", "metal", "dark", "body")


def _handle(rng: Dice, scale: float) -> HandleStyle:
    """A handle that fits an appliance's door."""
    style = sample_any_style(rng, knobs=False, scale=scale)
    if style.kind in ("loop", "t_bar", "cup"):
        style = replace(style, kind="d_pull" if rng.chance(0.5) else "bow")
    return replace(style, surface=rng.pick(["metal", "dark", "white"], p=[0.6, 0.25, 0.15]))


def _shell(width: float, depth: float, low: float, high: float, wall: float) -> Mesh:
    """A box that is open at the front, y = 0."""
    return walls((0, 0, low), (width, depth, high), wall, "-x +x -z +z +y")


def _tray(width: float, depth: float, height: float) -> Mesh:
    """A box that is open above, from (0, 0, 0)."""
    return _shell(width, height, 0.0, depth, 0.006).turned("up").moved((0, 0, height))


def _flap(width: float, height: float, thick: float, window: float, surface: str) -> list[Part]:
    """A door from (0, 0) to (width, height), outer face at y = 0, with a window of some share of it, or none."""
    panel = box((0, 0, 0), (width, thick, height))
    if not window:
        return [Part("door_panel", panel, surface)]
    x, z = (1 - window) / 2 * width, 0.45 * (1 - window) * height
    pane = box((x, -0.0015, z), (width - x, 0.001, z + window * height * 0.85))
    return [Part("door_panel", panel, surface), Part("window", pane, "glass")]


def _rack(rng: Dice, width: float, depth: float, height: float) -> Mesh:
    """A basket of wires from (0, 0, 0), its front at y = 0."""
    wire, gap = 0.004, rng.real(0.035, 0.06)
    rods = [walls((0, 0, z), (width, depth, z + 2 * wire), 2 * wire, "-y +y -x +x") for z in (0.0, height)]
    for x in np.arange(gap, width - gap / 2, gap):
        rods.append(box((x, 2 * wire, 0), (x + wire, depth - 2 * wire, wire)))
        rods += [box((x, y, 2 * wire), (x + wire, y + wire, height)) for y in (wire / 2, depth - 1.5 * wire)]
    for y in np.arange(2 * gap, depth - gap, 2 * gap):
        rods += [box((x, y, 2 * wire), (x + wire, y + wire, height)) for x in (wire / 2, width - 1.5 * wire)]
    return join(rods)


def rack_dishwasher(rng: Dice) -> ObjectModel:
    """A dishwasher whose door folds down, and two racks behind it that slide out."""
    width, height, depth = rng.real(0.45, 0.62), rng.real(0.8, 0.88), rng.real(0.55, 0.62)
    plinth, thick, wall = rng.real(0.08, 0.14), rng.real(0.03, 0.05), 0.03
    surface = rng.pick(_SURFACES)
    inside, deep = width - 2 * wall, depth - wall
    rack_w, rack_d, rack_h = inside - 0.02, deep - 0.06, rng.real(0.1, 0.15)
    low = plinth + wall + 0.05
    high = low + rng.real(0.27, 0.33)
    body = [
        Part("frame", _shell(width, depth, plinth, height, wall), surface),
        Part("base", box((0.01, 0.06, 0), (width - 0.01, depth - 0.01, plinth)), "dark"),
    ]
    corners = [(x, z) for x in (wall, width - wall - 0.006) for z in (low, high)]
    rails = boxes(*(((x, 0.03, z - 0.012), (x + 0.006, deep, z)) for x, z in corners))
    body.append(Part("rail", rails, "metal"))
    door_h = height - plinth - 0.01
    parts = _flap(width - 0.006, door_h, thick, 0.0, surface)
    style, edge = _handle(rng, 1.6), rng.real(0.05, 0.09)
    at, room = (width / 2, 0.0, door_h - 0.04 - edge / 2), (0.95 * width, 2 * edge)
    parts.append(handle_part(style, at=at, vertical=False, room_m=room))
    panel = box((0.004, -0.001, door_h - 0.035), (width - 0.01, 0.001, door_h - 0.004))
    parts.append(Part("decal", panel, "dark"))
    hinge = (0.003, -thick - 0.001, plinth + 0.005)
    links = [Link(tuple(parts), "revolute", hinge, (1.0, 0.0, 0.0), rng.angle(82, 91))]
    for z in (low, high):
        rack = Part("rack", _rack(rng, rack_w, rack_d, rack_h), "metal")
        bar = box((0.3 * rack_w, -0.014, rack_h - 0.012), (0.7 * rack_w, 0.0, rack_h + 0.006))
        handle = Part("handle", bar, rng.pick(["dark", "white"]))
        links.append(Link((rack, handle), "prismatic", (wall + 0.01, 0.03, z), (0.0, -1.0, 0.0), 0.8 * rack_d))
    return ObjectModel("Dishwasher", tuple(body), tuple(links)).centred(width, depth)


def drawer_oven(rng: Dice) -> ObjectModel:
    """A cooker: a hob and dials above an oven's door that folds down, above a drawer."""
    width, height, depth = rng.real(0.5, 0.76), rng.real(0.84, 0.94), rng.real(0.56, 0.66)
    wall, thick = 0.035, rng.real(0.03, 0.05)
    store, dials = rng.real(0.16, 0.22), rng.real(0.08, 0.12)
    surface = rng.pick(_SURFACES)
    foot, roof = 0.04, height - dials
    body = [
        Part("frame", join([
            _shell(width, depth, foot, foot + store, 0.02), _shell(width, depth, foot + store, roof, wall),
            box((0, -thick, roof), (width, depth, height)),
        ]), surface),
        Part("base", box((0.02, 0.05, 0), (width - 0.02, depth - 0.02, foot)), "dark"),
    ]  # fmt: skip
    plates = [
        lathe([[r, -0.001], [r, 0.008], [0.6 * r, 0.01]], sides=24).turned("up").moved((x, y, height))
        for x, r in ((0.27 * width, 0.075), (0.73 * width, 0.095)) for y in (0.27 * depth, 0.72 * depth)
    ]  # fmt: skip
    body.append(Part("hob", join(plates), "dark"))
    dial = lathe([[0.02, -0.001], [0.02, 0.012], [0.014, 0.014], [0.013, 0.026]])
    places = np.linspace(0.15, 0.85, rng.whole(4, 7)) * width
    body.append(Part("dial", copies(dial, [(x, -thick, roof + dials / 2) for x in places]), "metal"))
    rack = _rack(rng, width - 2 * wall, depth - 2 * wall, 0.01).moved((wall, wall, foot + store + 0.2))
    body.append(Part("shelf", rack, "metal"))
    style, gap = _handle(rng, 1.7), 0.006
    door_w, door_h = width - gap, roof - foot - store - gap
    parts = _flap(door_w, door_h, thick, rng.real(0.5, 0.72), surface)
    parts.append(handle_part(style, at=(door_w / 2, 0, door_h - 0.045), vertical=False, room_m=(0.95 * door_w, 0.07)))
    hinge = (gap / 2, -thick - 0.001, foot + store + gap / 2)
    oven = Link(tuple(parts), "revolute", hinge, (1.0, 0.0, 0.0), rng.angle(82, 91))
    tray = _tray(width - 0.06, depth - 0.1, 0.6 * store).moved((0.03 - gap / 2, thick, 0.02))
    front = box((0, 0, 0), (door_w, thick, store - gap))
    low = handle_part(style, at=(door_w / 2, 0, 0.65 * store), vertical=False, room_m=(0.95 * door_w, 0.6 * store))
    drawer = (Part("drawer_front", front, surface), Part("drawer_box", tray, "inside"), low)
    slide = (gap / 2, -thick - 0.001, foot + gap / 2)
    links = (oven, Link(drawer, "prismatic", slide, (0.0, -1.0, 0.0), 0.7 * depth))
    return ObjectModel("Oven", tuple(body), links).centred(width, depth)


def _round_door(
    rng: Dice, style: HandleStyle, circle: Float[np.ndarray, "P 2"], radius: float, middle: tuple[float, float],
    surface: str,
) -> Link:  # fmt: skip
    """A round door of glass around a point (x, z) of the front, hinged at either side, with a grip at the other."""
    sign = -1.0 if rng.chance(0.7) else 1.0
    # In the frame of its hinge, the door's middle lies at (-sign * reach, 0).
    reach = radius + 0.012
    shift = (-sign * reach, 0.0, 0.0)
    ring = prism_between(circle * radius, circle * 0.72 * radius, 0.0, 0.035, closed=True).turned("front")
    r = 0.74 * radius
    glass = lathe([[r, -0.02], [r, 0.012], [0.85 * r, 0.022], [0.5 * r, 0.032], [0.15 * r, 0.036]], sides=32)
    grip = handle_part(style, at=(-sign * 0.86 * radius, -0.035, 0.0), vertical=True, room_m=(0.1, 0.16))
    parts = (
        Part("door_panel", ring.moved(shift), rng.pick(["metal", "dark", surface])),
        Part("glass", glass.moved(shift), "glass"),
        Part("handle", grip.mesh.moved(shift), grip.surface),
    )
    hinge = (middle[0] + sign * reach, -0.001, middle[1])
    return Link(parts, "revolute", hinge, (0.0, 0.0, sign), rng.angle(95, 125))


def washing_machine(rng: Dice) -> ObjectModel:
    """A washing machine: a round glass door hinged at one side, and a drawer for the powder."""
    width, height, depth = 0.6, rng.real(0.82, 0.88), rng.real(0.45, 0.62)
    surface = rng.pick(["white", "white", "metal", "dark"])
    radius, wall = rng.real(0.15, 0.19), 0.02
    x, z = width / 2, rng.real(0.4, 0.46)
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    square = circle / np.abs(circle).max(axis=1, keepdims=True)
    panel_low, panel_high = 0.06, height - 0.13
    half = np.array([width / 2 - wall, (panel_high - panel_low) / 2])
    middle = np.array([x, (panel_low + panel_high) / 2])
    hole = circle * (radius - 0.025) + [x, z]
    plate = prism_between(square * half + middle, hole, -wall, 0.0, closed=True).turned("front")
    tub = prism_between(circle * (radius - 0.02) + [x, z], hole, -0.3, -wall, closed=True).turned("front")
    back = lathe([[radius - 0.02, 0.0], [radius - 0.02, 0.004]], sides=36).moved((x, 0.3, z))
    body = [
        Part("frame", join([
            box((0, 0, 0.02), (wall, depth, height)), box((width - wall, 0, 0.02), (width, depth, height)),
            box((wall, 0, 0.02), (width - wall, depth, panel_low)),
            box((wall, 0, height - 0.02), (width - wall, depth, height)), plate,
            box((wall, depth - wall, panel_low), (width - wall, depth, height - 0.02)),
        ]), surface),
        Part("drum", join([tub, back]), "metal"),
    ]  # fmt: skip
    drawer_w, strip = 0.17, 0.105
    z0 = height - 0.02 - strip
    panel = box((wall + drawer_w + 0.008, -0.004, z0), (width - wall, 0.02, z0 + strip))
    body.append(Part("control_panel", panel, "dark"))
    dial = lathe([[0.03, -0.001], [0.028, 0.02], [0.024, 0.022]], sides=24)
    body.append(Part("dial", dial.moved((rng.real(0.5, 0.8) * width, -0.004, z0 + strip / 2)), "metal"))
    kind, reach = rng.pick(_WASHER_GRIPS), rng.real(0.024, 0.036)
    style = HandleStyle(kind, 0.11, 0.014, reach, 1.0, rng.pick(["dark", "metal", "white"]))
    door = _round_door(rng, style, circle, radius, (x, z), surface)
    tray = _tray(drawer_w - 0.01, 0.2, strip - 0.03).moved((0.005, 0.02, 0.01))
    edge = replace(style, kind="edge_pull", length_m=0.12, reach_m=0.02)
    lip = handle_part(edge, at=(drawer_w / 2, 0, 0.6 * strip), vertical=False, room_m=(drawer_w, strip))
    front = box((0, 0, 0), (drawer_w, 0.02, strip))
    drawer = (Part("drawer_front", front, surface), Part("drawer_box", tray, "inside"), lip)
    slide = (wall + 0.004, -0.004, z0)
    links = (door, Link(drawer, "prismatic", slide, (0.0, -1.0, 0.0), 0.16))
    return ObjectModel("WashingMachine", tuple(body), links).centred(width, depth, -0.02)
