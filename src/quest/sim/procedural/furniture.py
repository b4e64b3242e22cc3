"""Furniture built from boards: a hollow carcass whose cells hold drawers, doors or nothing.

Chests, desks, lockers, cabinets, wardrobes, sideboards, night stands; furniture of many drawers; and tables with
drawers in the apron under the top, where hardly a seam tells them from it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from quest.sim.procedural.handles import HandleStyle, handle_part, sample_any_style, sample_style
from quest.sim.procedural.model import Dice, Link, ObjectModel, Part
from quest.sim.procedural.shapes import Mesh, box, boxes, copies, join, lathe, walls

CellKind = Literal["drawer", "door_left", "door_right", "door_top", "door_bottom", "open"]
"""``door_left`` is hinged at its left edge; ``open`` is a shelf without a door."""

_SIDE = {"door_left": (-1.0, 0.0), "door_right": (1.0, 0.0), "door_top": (0.0, 1.0), "door_bottom": (0.0, -1.0)}
_NO_HANDLES_SHARE = 0.08


@dataclass(frozen=True)
class Cell:
    """A rectangle of the front, between two x and two z, metres, and what fills it."""

    x0: float
    z0: float
    x1: float
    z1: float
    kind: CellKind


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


def _front_style(rng: Dice, handle: HandleStyle | None, **fixed: float | bool) -> FrontStyle:
    """How fronts look around a given style of handle; what is ``fixed`` is drawn all the same."""
    style = FrontStyle(
        handle=handle,
        bare_share=rng.pick([0.0, 0.0, 0.0, 0.0, 0.2]),
        board_m=rng.real(0.015, 0.024),
        gap_m=rng.real(0.002, 0.005),
        overlay=rng.chance(0.65),
        panelled=rng.chance(0.3),
        drawer_height=rng.pick([0.5, 0.5, 0.7]),
        door_height=rng.pick([0.5, 0.25, 0.78]),
        door_vertical=rng.chance(0.75),
        two_from_m=rng.pick([0.55, 0.7, 9.0]),
        open_rad=rng.angle(80, 120),
    )
    return replace(style, **fixed)


def _piece(
    model_cat: str, width: float, depth: float, cells: list[Cell], board: float, links: Iterable[Link], *parts: Part,
    lift: float = 0.0,
) -> ObjectModel:  # fmt: skip
    """Links in an open box around every cell, with a back, and shelves behind tall doors; and other parts.

    The front is at y = 0; half of a board's thickness falls into each cell.
    """
    body = (*_carcass(cells, depth, board), *parts)
    return ObjectModel(model_cat, body, tuple(links)).centred(width, depth, lift)


def _carcass(cells: list[Cell], depth: float, board: float) -> list[Part]:
    half, frame, inside = board / 2, [], []
    for c in cells:
        frame += [box((x - half, 0, c.z0 - half), (x + half, depth, c.z1 + half)) for x in (c.x0, c.x1)]
        frame += [box((c.x0 + half, 0, z - half), (c.x1 - half, depth, z + half)) for z in (c.z0, c.z1)]
        inside.append(box((c.x0 + half, depth - 0.008, c.z0 + half), (c.x1 - half, depth - 0.001, c.z1 - half)))
        if c.kind in ("door_left", "door_right", "open") and c.z1 - c.z0 > 0.45:
            for z in np.linspace(c.z0, c.z1, int((c.z1 - c.z0) / 0.35) + 2)[1:-1]:
                inside.append(box((c.x0 + half, 0.04, z - 0.008), (c.x1 - half, depth - 0.008, z + 0.008)))
    return [Part("frame", join(frame), "body"), Part("shelf", join(inside), "inside")]


def _fronts(rng: Dice, cells: list[Cell], style: FrontStyle, depth: float, board: float) -> list[Link]:
    """Drawers and doors for every cell that wants one; some of them stay bare."""
    links = []
    for cell in cells:
        bare = style.handle is None or rng.chance(style.bare_share)
        one = replace(style, handle=None) if bare else style
        if cell.kind == "drawer":
            links.append(_drawer(cell, one, depth, board))
        elif cell.kind in _SIDE:
            links.append(_door(cell, one, board))
    return links


def _front(cell: Cell, style: FrontStyle, board: float) -> tuple[np.ndarray, float, float, Mesh, float]:
    """Lower left corner, width and height of a front; its mesh from there on; and how deep its middle is sunk."""
    inset = style.gap_m / 2 if style.overlay else board / 2 + style.gap_m / 2
    x, z, y = cell.x0 + inset, cell.z0 + inset, -style.board_m - 0.001 if style.overlay else -0.001
    width, height, thick = cell.x1 - inset - x, cell.z1 - inset - z, style.board_m
    rail, sunk = min(0.06, 0.22 * min(width, height)), 0.4 * thick
    if not style.panelled or min(width, height) < 0.12:
        return np.array([x, y, z]), width, height, box((0, 0, 0), (width, thick, height)), 0.0
    panel = box((rail, sunk, rail), (width - rail, thick, height - rail))
    frame = walls((0, 0, 0), (width, thick, height), rail, "-x +x -z +z")
    return np.array([x, y, z]), width, height, join([panel, frame]), sunk


def _drawer(cell: Cell, style: FrontStyle, depth: float, board: float) -> Link:
    """A front, two sides, a back and a bottom, sliding along -y.

    The link's origin is the lower left corner of the front's outer face.
    """
    (x, y, z), width, height, front, sunk = _front(cell, style, board)
    left, right = cell.x0 + board / 2 + 0.006 - x, cell.x1 - board / 2 - 0.006 - x
    low, top = cell.z0 + board / 2 + 0.006 - z, cell.z1 - board / 2 - 0.02 - z
    corners = (left, style.board_m, low), (right, 0.93 * depth - y, low + 0.8 * (top - low))
    tray = walls(*corners, (0.010, 0.010, 0.010, 0.008), "-x +x +y -z")
    parts = [Part("drawer_front", front, "front"), Part("drawer_box", tray, "inside")]
    if style.handle is not None:
        shares = (0.25, 0.75) if width >= style.two_from_m else (0.5,)
        at_z = height * style.drawer_height if not sunk else height / 2
        room = (width / len(shares), 2 * min(at_z, height - at_z))
        for share in shares:
            parts.append(handle_part(style.handle, at=(share * width, sunk, at_z), vertical=False, room_m=room))
    return Link(tuple(parts), "prismatic", (x, y, z), (0.0, -1.0, 0.0), 0.75 * depth)


def _door(cell: Cell, style: FrontStyle, board: float) -> Link:
    """A door hinged at the edge that its cell's kind names.

    The axis runs along the outer edge of its face, so that an open door meets neither its carcass nor its neighbour.
    """
    low, width, height, front, sunk = _front(cell, style, board)
    side_x, side_z = _SIDE[cell.kind]
    corner = np.array([width if side_x > 0 else 0.0, 0.0, height if side_z > 0 else 0.0])
    parts = [Part("door_panel", front.moved(-corner), "front")]
    if style.handle is not None:
        vertical, room = bool(side_x) and style.door_vertical, (0.55 * width, 0.75 * height)
        edge = min(0.03 if sunk else 0.05, 0.2 * min(width, height))
        if side_x:  # near the free edge
            reach = min(style.handle.length_m, 0.6 * height if vertical else 0.45 * width)
            least = reach / 2 + edge
            inset = edge if vertical or style.handle.role == "knob" else edge + reach / 2
            x = width - inset if side_x < 0 else inset
            z = float(np.clip(style.door_height * height, least, max(height - reach / 2 - edge, least)))
        else:
            x, z, room = width / 2, height - edge if side_z < 0 else edge, (width, 2 * edge + 0.04)
        at = (x - corner[0], 0.0, z - corner[2])
        parts.append(handle_part(style.handle, at=at, vertical=vertical, room_m=room))
    # A left hinge swings x towards -y, a bottom hinge z towards -y; their opposites the other way round.
    axis = (0.0, 0.0, side_x) if side_x else (-side_z, 0.0, 0.0)
    hx, hy, hz = low + corner
    return Link(tuple(parts), "revolute", (hx, hy, hz), axis, style.open_rad)


def _row(kind: CellKind, edges: np.ndarray, low: float, high: float) -> list[Cell]:
    """Cells beside each other."""
    return [Cell(a, low, b, high, kind) for a, b in pairwise(edges.tolist())]


def _column(kinds: Sequence[CellKind], x0: float, x1: float, z0: float, z1: float, shares: np.ndarray) -> list[Cell]:
    """Cells on top of each other, bottom to top."""
    edges = z0 + (z1 - z0) * np.concatenate([[0.0], np.cumsum(shares / shares.sum())])
    return [Cell(x0, a, x1, b, kind) for kind, (a, b) in zip(kinds, pairwise(edges.tolist()), strict=True)]


def _drawers(count: int) -> list[CellKind]:
    return ["drawer"] * count


def _shares(rng: Dice, count: int, *, equal: bool = False) -> np.ndarray:
    parts = np.ones(count) if equal or rng.chance(0.5) else rng.uniform(0.75, 1.35, count)
    return parts / parts.sum()


def _posts(xs: Iterable[float], ys: Sequence[float], side: float, height: float, role: str = "leg") -> Part:
    """Square posts from the ground up, with their lower corners at the given places."""
    posts = boxes(*(((x, y, 0), (x + side, y + side, height)) for x in xs for y in ys))
    return Part(role, posts, "dark" if role == "foot" else "body")


def _handles(rng: Dice, *, always: bool = False) -> HandleStyle | None:
    """A style, or None for furniture that opens without handles."""
    style = sample_style(rng)
    return None if rng.chance(_NO_HANDLES_SHARE) and not always else style


def _grid(
    rng: Dice, width: float, height: float, depth: float, columns: list[list[CellKind]], *, equal: bool = False,
    bare: bool = True,
) -> ObjectModel:  # fmt: skip
    """A cabinet of columns of cells (each bottom to top) with a base and a top.

    All cells are alike and have handles if ``equal``; none goes without unless ``bare``.
    """
    base_kind = rng.pick(["none", "plinth", "legs"], p=[0.3, 0.4, 0.3])
    base = 0.0 if base_kind == "none" else rng.real(0.05, 0.14)
    board = rng.real(0.015, 0.022)
    x_edges = width * np.concatenate([[0.0], np.cumsum(_shares(rng, len(columns), equal=equal))])
    rows = {len(column) for column in columns}
    shared = _shares(rng, rows.pop(), equal=equal) if len(rows) == 1 and rng.chance(0.8) else None
    cells: list[Cell] = []
    for (x0, x1), kinds in zip(pairwise(x_edges.tolist()), columns, strict=True):
        weights = np.array([1.0 if kind in ("drawer", "door_top", "door_bottom") else 2.4 for kind in kinds])
        shares = weights / weights.sum() if len(set(kinds)) > 1 else _shares(rng, len(kinds), equal=equal)
        if shared is not None and len(set(kinds)) == 1:
            shares = shared
        cells += _column(kinds, x0, x1, base, base + height, shares)
    style = _front_style(rng, _handles(rng, always=equal), **({} if bare else {"bare_share": 0.0}))
    parts, under = [], base - board / 2
    if base_kind == "plinth":
        parts.append(Part("base", box((0.01, 0.03, 0), (width - 0.01, depth - 0.01, under)), "body"))
    elif base_kind == "legs":
        parts.append(_posts((0.01, width - 0.04 - 0.01), (0.02, depth - 0.04 - 0.01), 0.04, under))
    if rng.chance(0.5):
        over, lip = rng.real(0.005, 0.03), style.board_m if style.overlay else 0.0
        z = base + height + board / 2
        slab = box((-over, -lip - over, z), (width + over, depth, z + rng.real(0.015, 0.04)))
        parts.append(Part("top", slab, "front"))
    links = _fronts(rng, cells, style, depth, board)
    return _piece("StorageFurniture", width, depth, cells, board, links, *parts, lift=0.0 if base else board / 2)


def chest(rng: Dice) -> ObjectModel:
    """Drawers alone."""
    columns = rng.pick([1, 1, 2, 2, 3])
    rows = rng.whole(4, 7) if columns == 1 else rng.whole(2, 5)
    width = rng.real(0.45, 0.8) if columns == 1 else rng.real(0.45, 0.6) * columns
    height = rng.real(0.16, 0.24) * rows
    return _grid(rng, width, height, rng.real(0.38, 0.5), [_drawers(rows)] * columns)


def night_stand(rng: Dice) -> ObjectModel:
    """One small column."""
    kinds: list[list[CellKind]] = [["drawer"], ["drawer", "drawer"], ["drawer", "open"], ["door_left", "drawer"]]
    column = rng.pick(kinds)
    return _grid(rng, rng.real(0.38, 0.6), rng.real(0.4, 0.6), rng.real(0.35, 0.45), [column])


def cabinet(rng: Dice) -> ObjectModel:
    """Doors below, drawers above or beside, every column drawn on its own."""
    count = rng.whole(2, 5)
    columns: list[list[CellKind]] = []
    for index in range(count):
        swing: CellKind = "door_left" if index % 2 == 0 else "door_right"
        drawers = rng.whole(1, 4)
        options: list[list[CellKind]] = [  # bottom to top
            [swing, *_drawers(min(drawers, 2))], _drawers(drawers + 1), [swing],
            ["drawer", swing], ["door_bottom", swing], [swing, "open"],
        ]  # fmt: skip
        columns.append(rng.pick(options, p=[0.34, 0.26, 0.12, 0.12, 0.08, 0.08]))
    return _grid(rng, rng.real(0.36, 0.5) * count, rng.real(0.7, 1.3), rng.real(0.35, 0.55), columns)


def _swing(rng: Dice) -> CellKind:
    return "door_left" if rng.chance(0.5) else "door_right"


def lockers(rng: Dice) -> ObjectModel:
    """A bank of identical doors with identical handles."""
    columns, rows = rng.whole(2, 6), rng.whole(1, 5)
    rows = max(rows, 2) if columns < 4 else rows
    swing, width = _swing(rng), rng.real(0.28, 0.4) * columns
    height = rng.real(0.35, 0.6) * rows if rows > 1 else rng.real(1.2, 1.8)
    return _grid(rng, width, height, rng.real(0.35, 0.5), [[swing] * rows] * columns, equal=True)


def locker_bank(rng: Dice) -> ObjectModel:
    """Sixteen identical doors with identical handles, four by four."""
    swing, width, height = _swing(rng), 4 * rng.real(0.28, 0.42), 4 * rng.real(0.3, 0.45)
    return _grid(rng, width, height, rng.real(0.35, 0.5), [[swing] * 4] * 4, equal=True, bare=False)


def wardrobe(rng: Dice) -> ObjectModel:
    """Pairs of tall doors, often over drawers."""
    pairs, drawers = rng.whole(1, 3), rng.whole(0, 3)
    columns: list[list[CellKind]] = [[*_drawers(drawers), "door_left"], [*_drawers(drawers), "door_right"]] * pairs
    return _grid(rng, rng.real(0.42, 0.55) * len(columns), rng.real(1.5, 2.0), rng.real(0.5, 0.6), columns)


def sideboard(rng: Dice) -> ObjectModel:
    """Doors at the ends, drawers between them."""
    middle = _drawers(rng.whole(2, 5))
    columns: list[list[CellKind]] = [["door_left"], middle, ["door_right"]]
    if rng.chance(0.4):
        columns.insert(2, middle)
    return _grid(rng, rng.real(0.38, 0.5) * len(columns), rng.real(0.6, 0.9), rng.real(0.38, 0.5), columns)


def wall_unit(rng: Dice) -> ObjectModel:
    """A shallow cabinet with flaps that open upwards or downwards over doors."""
    count = rng.whole(2, 4)
    flap: CellKind = "door_top" if rng.chance(0.6) else "door_bottom"
    columns: list[list[CellKind]] = [
        ["door_left" if index % 2 == 0 else "door_right", flap] if rng.chance(0.7) else [flap, flap]
        for index in range(count)
    ]
    return _grid(rng, rng.real(0.4, 0.6) * count, rng.real(0.7, 1.1), rng.real(0.3, 0.4), columns)


def desk(rng: Dice) -> ObjectModel:
    """Pedestals of drawers beside a knee hole under one top."""
    width, height, depth = rng.real(1.1, 1.7), rng.real(0.7, 0.78), rng.real(0.5, 0.7)
    both, pedestal = rng.chance(0.6), rng.real(0.3, 0.42)
    rows = rng.whole(2, 5) if both else rng.whole(3, 5)
    under = height - 0.03
    shelf = rng.real(0.10, 0.14) if both or rng.chance(0.7) else 0.0
    column: list[CellKind] = _drawers(rows)
    if not both and rng.chance(0.3):
        column = ["door_right", "drawer", "drawer"]
    cells = _column(column, 0.0, pedestal, 0.0, under, _shares(rng, len(column)))
    knee_end = width - (pedestal if both else 0.03)
    mirrored = [replace(c, x0=c.x0 + knee_end, x1=width) for c in cells] if both else []
    if shelf:
        cells.append(Cell(pedestal, under - shelf, knee_end, under, "drawer"))
    cells += mirrored
    board = rng.real(0.015, 0.022)
    style = _front_style(rng, _handles(rng))
    leg = [] if both else [Part("leg", box((knee_end, 0, -board / 2), (width, depth, under)), "body")]
    over = rng.real(0.0, 0.03)
    slab = Part("top", box((-over, -over - 0.02, under + board / 2), (width + over, depth, height)), "front")
    links = _fronts(rng, cells, style, depth, board)
    return _piece("Table", width, depth, cells, board, links, *leg, slab, lift=board / 2)


def french_refrigerator(rng: Dice) -> ObjectModel:
    """Two tall doors side by side, often over freezer drawers; thick fronts and long handles."""
    width, height, depth = rng.real(0.75, 1.0), rng.real(1.6, 1.85), rng.real(0.55, 0.7)
    drawers = rng.pick([0, 1, 2], p=[0.35, 0.35, 0.3])
    low = 0.05 + height * (0.0, 0.35, 0.42)[drawers]
    split = width * (0.5 if drawers else rng.real(0.4, 0.5))
    cells = _column(_drawers(drawers), 0.0, width, 0.05, low, np.ones(drawers)) if drawers else []
    cells += [Cell(0.0, low, split, height, "door_left"), Cell(split, low, width, height, "door_right")]
    handle = sample_style(rng, knobs=False, scale=rng.real(1.5, 3.0))
    style = replace(
        _front_style(rng, handle), board_m=rng.real(0.04, 0.07), overlay=True, panelled=False, two_from_m=9.0,
        door_vertical=True, door_height=rng.real(0.3, 0.5), drawer_height=0.8, bare_share=0.0,
    )  # fmt: skip
    base = Part("base", box((0.01, 0.02, 0), (width - 0.01, depth - 0.01, 0.035)), "dark")
    links = _fronts(rng, cells, style, depth, 0.03)
    return _piece("Refrigerator", width, depth, cells, 0.03, links, base)


def apron_table(rng: Dice) -> ObjectModel:
    """A writing, console or coffee table with one to four flat drawers in a row in its apron."""
    low = rng.chance(0.4)
    width = rng.real(0.8, 1.3) if low else rng.real(0.9, 1.9)
    height = rng.real(0.34, 0.52) if low else rng.real(0.68, 0.8)
    depth = rng.real(0.4, 0.8)
    top, over = rng.real(0.015, 0.05), rng.pick([0.0, 0.02, 0.05]) + rng.real(0.0, 0.02)
    under = height - top
    base, inset = _table_legs(rng, width, depth, under)
    apron, board = rng.real(0.06, 0.17), 0.01
    count = rng.pick([1, 2, 3, 4], p=[0.25, 0.3, 0.3, 0.15] if width > 1.0 else [0.4, 0.4, 0.2, 0.0])
    # Beside the drawers the apron goes on, seldom far.
    side = inset + rng.pick([0.0, 0.0, rng.real(0.02, 0.2)]) * (width - 2 * inset)
    bottom = under - apron
    cells = _row("drawer", np.linspace(side, width - side, count + 1), bottom, under - board / 2)
    seamless = rng.chance(0.7)
    style = replace(
        _front_style(rng, sample_any_style(rng)), overlay=True, panelled=False, two_from_m=9.0,
        board_m=rng.real(0.012, 0.02), gap_m=rng.real(0.0004, 0.002 if seamless else 0.006),
    )  # fmt: skip
    links = [_drawer(cell, style, depth, board) for cell in cells]
    if seamless:
        links = [_repainted(link, surface="body") for link in links]
    # The fronts lie before the carcass; what is beside them is as far out.
    out = -style.board_m - 0.001
    rails = [
        ((0.01, 0.01, bottom), (0.025, depth - 0.01, under)),
        ((width - 0.025, 0.01, bottom), (width - 0.01, depth - 0.01, under)),
        ((0.025, depth - 0.02, bottom), (width - 0.025, depth - 0.005, under)),
    ]
    if side > inset + 0.001:
        rails.append(((inset, out, bottom), (side - 0.0002, 0.0, under)))
        rails.append(((width - side + 0.0002, out, bottom), (width - inset, 0.0, under)))
    slab = box((-over, out - over, under), (width + over, depth + over, height))
    body = [*_carcass(cells, depth - 0.02, board), Part("frame", boxes(*rails), "body"), *base]
    body.append(Part("top", slab, "body" if rng.chance(0.6) else "front"))
    return ObjectModel("Table", tuple(body), tuple(links)).centred(width, depth)


def _repainted(link: Link, **changes: str) -> Link:
    """The link with another front."""
    front, *rest = link.parts
    return replace(link, parts=(replace(front, **changes), *rest))


def _table_legs(rng: Dice, width: float, depth: float, under: float) -> tuple[list[Part], float]:
    """What carries the top, and how far from either end it leaves no room for drawers."""
    if rng.chance(0.15):
        board = rng.real(0.02, 0.05)
        ends = boxes(*(((x, -0.01, 0.0), (x + board, depth, under)) for x in (0.0, width - board)))
        return [Part("leg", ends, "body")], board + 0.002
    side = rng.real(0.035, 0.08)
    leg = _turned(rng, side, under) if rng.chance(0.4) else box((0.0, -side / 2, 0.0), (side, side / 2, under))
    at = [(x, y, 0.0) for x in (0.0, width - side) for y in (side / 2 - 0.015, depth - side / 2)]
    parts = [Part("leg", copies(leg, at), "body")]
    if rng.chance(0.25):
        z = rng.real(0.15, 0.35) * under
        shelf = box((side / 2, side / 2, z), (width - side / 2, depth - side / 2, z + 0.015))
        parts.append(Part("shelf", shelf, "body"))
    return parts, side + 0.002


def _turned(rng: Dice, side: float, under: float) -> Mesh:
    """A turned leg under a square block that the apron meets."""
    block, share = 0.2 * under, np.linspace(0.0, 1.0, 9)
    waves, slim = rng.whole(0, 4), rng.real(0.4, 0.9)
    radius = side / 2 * (slim + (1 - slim) * share) * (1 + 0.15 * np.sin(2 * np.pi * waves * share))
    stem = lathe(np.stack([np.minimum(radius, side / 2), (under - block) * share], axis=1)).turned("up")
    square = box((-side / 2, -side / 2, under - block), (side / 2, side / 2, under))
    return join([stem, square]).moved((side / 2, 0.0, 0.0))


def _drawer_links(rng: Dice, cells: list[Cell], style: FrontStyle, depth: float, board: float) -> list[Link]:
    """A drawer in every cell; now and then handles of two kinds, or fronts of two materials."""
    other = replace(style, handle=sample_any_style(rng))
    mixed, two_tone = rng.chance(0.15), rng.chance(0.3)
    links = []
    for cell in cells:
        link = _drawer(cell, other if mixed and rng.chance(0.4) else style, depth, board)
        if two_tone and rng.chance(0.5):
            link = _repainted(link, role="accent_front", surface="white")
        links.append(link)
    return links


def _drawer_style(rng: Dice, **fixed: float | bool) -> tuple[FrontStyle, HandleStyle]:
    handle = sample_any_style(rng)
    return _front_style(rng, handle, bare_share=0.0, **{"drawer_height": 0.5, **fixed}), handle


def drawer_desk(rng: Dice) -> ObjectModel:
    """A writing desk with eight drawers or more: two pedestals, and a row above the knee hole."""
    width, height, depth = rng.real(1.35, 1.8), rng.real(0.72, 0.79), rng.real(0.6, 0.8)
    pedestal, top, board = rng.real(0.34, 0.44), rng.real(0.02, 0.04), rng.real(0.015, 0.022)
    rows, above = rng.whole(3, 6), rng.whole(2, 4)
    low, high = rng.real(0.04, 0.1), height - top
    shares = np.sort(rng.uniform(0.8, 1.6, rows))[::-1] if rng.chance(0.6) else np.ones(rows)
    cells = _column(_drawers(rows), 0.0, pedestal, low, high, shares)
    cells += _column(_drawers(rows), width - pedestal, width, low, high, shares)
    cells += _row("drawer", np.linspace(pedestal, width - pedestal, above + 1), high - rng.real(0.1, 0.14), high)
    style, _ = _drawer_style(rng)
    over = rng.real(0.005, 0.03)
    slab = box((-over, -over - style.board_m, high + board / 2), (width + over, depth + over, height + board / 2))
    feet = boxes(*(
        ((x + 0.01, y, 0.0), (x + 0.05, y + 0.04, low - board / 2))
        for x in (0.0, pedestal - 0.06, width - pedestal, width - 0.06) for y in (0.02, depth - 0.06)
    ))  # fmt: skip
    links = _drawer_links(rng, cells, style, depth, board)
    return _piece("Table", width, depth, cells, board, links, Part("top", slab, "front"), Part("leg", feet, "body"))


_APOTHECARY = ((3, 4), (4, 3), (4, 4), (5, 3), (4, 5), (5, 4), (6, 3), (6, 4), (3, 6), (3, 8), (4, 6))


def apothecary(rng: Dice) -> ObjectModel:
    """An apothecary's chest: twelve to twenty-four small drawers, many with a label."""
    rows, columns = rng.pick(_APOTHECARY)
    cell_w, cell_h = rng.real(0.16, 0.26), rng.real(0.13, 0.19)
    width, depth, board = cell_w * columns, rng.real(0.28, 0.42), rng.real(0.012, 0.02)
    base = rng.real(0.04, 0.25)
    edges = cell_w * np.arange(columns + 1)
    cells = [c for r in range(rows) for c in _row("drawer", edges, base + r * cell_h, base + (r + 1) * cell_h)]
    style, handle = _drawer_style(rng, two_from_m=9.0, panelled=False)
    labelled = rng.chance(0.5)
    small = replace(handle, length_m=min(handle.length_m, 0.5 * cell_w))
    style = replace(style, handle=small, drawer_height=0.4 if labelled else 0.5)
    links = _drawer_links(rng, cells, style, depth, board)
    if labelled:
        links = [_with_label(link) for link in links]
    z, over = base + rows * cell_h + board / 2, rng.real(0.005, 0.02)
    slab = box((-over, -over - style.board_m, z), (width + over, depth, z + rng.real(0.012, 0.03)))
    legs = _posts((0.005, width - 0.045), (0.01, depth - 0.05), 0.04, base - board / 2)
    return _piece("StorageFurniture", width, depth, cells, board, links, Part("top", slab, "front"), legs)


def _with_label(link: Link) -> Link:
    """The drawer with a paper label in the upper part of its front."""
    low, high = link.parts[0].mesh.bounds
    x, z, height = (low[0] + high[0]) / 2, low[2] + 0.8 * (high[2] - low[2]), high[2] - low[2]
    wide = 0.22 * (high[0] - low[0])
    paper = box((x - wide, low[1] - 0.0012, z - 0.08 * height), (x + wide, low[1] + 0.001, z + 0.08 * height))
    return replace(link, parts=(*link.parts, Part("decal", paper, "white")))


def filing_cabinet(rng: Dice) -> ObjectModel:
    """A filing cabinet of two to five alike drawers, or a pedestal whose lowest drawer is the largest."""
    pedestal = rng.chance(0.45)
    rows = 3 if pedestal else rng.whole(2, 6)
    width, depth, board = rng.real(0.38, 0.48), rng.real(0.5, 0.68), 0.012
    height = rng.real(0.52, 0.64) if pedestal else rng.real(0.3, 0.34) * rows
    base = 0.05 if pedestal else 0.02
    shares = np.array([2.0, 1.0, 1.0 if rng.chance(0.6) else 0.4]) if pedestal else np.ones(rows)
    cells = _column(_drawers(rows), 0.0, width, base, base + height, shares)
    style, _ = _drawer_style(rng, panelled=False, overlay=True, two_from_m=9.0)
    links = _drawer_links(rng, cells, style, depth, board)
    if rng.chance(0.6):
        links = [_with_label(link) for link in links]
    top = base + height + board / 2
    slab = box((-board / 2, -style.board_m, top), (width + board / 2, depth, top + 0.012))
    feet = _posts((0.01, width - 0.05), (0.02, depth - 0.06), 0.04, base - board / 2, "foot")
    return _piece("StorageFurniture", width, depth, cells, board, links, Part("top", slab, "body"), feet)


def toolbox(rng: Dice) -> ObjectModel:
    """A tool chest: shallow drawers under a lid that is carried by a handle on its top."""
    width, depth = rng.real(0.42, 0.7), rng.real(0.22, 0.34)
    rows, board = rng.whole(1, 5), 0.006
    row, deep = rng.real(0.05, 0.08), rng.real(0.06, 0.12)
    cells = _column(_drawers(rows), 0.0, width, board / 2, board / 2 + rows * row, np.ones(rows))
    style, handle = _drawer_style(rng, panelled=False, board_m=0.008, gap_m=0.003, two_from_m=9.0, overlay=True)
    style = replace(style, handle=replace(handle, reach_m=min(handle.reach_m, 0.028), thickness_m=0.009))
    links = _drawer_links(rng, cells, style, depth, board)
    floor, top = board + rows * row, board + rows * row + deep
    well = walls((0, 0, floor), (width, depth, top), 0.008, "-x +x -y +y -z")
    # The lid in its hinge's frame: the axis lies along x at the back of the top.
    thick = rng.real(0.02, 0.06)
    lid = box((-width / 2, -depth - 0.004, 0.001), (width / 2, 0.0, thick))
    grip = replace(sample_any_style(rng, knobs=False), kind="d_pull", length_m=rng.real(0.12, 0.2))
    carried = handle_part(grip, at=(0.0, 0.0, 0.0), vertical=False, room_m=(0.6 * width, depth))
    held = Part("handle", carried.mesh.turned("up").moved((0.0, -depth / 2, thick)), carried.surface)
    latches = boxes(*(
        ((x - 0.014, -depth - 0.008, -0.03), (x + 0.014, -depth - 0.0035, 0.6 * thick))
        for x in (-0.3 * width, 0.3 * width)
    ))  # fmt: skip
    parts = (Part("lid", lid, "front"), held, Part("latch", latches, "metal"))
    lifted = Link(parts, "revolute", (width / 2, depth, top), (-1.0, 0.0, 0.0), rng.angle(85, 110))
    return _piece("Box", width, depth, cells, board, [*links, lifted], Part("frame", well, "body"))
