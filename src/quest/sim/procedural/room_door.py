"""A door of a room: a frame, and a leaf with levers or knobs on both faces."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from quest.sim.procedural.handles import HandleStyle, handle_part, sample_style
from quest.sim.procedural.model import Link, Mesh, ObjectModel, Part, join
from quest.sim.procedural.shapes import box


def build_room_door(rng: np.random.Generator) -> ObjectModel:
    """A door that opens towards its front, hinged at either side; smooth, panelled or with a pane of glass.

    Args:
        rng: source of randomness.
    """
    width, height, thick = float(rng.uniform(0.7, 0.95)), float(rng.uniform(1.9, 2.1)), float(rng.uniform(0.035, 0.05))
    post, deep = float(rng.uniform(0.05, 0.1)), float(rng.uniform(0.1, 0.16))
    left = bool(rng.random() < 0.5)
    sign = -1.0 if left else 1.0
    frame = join([
        box((-width / 2 - post, -0.004, 0), (-width / 2 - 0.003, deep, height + post)),
        box((width / 2 + 0.003, -0.004, 0), (width / 2 + post, deep, height + post)),
        box((-width / 2 - 0.003, -0.004, height + 0.003), (width / 2 + 0.003, deep, height + post)),
    ])  # fmt: skip
    # The leaf from the hinge's edge at x = 0, its outer face at y = 0.
    parts = [replace(p, mesh=p.mesh.moved((0.0 if left else -width, 0, 0))) for p in _leaf(rng, width, height, thick)]
    knob = bool(rng.random() < 0.3)
    style = HandleStyle(
        "knob" if knob else ("lever", "lever", "d_pull", "bar")[int(rng.integers(4))],
        float(rng.uniform(0.11, 0.15)) if not knob else 0.1,
        float(rng.uniform(0.024, 0.03)) if knob else float(rng.uniform(0.014, 0.022)),
        float(rng.uniform(0.05, 0.065)), float(rng.uniform(0.7, 1.2)), sample_style(rng).surface,
    )  # fmt: skip
    upright = style.kind in ("d_pull", "bar")
    if upright:
        style = replace(style, length_m=float(rng.uniform(0.2, 0.5)))
    z, edge = float(rng.uniform(0.95, 1.08)), float(rng.uniform(0.055, 0.07))
    grip = handle_part(style, at=(0, 0, 0), vertical=upright, room_m=(0.9, 0.9))
    if style.kind == "lever":  # its foot is at the left end; at the free edge it points to the hinge
        grip = replace(grip, mesh=grip.mesh.moved((style.length_m / 2 - 0.01, 0, 0)))
        if left:
            grip = replace(grip, mesh=_turned(grip.mesh))
    x = -sign * (width - edge)
    parts.append(replace(grip, mesh=grip.mesh.moved((x, 0, z))))
    behind = np.diag([-1.0, -1.0, 1.0])
    mirrored = _turned(grip.mesh) if style.kind == "lever" else grip.mesh
    parts.append(replace(grip, mesh=mirrored.rotated(behind).moved((x, thick, z))))
    hinge = (sign * (width / 2), -0.005, 0.006)
    opening = float(np.deg2rad(rng.uniform(80, 110)))
    link = Link("link_0", tuple(parts), "revolute", hinge, (0.0, 0.0, sign), opening)
    return ObjectModel("Door", (Part("frame", frame, "body"),), (link,)).moved((0.0, -deep / 2, 0.0))


def _turned(mesh: Mesh) -> Mesh:
    """Half a turn in the plane of the front: what pointed right points left."""
    return mesh.rotated(np.diag([-1.0, 1.0, -1.0]))


def _leaf(rng: np.random.Generator, width: float, height: float, thick: float) -> list[Part]:
    high, kind = height - 0.008, int(rng.integers(4))
    if kind == 0:
        return [Part("door_panel", box((0, 0, 0), (width, thick, high)), "front")]
    stile, rail = float(rng.uniform(0.1, 0.13)), float(rng.uniform(0.12, 0.2))
    rows = 1 if kind == 1 else int(rng.integers(2, 5))
    columns = 1 if kind == 1 else int(rng.integers(1, 3))
    x_edges = np.linspace(stile, width - stile, columns + 1)
    z_edges = np.linspace(rail, high - 0.12, rows + 1)
    half = 0.03
    bars = [
        box((0, 0, 0), (stile, thick, high)), box((width - stile, 0, 0), (width, thick, high)),
        box((stile, 0, 0), (width - stile, thick, rail)), box((stile, 0, high - 0.12), (width - stile, thick, high)),
    ]  # fmt: skip
    bars += [box((stile, 0, z - half), (width - stile, thick, z + half)) for z in z_edges[1:-1]]
    for low, top in pairwise(z_edges):
        lo, hi = low + (half if low > rail else 0), top - (half if top < high - 0.121 else 0)
        bars += [box((x - half, 0, lo), (x + half, thick, hi)) for x in x_edges[1:-1]]
    fill = box((stile, 0.3 * thick, rail), (width - stile, 0.7 * thick, high - 0.12))
    glazed = kind == 1 or rng.random() < 0.25
    return [
        Part("door_panel", join(bars), "front"),
        Part("glass" if glazed else "panel", fill, "glass" if glazed else "front"),
    ]
