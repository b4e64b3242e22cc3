"""Tables whose drawers are in the apron under the top, where hardly a seam tells them from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from quest.sim.procedural.furniture import Cell, carcass, drawer, sample_front_style
from quest.sim.procedural.handles import sample_any_style
from quest.sim.procedural.model import Mesh, ObjectModel, Part, join
from quest.sim.procedural.shapes import UP, box, lathe

_SEAMLESS_SHARE = 0.7
_SHELF_SHARE = 0.25


def build_apron_table(rng: np.random.Generator) -> ObjectModel:
    """A writing, console or coffee table with one to four flat drawers in a row in its apron.

    Args:
        rng: source of randomness.
    """
    low = bool(rng.random() < 0.4)
    width = float(rng.uniform(0.8, 1.3) if low else rng.uniform(0.9, 1.9))
    height = float(rng.uniform(0.34, 0.52) if low else rng.uniform(0.68, 0.8))
    depth = float(rng.uniform(0.4, 0.8))
    top, over = float(rng.uniform(0.015, 0.05)), float(rng.choice([0.0, 0.02, 0.05]) + rng.uniform(0.0, 0.02))
    under = height - top
    base, inset = _legs(rng, width, depth, under)
    apron, board = float(rng.uniform(0.06, 0.17)), 0.01
    count = int(rng.choice([1, 2, 3, 4], p=[0.25, 0.3, 0.3, 0.15] if width > 1.0 else [0.4, 0.4, 0.2, 0.0]))
    # Beside the drawers the apron goes on, seldom far.
    side = inset + float(rng.choice([0.0, 0.0, rng.uniform(0.02, 0.2)])) * (width - 2 * inset)
    edges = np.linspace(side, width - side, count + 1)
    cells = [Cell((float(a), under - apron), (float(b), under - board / 2), "drawer") for a, b in pairwise(edges)]
    seamless = bool(rng.random() < _SEAMLESS_SHARE)
    style = replace(
        sample_front_style(rng, sample_any_style(rng)), overlay=True, panelled=False, two_from_m=9.0,
        board_m=float(rng.uniform(0.012, 0.02)), gap_m=float(rng.uniform(0.0004, 0.002 if seamless else 0.006)),
    )  # fmt: skip
    links = []
    for n, cell in enumerate(cells):
        link = drawer(f"link_{n}", cell, style, depth_m=depth, board_m=board, bare=False)
        front, *rest = link.parts
        links.append(replace(link, parts=(replace(front, surface="body"), *rest)) if seamless else link)
    # The fronts lie before the carcass; what is beside them is as far out.
    out, bottom = -style.board_m - 0.001, under - apron
    rails = [
        box((0.01, 0.01, bottom), (0.025, depth - 0.01, under)),
        box((width - 0.025, 0.01, bottom), (width - 0.01, depth - 0.01, under)),
        box((0.025, depth - 0.02, bottom), (width - 0.025, depth - 0.005, under)),
    ]
    if side > inset + 0.001:
        rails += [
            box((inset, out, bottom), (side - 0.0002, 0.0, under)),
            box((width - side + 0.0002, out, bottom), (width - inset, 0.0, under)),
        ]
    slab = box((-over, out - over, under), (width + over, depth + over, height))
    body = [*carcass(cells, depth_m=depth - 0.02, board_m=board), Part("frame", join(rails), "body"), *base]
    body.append(Part("top", slab, "body" if rng.random() < 0.6 else "front"))
    return ObjectModel("Table", tuple(body), tuple(links)).moved((-width / 2, -depth / 2, 0.0))


def _legs(rng: np.random.Generator, width: float, depth: float, under: float) -> tuple[list[Part], float]:
    """What carries the top, and how far from either end it leaves no room for drawers."""
    if rng.random() < 0.15:
        board = float(rng.uniform(0.02, 0.05))
        ends = [box((x, -0.01, 0.0), (x + board, depth, under)) for x in (0.0, width - board)]
        return [Part("leg", join(ends), "body")], board + 0.002
    side = float(rng.uniform(0.035, 0.08))
    turned = bool(rng.random() < 0.4)
    leg = _turned(rng, side, under) if turned else box((0.0, -side / 2, 0.0), (side, side / 2, under))
    at = [(x, y) for x in (0.0, width - side) for y in (side / 2 - 0.015, depth - side / 2)]
    parts = [Part("leg", join([leg.moved((x, y, 0.0)) for x, y in at]), "body")]
    if rng.random() < _SHELF_SHARE:
        z = float(rng.uniform(0.15, 0.35)) * under
        shelf = box((side / 2, side / 2, z), (width - side / 2, depth - side / 2, z + 0.015))
        parts.append(Part("shelf", shelf, "body"))
    return parts, side + 0.002


def _turned(rng: np.random.Generator, side: float, under: float) -> Mesh:
    """A turned leg under a square block that the apron meets."""
    block = 0.2 * under
    share = np.linspace(0.0, 1.0, 9)
    waves, slim = float(rng.integers(0, 4)), float(rng.uniform(0.4, 0.9))
    radius = side / 2 * (slim + (1 - slim) * share) * (1 + 0.15 * np.sin(2 * np.pi * waves * share))
    stem = lathe(np.stack([np.minimum(radius, side / 2), (under - block) * share], axis=1)).rotated(UP)
    square = box((-side / 2, -side / 2, under - block), (side / 2, side / 2, under))
    return join([stem, square]).moved((side / 2, 0.0, 0.0))


TABLES: dict[str, Callable[[np.random.Generator], ObjectModel]] = {"apron_table": build_apron_table}
"""How to build each kind."""
