"""Furniture built from boards.

Cabinets are a hollow carcass whose cells hold drawers, doors or nothing. Tables have their drawers in the apron under
the top, where hardly a seam tells them from it. Furniture of many drawers: big desks, apothecary chests, filing
cabinets, tool chests.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from quest.sim.procedural.handles import HandleStyle, handle_part, sample_any_style
from quest.sim.procedural.model import Link, Mesh, ObjectModel, Part, join
from quest.sim.procedural.shapes import UP, box, lathe

CellKind = Literal["drawer", "door_left", "door_right", "door_top", "door_bottom", "open", "void"]
"""``door_left`` is hinged at its left edge; ``open`` is a shelf without a door; ``void`` has no carcass either."""

_SIDE = {"door_left": (-1.0, 0.0), "door_right": (1.0, 0.0), "door_top": (0.0, 1.0), "door_bottom": (0.0, -1.0)}


@dataclass(frozen=True)
class Cell:
    """A rectangle of the front."""

    low: tuple[float, float]
    """Smallest x and z, metres."""
    high: tuple[float, float]
    """Largest x and z, metres."""
    kind: CellKind
    """What fills it."""


@dataclass(frozen=True)
class FrontStyle:
    """How the fronts of one piece of furniture look."""

    handle: HandleStyle | None
    """Style of the handles, or None for fronts without any."""
    bare_share: float
    """Share of the fronts that carry no handle although the others do."""
    board_m: float
    """Thickness of a front."""
    gap_m: float
    """Gap around a front."""
    overlay: bool
    """Whether fronts lie on the carcass rather than inside it."""
    panelled: bool
    """Whether fronts are a frame around a sunk panel."""
    drawer_height: float
    """Where a drawer's handle sits, 0 at the bottom of its front, 1 at the top."""
    door_height: float
    """Where a door's handle sits along its free edge."""
    door_vertical: bool
    """Whether long handles on doors run upright."""
    two_from_m: float
    """Drawers at least this wide have two handles."""
    open_rad: float
    """How far doors open."""


def sample_front_style(rng: np.random.Generator, handle: HandleStyle | None) -> FrontStyle:
    """Draw how fronts look around a given style of handle."""
    return FrontStyle(
        handle=handle,
        bare_share=float(rng.choice([0.0, 0.0, 0.0, 0.0, 0.2])),
        board_m=float(rng.uniform(0.015, 0.024)),
        gap_m=float(rng.uniform(0.002, 0.005)),
        overlay=bool(rng.random() < 0.65),
        panelled=bool(rng.random() < 0.3),
        drawer_height=float(rng.choice([0.5, 0.5, 0.7])),
        door_height=float(rng.choice([0.5, 0.25, 0.78])),
        door_vertical=bool(rng.random() < 0.75),
        two_from_m=float(rng.choice([0.55, 0.7, 9.0])),
        open_rad=float(np.deg2rad(rng.uniform(80, 120))),
    )


def carcass(
    cells: list[Cell], *, depth_m: float, board_m: float, with_back: bool = True, shelves: bool = True
) -> tuple[Part, ...]:
    """Boards around every cell: an open box each, with a back and shelves.

    Args:
        cells: the front; every cell but a ``void`` one gets walls.
        depth_m: from the carcass's front at y = 0 to its back.
        board_m: thickness of the boards; half of it falls into each cell.
        with_back: whether the cells have a back.
        shelves: whether tall doors hide a shelf.
    """
    half, frame, inside = board_m / 2, [], []
    for cell in cells:
        if cell.kind == "void":
            continue
        (x0, z0), (x1, z1) = cell.low, cell.high
        frame += [
            box((x0 - half, 0, z0 - half), (x0 + half, depth_m, z1 + half)),
            box((x1 - half, 0, z0 - half), (x1 + half, depth_m, z1 + half)),
            box((x0 + half, 0, z0 - half), (x1 - half, depth_m, z0 + half)),
            box((x0 + half, 0, z1 - half), (x1 - half, depth_m, z1 + half)),
        ]
        if with_back:
            inside.append(box((x0 + half, depth_m - 0.008, z0 + half), (x1 - half, depth_m - 0.001, z1 - half)))
        if shelves and cell.kind in ("door_left", "door_right", "open") and z1 - z0 > 0.45:
            for z in np.linspace(z0, z1, int((z1 - z0) / 0.35) + 2)[1:-1]:
                inside.append(box((x0 + half, 0.04, z - 0.008), (x1 - half, depth_m - 0.008, z + 0.008)))
    parts = [Part("frame", join(frame), "body")]
    if inside:
        parts.append(Part("shelf", join(inside), "inside"))
    return tuple(parts)


def fill_cells(
    rng: np.random.Generator, cells: list[Cell], style: FrontStyle, *, depth_m: float, board_m: float
) -> tuple[Link, ...]:
    """Drawers and doors for every cell that wants one, in order.

    Args:
        rng: decides which fronts stay bare.
        cells: the front, as given to :func:`carcass`.
        style: how fronts look.
        depth_m: depth of the carcass.
        board_m: thickness of its boards.
    """
    links: list[Link] = []
    for cell in cells:
        bare = style.handle is None or rng.random() < style.bare_share
        name = f"link_{len(links)}"
        if cell.kind == "drawer":
            links.append(drawer(name, cell, style, depth_m=depth_m, board_m=board_m, bare=bare))
        elif cell.kind in _SIDE:
            links.append(door(name, cell, style, board_m=board_m, bare=bare))
    return tuple(links)


def _front_rect(cell: Cell, style: FrontStyle, board_m: float) -> tuple[float, float, float, float, float]:
    """x0, z0, x1, z1 of a front and the y of its outer face."""
    inset = style.gap_m / 2 if style.overlay else board_m / 2 + style.gap_m / 2
    (x0, z0), (x1, z1) = cell.low, cell.high
    y = -style.board_m - 0.001 if style.overlay else -0.001
    return x0 + inset, z0 + inset, x1 - inset, z1 - inset, y


def front_board(width_m: float, height_m: float, style: FrontStyle) -> tuple[Mesh, float]:
    """A front in the rectangle from (0, 0) to (width, height), its outer face at y = 0.

    Returns:
        The mesh and how deep its middle is sunk, where a handle would stand.
    """
    rail = min(0.06, 0.22 * min(width_m, height_m))
    if not style.panelled or min(width_m, height_m) < 0.12:
        return box((0, 0, 0), (width_m, style.board_m, height_m)), 0.0
    sunk = 0.4 * style.board_m
    return join([
        box((rail, sunk, rail), (width_m - rail, style.board_m, height_m - rail)),
        box((0, 0, 0), (rail, style.board_m, height_m)),
        box((width_m - rail, 0, 0), (width_m, style.board_m, height_m)),
        box((rail, 0, 0), (width_m - rail, style.board_m, rail)),
        box((rail, 0, height_m - rail), (width_m - rail, style.board_m, height_m)),
    ]), sunk  # fmt: skip


def drawer(name: str, cell: Cell, style: FrontStyle, *, depth_m: float, board_m: float, bare: bool) -> Link:
    """A drawer: a front, two sides, a back and a bottom, sliding along -y.

    The link's origin is the lower left corner of the front's outer face.

    Args:
        name: name of the link.
        cell: its place in the front.
        style: how fronts look.
        depth_m: depth of the carcass.
        board_m: thickness of the carcass's boards.
        bare: whether it has no handle.
    """
    x0, z0, x1, z1, y = _front_rect(cell, style, board_m)
    width, height = x1 - x0, z1 - z0
    board, sunk = front_board(width, height, style)
    (cx0, cz0), (cx1, cz1) = cell.low, cell.high
    left, right = cx0 + board_m / 2 + 0.006 - x0, cx1 - board_m / 2 - 0.006 - x0
    low, high = cz0 + board_m / 2 + 0.006 - z0, cz1 - board_m / 2 - 0.02 - z0
    high = low + 0.8 * (high - low)
    start, end, wall = style.board_m, 0.93 * depth_m - y, 0.010
    tray = join([
        box((left, start, low), (left + wall, end, high)),
        box((right - wall, start, low), (right, end, high)),
        box((left + wall, end - wall, low), (right - wall, end, high)),
        box((left + wall, start, low), (right - wall, end - wall, low + 0.008)),
    ])  # fmt: skip
    parts = [Part("drawer_front", board, "front"), Part("drawer_box", tray, "inside")]
    if not bare and style.handle is not None:
        shares = (0.25, 0.75) if width >= style.two_from_m else (0.5,)
        z = height * style.drawer_height if not sunk else height / 2
        room = (width / len(shares), 2 * min(z, height - z))
        for share in shares:
            parts.append(handle_part(style.handle, at=(share * width, sunk, z), vertical=False, room_m=room))
    return Link(name, tuple(parts), "prismatic", (x0, y, z0), (0.0, -1.0, 0.0), 0.75 * depth_m)


def door(name: str, cell: Cell, style: FrontStyle, *, board_m: float, bare: bool) -> Link:
    """A door hinged at one of its edges.

    The axis runs along the outer edge of its face, so that an open door meets neither its carcass nor its neighbour.

    Args:
        name: name of the link.
        cell: its place in the front; its kind names the hinged edge.
        style: how fronts look.
        board_m: thickness of the carcass's boards.
        bare: whether it has no handle.
    """
    x0, z0, x1, z1, y = _front_rect(cell, style, board_m)
    width, height = x1 - x0, z1 - z0
    board, sunk = front_board(width, height, style)
    side_x, side_z = _SIDE[cell.kind]
    corner = (width if side_x > 0 else 0.0, 0.0, height if side_z > 0 else 0.0)
    shift = -np.asarray(corner)
    parts = [Part("door_panel", board.moved(shift), "front")]
    if not bare and style.handle is not None:
        at, vertical, room = _door_handle_place(width, height, side_x, side_z, style, rail=sunk > 0)
        place = (at[0] + shift[0], 0.0, at[1] + shift[2])
        parts.append(handle_part(style.handle, at=place, vertical=vertical, room_m=room))
    # A left hinge swings x towards -y, a bottom hinge z towards -y; their opposites the other way round.
    axis = (0.0, 0.0, side_x) if side_x else (-side_z, 0.0, 0.0)
    return Link(name, tuple(parts), "revolute", (x0 + corner[0], y, z0 + corner[2]), axis, style.open_rad)


def _door_handle_place(
    width: float, height: float, side_x: float, side_z: float, style: FrontStyle, *, rail: bool
) -> tuple[tuple[float, float], bool, tuple[float, float]]:
    """Where a door's handle stands (x, z), whether it runs upright, and the room around it."""
    assert style.handle is not None
    edge = min(0.03 if rail else 0.05, 0.2 * min(width, height))
    if side_x:
        vertical = style.door_vertical
        reach = min(style.handle.length_m, 0.6 * height if vertical else 0.45 * width)
        along = np.clip(style.door_height * height, reach / 2 + edge, max(height - reach / 2 - edge, reach / 2 + edge))
        inset = edge if vertical or style.handle.role == "knob" else edge + reach / 2
        x = width - inset if side_x < 0 else inset
        return (x, float(along)), vertical, (0.55 * width, 0.75 * height)
    z = height - edge if side_z < 0 else edge
    return (width / 2, z), False, (width, 2 * edge + 0.04)


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
