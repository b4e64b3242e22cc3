"""What is on and around furniture and appliances without being anything to take hold of by.

Vents, keypads, displays, badges and mouldings on fronts; legs below, an open shelf beside, bottles and boxes on top.
Without them whatever stands out or makes an edge on a plain front is a handle.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from quest.sim.procedural.model import Dice, Link, ObjectModel, Part
from quest.sim.procedural.shapes import Mesh, box, boxes, copies, join, lathe, walls

_SUNK_M = 0.001
_MARGIN_M = 0.02
_TRIES = 6
_ACROSS = np.array([1.0, 0.0, 1.0])

Rect = tuple[float, float, float, float]
"""Least x and z, greatest x and z."""


def with_clutter(model: ObjectModel, rng: Dice) -> ObjectModel:
    """The object with things that are no handles; nothing of it moves otherwise than before.

    Its fronts look along -y, and it stands on the ground.
    """
    links = tuple(_decorated(link, rng) for link in model.links)
    low, high = join([part.mesh for part in model.body]).bounds
    body = [*model.body, *things_on(low, high, rng)]
    if rng.chance(0.4):
        body.append(_shelf(low, high, rng))
    model = ObjectModel(model.model_cat, tuple(body), links)
    if rng.chance(0.4):
        height = rng.real(0.05, 0.3) * min(1.0, float(high[2] - low[2]))
        raised = model.moved((0.0, 0.0, height))
        model = replace(raised, body=(*raised.body, _legs(low, high, height, rng)))
    return model


def _decorated(link: Link, rng: Dice) -> Link:
    """The link with none to three things on its front, away from its handles."""
    if not link.rest:
        return link
    bounds = [part.mesh.bounds for part in link.rest]
    low, high = max(bounds, key=lambda each: np.prod(np.ptp(each, axis=0)[[0, 2]]))
    taken = [_rect(part.mesh) for part in link.grips]
    added: list[Part] = []
    for _ in range(rng.whole(0, 4)):
        width, height = (high - low)[[0, 2]]
        kind = rng.pick(["vent", "keypad", "display", "badge"])
        share = {"vent": (0.3, 0.8), "keypad": (0.12, 0.3), "display": (0.15, 0.5), "badge": (0.06, 0.2)}[kind]
        w = rng.real(*share) * width
        h = min(w * rng.real(*((0.15, 0.5) if kind != "keypad" else (0.8, 1.8))), 0.8 * height)
        for _ in range(_TRIES):
            x = rng.real(low[0] + w / 2, high[0] - w / 2)
            z = rng.real(low[2] + h / 2, high[2] - h / 2)
            place = (x - w / 2, z - h / 2, x + w / 2, z + h / 2)
            if not any(_overlap(place, other) for other in taken):
                taken.append(place)
                added.append(_ornament(kind, place, float(low[1]), rng))
                break
    if rng.chance(0.2) and min(high[0] - low[0], high[2] - low[2]) > 0.12:
        added.append(Part("moulding", _moulding(low, high), "front"))
    return replace(link, parts=(*link.parts, *added))


def _ornament(kind: str, place: Rect, front: float, rng: Dice) -> Part:
    x0, z0, x1, z1 = place
    if kind in ("display", "badge"):
        out, surface = (0.002, "dark") if kind == "display" else (0.004, "metal")
        return Part(kind, box((x0, front - out, z0), (x1, front + _SUNK_M, z1)), surface)
    if kind == "vent":
        rows = rng.whole(3, 10)
        edges = np.linspace(z0, z1, 2 * rows)
        out = rng.real(0.002, 0.008)
        slats = boxes(*(((x0, front - out, low), (x1, front + _SUNK_M, high)) for low, high in edges.reshape(-1, 2)))
        return Part(kind, slats, rng.pick(["dark", "metal", "front"]))
    columns, rows = 3, rng.whole(3, 6)
    across, up = np.linspace(x0, x1, 3 * columns).reshape(-1, 3), np.linspace(z0, z1, 3 * rows).reshape(-1, 3)
    keys = boxes(*(
        ((left, front - 0.003, below), (right, front + _SUNK_M, above))
        for left, _, right in across for below, _, above in up
    ))  # fmt: skip
    return Part(kind, keys, rng.pick(["dark", "white", "metal"]))


def _moulding(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Mesh:
    """A frame a little inside the edges of a front."""
    (x0, front, z0), (x1, _, z1) = low + _MARGIN_M * _ACROSS, high - _MARGIN_M * _ACROSS
    return walls((x0, front - 0.006, z0), (x1, front + _SUNK_M, z1), 0.012, "-z +z -x +x")


def things_on(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], rng: Dice) -> list[Part]:
    """None to three bottles and boxes on top of a bounding box, metres, z up."""
    things: list[Part] = []
    for _ in range(rng.whole(0, 4)):
        radius, height = rng.real(0.025, 0.07), rng.real(0.06, 0.28)
        x, y = (rng.real(low[i] + radius, high[i] - radius) for i in (0, 1))
        if rng.chance(0.5):
            neck = rng.real(0.3, 1.0) * radius
            profile = [[radius, 0.0], [radius, 0.6 * height], [neck, 0.8 * height], [neck, height]]
            mesh = lathe(profile).turned("up")
        else:
            deep = radius * rng.real(0.4, 1.0)
            mesh = box((-radius, -deep, 0.0), (radius, deep, height))
        things.append(Part("thing", mesh.moved((x, y, float(high[2]))), rng.pick(["white", "dark", "metal"])))
    return things


def _shelf(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], rng: Dice) -> Part:
    """An open case with shelves beside the object, as deep and nearly as high."""
    board, wide = rng.real(0.012, 0.025), rng.real(0.2, 0.5) * max(0.5, float(high[2] - low[2]))
    x0 = float(high[0]) + 0.004 if rng.chance(0.5) else float(low[0]) - 0.004 - wide
    x1, y0, y1, z0, z1 = x0 + wide, float(low[1]), float(high[1]), float(low[2]), float(high[2])
    levels = np.linspace(z0, z1 - board, rng.whole(3, 7))
    sides = walls((x0, y0, z0), (x1, y1, z1), board, "-x +x")
    shelves = boxes(*(((x0 + board, y0, z), (x1 - board, y1, z + board)) for z in levels))
    back = box((x0 + board, y1 - 0.5 * board, z0), (x1 - board, y1, z1))
    return Part("shelf_case", join([sides, shelves, back]), "body")


def _legs(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], height: float, rng: Dice) -> Part:
    """Four legs under the corners, turned or square."""
    half = rng.real(0.012, 0.03)
    if rng.chance(0.6):
        thin, bulge = half * rng.real(0.4, 0.8), half * rng.real(0.8, 1.0)
        shape = [[thin, 0.0], [thin, 0.3], [bulge, 0.5], [thin, 0.65], [half, 0.9], [half, 1.0]]
        leg = lathe(np.array(shape) * [1.0, height]).turned("up")
    else:
        leg = box((-half, -half, 0.0), (half, half, height))
    corners = [(x, y, low[2]) for x in (low[0] + half, high[0] - half) for y in (low[1] + half, high[1] - half)]
    return Part("leg", copies(leg, corners), "body")


def _rect(mesh: Mesh) -> Rect:
    (x0, _, z0), (x1, _, z1) = mesh.bounds
    return (x0 - _MARGIN_M, z0 - _MARGIN_M, x1 + _MARGIN_M, z1 + _MARGIN_M)


def _overlap(a: Rect, b: Rect) -> bool:
    return bool(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3])
