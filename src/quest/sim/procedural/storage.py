"""Furniture of many drawers: big desks, apothecary chests, filing cabinets, tool chests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from quest.sim.procedural.furniture import Cell, FrontStyle, carcass, drawer, sample_front_style
from quest.sim.procedural.handles import handle_part, sample_any_style
from quest.sim.procedural.model import Link, ObjectModel, Part, join
from quest.sim.procedural.shapes import UP, box

_MIXED_SHARE = 0.15
_TWO_TONE_SHARE = 0.3


def drawer_links(
    rng: np.random.Generator, cells: list[Cell], style: FrontStyle, *, depth_m: float, board_m: float
) -> tuple[Link, ...]:
    """A drawer in every cell; now and then handles of two kinds, or fronts of two materials.

    Args:
        rng: source of randomness.
        cells: the front.
        style: how fronts look.
        depth_m: depth of the carcass.
        board_m: thickness of its boards.
    """
    other = replace(style, handle=sample_any_style(rng))
    mixed, two_tone = rng.random() < _MIXED_SHARE, rng.random() < _TWO_TONE_SHARE
    links = []
    for n, cell in enumerate(cells):
        chosen = other if mixed and rng.random() < 0.4 else style
        link = drawer(f"link_{n}", cell, chosen, depth_m=depth_m, board_m=board_m, bare=False)
        if two_tone and rng.random() < 0.5:
            front, *rest = link.parts
            link = replace(link, parts=(replace(front, role="accent_front", surface="white"), *rest))
        links.append(link)
    return tuple(links)


def _style(rng: np.random.Generator) -> FrontStyle:
    style = sample_front_style(rng, sample_any_style(rng))
    return replace(style, bare_share=0.0, drawer_height=0.5)


def _stack(x0: float, x1: float, z0: float, z1: float, shares: np.ndarray) -> list[Cell]:
    edges = z0 + (z1 - z0) * np.concatenate([[0.0], np.cumsum(shares / shares.sum())])
    return [Cell((x0, float(a)), (x1, float(b)), "drawer") for a, b in pairwise(edges)]


def build_drawer_desk(rng: np.random.Generator) -> ObjectModel:
    """A writing desk with eight drawers or more: two pedestals, and a row above the knee hole."""
    width, height, depth = float(rng.uniform(1.35, 1.8)), float(rng.uniform(0.72, 0.79)), float(rng.uniform(0.6, 0.8))
    pedestal, top, board = (
        float(rng.uniform(0.34, 0.44)),
        float(rng.uniform(0.02, 0.04)),
        float(rng.uniform(0.015, 0.022)),
    )
    rows, above = int(rng.integers(3, 6)), int(rng.integers(2, 4))
    low = float(rng.uniform(0.04, 0.1))
    high = height - top
    shares = np.sort(rng.uniform(0.8, 1.6, rows))[::-1] if rng.random() < 0.6 else np.ones(rows)
    cells = _stack(0.0, pedestal, low, high, shares) + _stack(width - pedestal, width, low, high, shares)
    edges = np.linspace(pedestal, width - pedestal, above + 1)
    shelf = float(rng.uniform(0.1, 0.14))
    cells += [Cell((float(a), high - shelf), (float(b), high), "drawer") for a, b in pairwise(edges)]
    style = _style(rng)
    over = float(rng.uniform(0.005, 0.03))
    slab = box((-over, -over - style.board_m, high + board / 2), (width + over, depth + over, height + board / 2))
    feet = [
        box((x + 0.01, y, 0.0), (x + 0.05, y + 0.04, low - board / 2))
        for x in (0.0, pedestal - 0.06, width - pedestal, width - 0.06) for y in (0.02, depth - 0.06)
    ]  # fmt: skip
    body = (*carcass(cells, depth_m=depth, board_m=board), Part("top", slab, "front"), Part("leg", join(feet), "body"))
    links = drawer_links(rng, cells, style, depth_m=depth, board_m=board)
    return ObjectModel("Table", body, links).moved((-width / 2, -depth / 2, 0.0))


def build_apothecary(rng: np.random.Generator) -> ObjectModel:
    """An apothecary's chest: twelve to twenty-four small drawers, many with a label."""
    rows, columns = ((3, 4), (4, 3), (4, 4), (5, 3), (4, 5), (5, 4), (6, 3), (6, 4), (3, 6), (3, 8), (4, 6))[
        int(rng.integers(11))
    ]
    cell_w, cell_h = float(rng.uniform(0.16, 0.26)), float(rng.uniform(0.13, 0.19))
    width, depth, board = cell_w * columns, float(rng.uniform(0.28, 0.42)), float(rng.uniform(0.012, 0.02))
    base = float(rng.uniform(0.04, 0.25))
    cells = [
        Cell((c * cell_w, base + r * cell_h), ((c + 1) * cell_w, base + (r + 1) * cell_h), "drawer")
        for r in range(rows) for c in range(columns)
    ]  # fmt: skip
    style = _style(rng)
    assert style.handle is not None
    small = replace(style.handle, length_m=min(style.handle.length_m, 0.5 * cell_w))
    labelled = bool(rng.random() < 0.5)
    style = replace(style, handle=small, two_from_m=9.0, panelled=False, drawer_height=0.4 if labelled else 0.5)
    links = drawer_links(rng, cells, style, depth_m=depth, board_m=board)
    if labelled:
        links = tuple(_with_label(link) for link in links)
    z, over = base + rows * cell_h + board / 2, float(rng.uniform(0.005, 0.02))
    slab = box((-over, -over - style.board_m, z), (width + over, depth, z + float(rng.uniform(0.012, 0.03))))
    legs = [
        box((x, y, 0), (x + 0.04, y + 0.04, base - board / 2))
        for x in (0.005, width - 0.045) for y in (0.01, depth - 0.05)
    ]  # fmt: skip
    body = (*carcass(cells, depth_m=depth, board_m=board), Part("top", slab, "front"), Part("leg", join(legs), "body"))
    return ObjectModel("StorageFurniture", body, links).moved((-width / 2, -depth / 2, 0.0))


def _with_label(link: Link) -> Link:
    """The drawer with a paper label in the upper part of its front."""
    low, high = link.parts[0].mesh.bounds
    x, z, height = (low[0] + high[0]) / 2, low[2] + 0.8 * (high[2] - low[2]), high[2] - low[2]
    wide = 0.22 * (high[0] - low[0])
    paper = box((x - wide, low[1] - 0.0012, z - 0.08 * height), (x + wide, low[1] + 0.001, z + 0.08 * height))
    return replace(link, parts=(*link.parts, Part("decal", paper, "white")))


def build_filing_cabinet(rng: np.random.Generator) -> ObjectModel:
    """A filing cabinet of two to five alike drawers, or a pedestal whose lowest drawer is the largest."""
    pedestal = bool(rng.random() < 0.45)
    rows = 3 if pedestal else int(rng.integers(2, 6))
    width = float(rng.uniform(0.38, 0.48))
    depth, board = float(rng.uniform(0.5, 0.68)), 0.012
    height = float(rng.uniform(0.52, 0.64)) if pedestal else float(rng.uniform(0.3, 0.34)) * rows
    base = 0.05 if pedestal else 0.02
    shares = np.array([2.0, 1.0, 1.0 if rng.random() < 0.6 else 0.4]) if pedestal else np.ones(rows)
    cells = _stack(0.0, width, base, base + height, shares)
    style = replace(_style(rng), panelled=False, overlay=True, two_from_m=9.0)
    links = drawer_links(rng, cells, style, depth_m=depth, board_m=board)
    if rng.random() < 0.6:
        links = tuple(_with_label(link) for link in links)
    body = list(carcass(cells, depth_m=depth, board_m=board))
    top = base + height + board / 2
    body.append(Part("top", box((-board / 2, -style.board_m, top), (width + board / 2, depth, top + 0.012)), "body"))
    feet = [
        box((x, y, 0), (x + 0.04, y + 0.04, base - board / 2))
        for x in (0.01, width - 0.05)
        for y in (0.02, depth - 0.06)
    ]
    body.append(Part("foot", join(feet), "dark"))
    return ObjectModel("StorageFurniture", tuple(body), links).moved((-width / 2, -depth / 2, 0.0))


def build_toolbox(rng: np.random.Generator) -> ObjectModel:
    """A tool chest: shallow drawers under a lid that is carried by a handle on its top."""
    width, depth = float(rng.uniform(0.42, 0.7)), float(rng.uniform(0.22, 0.34))
    rows, board = int(rng.integers(1, 5)), 0.006
    row, deep = float(rng.uniform(0.05, 0.08)), float(rng.uniform(0.06, 0.12))
    cells = _stack(0.0, width, board / 2, board / 2 + rows * row, np.ones(rows))
    style = replace(_style(rng), panelled=False, board_m=0.008, gap_m=0.003, two_from_m=9.0, overlay=True)
    assert style.handle is not None
    style = replace(style, handle=replace(style.handle, reach_m=min(style.handle.reach_m, 0.028), thickness_m=0.009))
    links = list(drawer_links(rng, cells, style, depth_m=depth, board_m=board))
    floor, top = board + rows * row, board + rows * row + deep
    wall = 0.008
    well = join([
        box((0, 0, floor), (wall, depth, top)), box((width - wall, 0, floor), (width, depth, top)),
        box((wall, 0, floor), (width - wall, wall, top)), box((wall, depth - wall, floor), (width - wall, depth, top)),
        box((wall, wall, floor), (width - wall, depth - wall, floor + wall)),
    ])  # fmt: skip
    # The lid in its hinge's frame: the axis lies along x at the back of the top.
    thick = float(rng.uniform(0.02, 0.06))
    lid = box((-width / 2, -depth - 0.004, 0.001), (width / 2, 0.0, thick))
    grip = replace(sample_any_style(rng, knobs=False), kind="d_pull", length_m=float(rng.uniform(0.12, 0.2)))
    carried = handle_part(grip, at=(0.0, 0.0, 0.0), vertical=False, room_m=(0.6 * width, depth))
    held = Part("handle", carried.mesh.rotated(UP).moved((0.0, -depth / 2, thick)), carried.surface)
    latches = [
        box((x - 0.014, -depth - 0.008, -0.03), (x + 0.014, -depth - 0.0035, 0.6 * thick))
        for x in (-0.3 * width, 0.3 * width)
    ]
    parts = (Part("lid", lid, "front"), held, Part("latch", join(latches), "metal"))
    opening = float(np.deg2rad(rng.uniform(85, 110)))
    hinge = (width / 2, depth, top)
    links.append(Link(f"link_{len(links)}", parts, "revolute", hinge, (-1.0, 0.0, 0.0), opening))
    body = (*carcass(cells, depth_m=depth, board_m=board), Part("frame", well, "body"))
    return ObjectModel("Box", body, tuple(links)).moved((-width / 2, -depth / 2, 0.0))


STORAGE: dict[str, Callable[[np.random.Generator], ObjectModel]] = {
    "drawer_desk": build_drawer_desk,
    "apothecary": build_apothecary,
    "filing_cabinet": build_filing_cabinet,
    "toolbox": build_toolbox,
}
"""How to build each kind."""
