"""Cabinets built from boards: a hollow carcass whose cells hold drawers, doors or nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from quest.sim.procedural.handles import HandleStyle, handle_part
from quest.sim.procedural.model import Link, Mesh, Part, join
from quest.sim.procedural.shapes import box

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
