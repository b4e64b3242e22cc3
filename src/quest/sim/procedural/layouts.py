"""Kinds of board furniture: chests, desks, lockers, cabinets, wardrobes, sideboards, night stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from quest.sim.procedural.furniture import Cell, CellKind, carcass, fill_cells, sample_front_style
from quest.sim.procedural.handles import HandleStyle, sample_style
from quest.sim.procedural.model import ObjectModel, Part, join
from quest.sim.procedural.shapes import box

_NO_HANDLES_SHARE = 0.08


def _chest(rng: np.random.Generator) -> ObjectModel:
    columns = int(rng.choice([1, 1, 2, 2, 3]))
    rows = int(rng.integers(4, 7)) if columns == 1 else int(rng.integers(2, 5))
    width = float(rng.uniform(0.45, 0.8) if columns == 1 else rng.uniform(0.45, 0.6) * columns)
    height = float(rng.uniform(0.16, 0.24)) * rows
    return _grid(rng, width, height, float(rng.uniform(0.38, 0.5)), [_drawers(rows) for _ in range(columns)])


def _night_stand(rng: np.random.Generator) -> ObjectModel:
    kinds: list[list[CellKind]] = [["drawer"], ["drawer", "drawer"], ["drawer", "open"], ["door_left", "drawer"]]
    column = kinds[int(rng.integers(len(kinds)))]
    width, height, depth = float(rng.uniform(0.38, 0.6)), float(rng.uniform(0.4, 0.6)), float(rng.uniform(0.35, 0.45))
    return _grid(rng, width, height, depth, [column])


def _cabinet(rng: np.random.Generator) -> ObjectModel:
    """Doors below, drawers above or beside, every column drawn on its own."""
    count = int(rng.integers(2, 5))
    columns: list[list[CellKind]] = []
    for index in range(count):
        swing: CellKind = "door_left" if index % 2 == 0 else "door_right"
        drawers = int(rng.integers(1, 4))
        options: list[list[CellKind]] = [
            [swing, *_drawers(min(drawers, 2))],  # bottom to top
            _drawers(drawers + 1),
            [swing],
            ["drawer", swing],
            ["door_bottom", swing],
            [swing, "open"],
        ]
        columns.append(options[int(rng.choice(len(options), p=[0.34, 0.26, 0.12, 0.12, 0.08, 0.08]))])
    width = float(rng.uniform(0.36, 0.5)) * count
    return _grid(rng, width, float(rng.uniform(0.7, 1.3)), float(rng.uniform(0.35, 0.55)), columns)


def _lockers(rng: np.random.Generator) -> ObjectModel:
    """A bank of identical doors with identical handles."""
    columns, rows = int(rng.integers(2, 6)), int(rng.integers(1, 5))
    rows = max(rows, 2) if columns < 4 else rows
    swing: CellKind = "door_left" if rng.random() < 0.5 else "door_right"
    width = float(rng.uniform(0.28, 0.4)) * columns
    height = float(rng.uniform(0.35, 0.6)) * rows if rows > 1 else float(rng.uniform(1.2, 1.8))
    depth = float(rng.uniform(0.35, 0.5))
    return _grid(rng, width, height, depth, [[swing] * rows for _ in range(columns)], equal=True, always_handles=True)


def _locker_bank(rng: np.random.Generator) -> ObjectModel:
    """Sixteen identical doors with identical handles, four by four."""
    swing: CellKind = "door_left" if rng.random() < 0.5 else "door_right"
    width, height = 4 * float(rng.uniform(0.28, 0.42)), 4 * float(rng.uniform(0.3, 0.45))
    depth = float(rng.uniform(0.35, 0.5))
    columns: list[list[CellKind]] = [[swing] * 4 for _ in range(4)]
    return _grid(rng, width, height, depth, columns, equal=True, always_handles=True, bare=False)


def _wardrobe(rng: np.random.Generator) -> ObjectModel:
    pairs = int(rng.integers(1, 3))
    drawers = int(rng.integers(0, 3))
    columns: list[list[CellKind]] = []
    for _ in range(pairs):
        left: list[CellKind] = [*_drawers(drawers), "door_left"]
        right: list[CellKind] = [*_drawers(drawers), "door_right"]
        columns += [left, right]
    width, height = float(rng.uniform(0.42, 0.55)) * len(columns), float(rng.uniform(1.5, 2.0))
    return _grid(rng, width, height, float(rng.uniform(0.5, 0.6)), columns)


def _sideboard(rng: np.random.Generator) -> ObjectModel:
    middle: list[CellKind] = _drawers(int(rng.integers(2, 5)))
    columns: list[list[CellKind]] = [["door_left"], middle, ["door_right"]]
    if rng.random() < 0.4:
        columns.insert(2, _drawers(len(middle)))
    width, height = float(rng.uniform(0.38, 0.5)) * len(columns), float(rng.uniform(0.6, 0.9))
    return _grid(rng, width, height, float(rng.uniform(0.38, 0.5)), columns)


def _desk(rng: np.random.Generator) -> ObjectModel:
    """Pedestals of drawers beside a knee hole under one top."""
    width, height, depth = float(rng.uniform(1.1, 1.7)), float(rng.uniform(0.7, 0.78)), float(rng.uniform(0.5, 0.7))
    both = bool(rng.random() < 0.6)
    pedestal = float(rng.uniform(0.3, 0.42))
    rows = int(rng.integers(2, 5)) if both else int(rng.integers(3, 5))
    top = 0.03
    shelf = float(rng.uniform(0.10, 0.14)) if both or rng.random() < 0.7 else 0.0
    column: list[CellKind] = _drawers(rows)
    if not both and rng.random() < 0.3:
        column = ["door_right", "drawer", "drawer"]
    cells = _column(column, 0.0, pedestal, 0.0, height - top, _shares(rng, len(column), equal=False))
    knee_end = width - (pedestal if both else 0.03)
    if shelf:
        cells.append(Cell((pedestal, height - top - shelf), (knee_end, height - top), "drawer"))
    if both:
        mirrored = cells[: len(column)]
        cells += [replace(c, low=(c.low[0] + knee_end, c.low[1]), high=(width, c.high[1])) for c in mirrored]
    board = float(rng.uniform(0.015, 0.022))
    style = sample_front_style(rng, _handles(rng))
    body = list(carcass(cells, depth_m=depth, board_m=board))
    if not both:
        leg = box((knee_end, 0, -board / 2), (width, depth, height - top))
        body.append(Part("leg", leg, "body"))
    over = float(rng.uniform(0.0, 0.03))
    slab = box((-over, -over - 0.02, height - top + board / 2), (width + over, depth, height))
    body.append(Part("top", slab, "front"))
    links = fill_cells(rng, cells, style, depth_m=depth, board_m=board)
    return ObjectModel("Table", tuple(body), links).moved((-width / 2, -depth / 2, board / 2))


def _wall_unit(rng: np.random.Generator) -> ObjectModel:
    """A shallow cabinet with flaps that open upwards or downwards over doors."""
    count = int(rng.integers(2, 4))
    flap: CellKind = "door_top" if rng.random() < 0.6 else "door_bottom"
    columns: list[list[CellKind]] = [
        ["door_left" if index % 2 == 0 else "door_right", flap] if rng.random() < 0.7 else [flap, flap]
        for index in range(count)
    ]
    width, height = float(rng.uniform(0.4, 0.6)) * count, float(rng.uniform(0.7, 1.1))
    return _grid(rng, width, height, float(rng.uniform(0.3, 0.4)), columns)


def _french_refrigerator(rng: np.random.Generator) -> ObjectModel:
    """Two tall doors side by side, often over freezer drawers; thick fronts and long handles."""
    width, height, depth = float(rng.uniform(0.75, 1.0)), float(rng.uniform(1.6, 1.85)), float(rng.uniform(0.55, 0.7))
    drawers = int(rng.choice([0, 1, 2], p=[0.35, 0.35, 0.3]))
    low = 0.05 + height * (0.0, 0.35, 0.42)[drawers]
    split = width * (0.5 if drawers else float(rng.uniform(0.4, 0.5)))
    cells = _column(_drawers(drawers), 0.0, width, 0.05, low, _shares(rng, drawers, equal=True)) if drawers else []
    cells += [Cell((0.0, low), (split, height), "door_left"), Cell((split, low), (width, height), "door_right")]
    style = sample_front_style(rng, sample_style(rng, knobs=False, scale=float(rng.uniform(1.5, 3.0))))
    style = replace(
        style, board_m=float(rng.uniform(0.04, 0.07)), overlay=True, panelled=False, two_from_m=9.0,
        door_vertical=True, door_height=float(rng.uniform(0.3, 0.5)), drawer_height=0.8, bare_share=0.0,
    )  # fmt: skip
    body = list(carcass(cells, depth_m=depth, board_m=0.03))
    body.append(Part("base", box((0.01, 0.02, 0), (width - 0.01, depth - 0.01, 0.035)), "dark"))
    links = fill_cells(rng, cells, style, depth_m=depth, board_m=0.03)
    return ObjectModel("Refrigerator", tuple(body), links).moved((-width / 2, -depth / 2, 0.0))


def _handles(rng: np.random.Generator, *, always: bool = False) -> HandleStyle | None:
    """A style, or None for furniture that opens without handles."""
    style = sample_style(rng)
    return None if rng.random() < _NO_HANDLES_SHARE and not always else style


def _drawers(count: int) -> list[CellKind]:
    return ["drawer" for _ in range(count)]


def _shares(rng: np.random.Generator, count: int, *, equal: bool) -> np.ndarray:
    parts = np.ones(count) if equal or rng.random() < 0.5 else rng.uniform(0.75, 1.35, count)
    return parts / parts.sum()


def _column(kinds: list[CellKind], x0: float, x1: float, z0: float, z1: float, shares: np.ndarray) -> list[Cell]:
    """Cells of one column, bottom to top."""
    edges = z0 + (z1 - z0) * np.concatenate([[0.0], np.cumsum(shares)])
    return [
        Cell((x0, float(low)), (x1, float(high)), kind)
        for kind, low, high in zip(kinds, edges[:-1], edges[1:], strict=True)
    ]


def _grid(
    rng: np.random.Generator,
    width: float,
    height: float,
    depth: float,
    columns: list[list[CellKind]],
    *,
    equal: bool = False,
    always_handles: bool = False,
    bare: bool = True,
) -> ObjectModel:
    """A cabinet of columns of cells (each bottom to top) with a base and a top; fronts may go bare if ``bare``."""
    base_kind = str(rng.choice(["none", "plinth", "legs"], p=[0.3, 0.4, 0.3]))
    base = 0.0 if base_kind == "none" else float(rng.uniform(0.05, 0.14))
    board = float(rng.uniform(0.015, 0.022))
    x_edges = width * np.concatenate([[0.0], np.cumsum(_shares(rng, len(columns), equal=equal))])
    rows = {len(column) for column in columns}
    shared = _shares(rng, rows.pop(), equal=equal) if len(rows) == 1 and rng.random() < 0.8 else None
    cells: list[Cell] = []
    for index, kinds in enumerate(columns):
        weights = np.array([1.0 if kind in ("drawer", "door_top", "door_bottom") else 2.4 for kind in kinds])
        shares = weights / weights.sum() if len(set(kinds)) > 1 else _shares(rng, len(kinds), equal=equal)
        if shared is not None and len(set(kinds)) == 1:
            shares = shared
        cells += _column(kinds, float(x_edges[index]), float(x_edges[index + 1]), base, base + height, shares)
    style = sample_front_style(rng, _handles(rng, always=always_handles))
    if not bare:
        style = replace(style, bare_share=0.0)
    body = list(carcass(cells, depth_m=depth, board_m=board))
    body += _base(base_kind, base - board / 2, width, depth)
    if rng.random() < 0.5:
        over, lip = float(rng.uniform(0.005, 0.03)), style.board_m if style.overlay else 0.0
        z = base + height + board / 2
        slab = box((-over, -lip - over, z), (width + over, depth, z + float(rng.uniform(0.015, 0.04))))
        body.append(Part("top", slab, "front"))
    links = fill_cells(rng, cells, style, depth_m=depth, board_m=board)
    ground = 0.0 if base else -board / 2
    return ObjectModel("StorageFurniture", tuple(body), links).moved((-width / 2, -depth / 2, -ground))


def _base(kind: str, height: float, width: float, depth: float) -> list[Part]:
    if kind == "plinth":
        return [Part("base", box((0.01, 0.03, 0), (width - 0.01, depth - 0.01, height)), "body")]
    if kind == "legs":
        side = 0.04
        return [
            Part("leg", join([
                box((x, y, 0), (x + side, y + side, height))
                for x in (0.01, width - side - 0.01) for y in (0.02, depth - side - 0.01)
            ]), "body")
        ]  # fmt: skip
    return []


FURNITURE: dict[str, Callable[[np.random.Generator], ObjectModel]] = {
    "chest": _chest,
    "night_stand": _night_stand,
    "cabinet": _cabinet,
    "lockers": _lockers,
    "locker_bank": _locker_bank,
    "wardrobe": _wardrobe,
    "sideboard": _sideboard,
    "desk": _desk,
    "wall_unit": _wall_unit,
    "french_refrigerator": _french_refrigerator,
}
"""How to build each kind."""
