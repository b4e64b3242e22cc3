"""Dials that turn: rows of knobs on the panels of cookers, ovens, microwaves and washing machines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from quest.sim.procedural.handles import SUNK_M, HandleKind, HandleStyle, handle_part
from quest.sim.procedural.model import HANDLE_ROLES, Link, Mesh, ObjectModel, Part, join
from quest.sim.procedural.shapes import box, lathe

_MARGIN_M = 0.004
_NARROWEST_M = 0.05
_SHAPES: tuple[HandleKind | Literal["cylinder", "turned"], ...] = (
    "knob", "disc", "block", "cylinder", "turned", "turned",
)  # fmt: skip
_SURFACES = ("dark", "metal", "white", "body", "front")


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

    def turned(self, mesh: Mesh) -> Mesh:
        """What is drawn for an upright panel, leant back with this one."""
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        return mesh.rotated(np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]]))

    def at(self, across: float, up: float) -> tuple[float, float, float]:
        """A point of its face in the object's frame; ``across`` from its middle, ``up`` from its foot, metres."""
        x, y, z = self.foot
        return (x + across, y + up * float(np.sin(self.tilt)), z + up * float(np.cos(self.tilt)))

    @property
    def out(self) -> tuple[float, float, float]:
        """Unit direction away from its face."""
        return (0.0, -float(np.cos(self.tilt)), float(np.sin(self.tilt)))


def with_dials(model: ObjectModel, rng: np.random.Generator) -> ObjectModel:
    """The object with a panel of one to seven dials, each a link that turns; painted ones (``dial``) are gone.

    The panel lies above or beside the doors where the front has room there, else, and at times anyway, stands on top at
    the back.

    Args:
        model: an object whose fronts look along -y.
        rng: source of randomness.
    """
    model = replace(model, body=tuple(part for part in model.body if part.role != "dial"))
    panels = _free_panels(model, rng)
    panel = panels[int(rng.integers(len(panels)))]
    face = box((-panel.width / 2, 0.0, 0.0), (panel.width / 2, panel.depth, panel.height))
    body = [Part("control_panel", panel.turned(face).moved(panel.foot), str(rng.choice(_SURFACES)))]
    row = panel.width >= panel.height
    long, short = (panel.width, panel.height) if row else (panel.height, panel.width)
    radius = min(float(rng.uniform(0.013, 0.034)), 0.36 * short)
    offsets = _places(long, radius, rng)
    level = float(rng.uniform(0.4, 0.6)) * short
    if rng.random() < 0.5:
        body += _displays(panel, offsets, radius, row=row)
    mesh, surface = _dial(radius, rng), str(rng.choice(_SURFACES))
    links = list(model.links)
    for offset in offsets:
        across, up = (offset, level) if row else (level - short / 2, offset + long / 2)
        turned = panel.turned(mesh)
        upper = float(np.deg2rad(rng.uniform(90, 300)))
        part = Part("knob", turned, surface)
        links.append(Link(f"link_{len(links)}", (part,), "revolute", panel.at(across, up), panel.out, upper))
    return ObjectModel(model.model_cat, (*model.body, *body), tuple(links))


def _free_panels(model: ObjectModel, rng: np.random.Generator) -> list[_Panel]:
    """Where the front has room for a panel, and one on top at the back."""
    body = np.concatenate([part.mesh.vertices for part in model.body])
    low, high = body.min(axis=0), body.max(axis=0)
    fronts = np.concatenate([
        part.mesh.vertices + link.origin for link in model.links for part in link.parts if part.role not in HANDLE_ROLES
    ])  # fmt: skip
    near, far = fronts.min(axis=0), fronts.max(axis=0)
    front = min(float(low[1]), float(near[1])) - float(rng.uniform(0.001, 0.015))
    middle = float(low[0] + high[0]) / 2
    panels = [
        _Panel(
            float(high[0] - low[0]), float(rng.uniform(0.08, 0.22)),
            (middle, float(high[1]) - float(rng.uniform(0.06, 0.12)), float(high[2]) - _MARGIN_M),
            tilt=max(0.0, float(rng.uniform(-0.3, 0.6))),
        )
    ]  # fmt: skip
    above = float(high[2] - far[2]) - 2 * _MARGIN_M
    if above > _NARROWEST_M:
        foot = (middle, front, float(far[2]) + _MARGIN_M)
        panels.append(_Panel(float(high[0] - low[0]) - 2 * _MARGIN_M, above, foot))
    for inner, outer in ((far[0], high[0]), (near[0], low[0])):
        beside = abs(float(outer - inner)) - 2 * _MARGIN_M
        if beside > _NARROWEST_M:
            foot = (float(inner + outer) / 2, front, float(low[2]) + _MARGIN_M)
            panels.append(_Panel(beside, float(high[2] - low[2]) - 2 * _MARGIN_M, foot))
    return panels


def _places(long: float, radius: float, rng: np.random.Generator) -> list[float]:
    """Where along a panel dials sit, from its middle: evenly over all of it, close together, or in two groups."""
    gap = radius * float(rng.uniform(2.6, 5.0))
    most = max(1, min(7, int((long - 2 * radius) / gap)))
    count = int(rng.integers(1, most + 1))
    free = max(0.0, long - 2.4 * radius - (count - 1) * gap)
    way = str(rng.choice(["spread", "tight", "groups"]))
    if count > 1 and way == "spread":
        return [float(x) for x in np.linspace(-0.5, 0.5, count) * (long - 3 * radius)]
    steps = np.arange(count) * gap
    if count > 2 and way == "groups":
        steps[count // 2 :] += float(rng.uniform(0.3, 1.0)) * free
    shift = float(rng.uniform(-0.5, 0.5)) * max(0.0, long - 2.4 * radius - float(steps[-1]))
    return [float(x) for x in steps - steps[-1] / 2 + shift]


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
    mesh = panel.turned(box((-size[0], -0.002, -size[1]), (size[0], SUNK_M, size[1])))
    return [Part("display", mesh.moved(panel.at(across, up)), "dark")]


def _dial(radius: float, rng: np.random.Generator) -> Mesh:
    """A dial on y = 0 that reaches towards -y: a knob, a cylinder, or a disc with a bar to turn it by."""
    reach = float(rng.uniform(0.6, 1.3)) * radius
    kind = _SHAPES[int(rng.integers(len(_SHAPES)))]
    if kind == "cylinder":
        profile = [[1.0, -SUNK_M], [float(rng.uniform(0.8, 1.0)), 0.9 * reach], [0.8, reach]]
        return lathe(np.array([[radius * r, h] for r, h in profile]))
    if kind == "turned":
        foot = lathe(np.array([[radius, -SUNK_M], [radius, 0.25 * reach], [0.9 * radius, 0.4 * reach]]))
        half = radius * float(rng.uniform(0.15, 0.3))
        bar = box((-0.95 * radius, -reach, -half), (0.95 * radius, -0.2 * reach, half))
        angle = float(rng.choice([0.0, np.pi / 2, float(rng.uniform(0, np.pi))]))
        cos, sin = np.cos(angle), np.sin(angle)
        return join([foot, bar.rotated(np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]))])
    style = HandleStyle(kind, radius, radius, reach, 1.0, "dark")
    return handle_part(style, at=(0.0, 0.0, 0.0), vertical=False, room_m=(4 * radius, 4 * radius)).mesh
