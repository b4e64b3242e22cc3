"""Sheets of objects: portraits with every entity marked and named, so that a person sees whether labels are right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from quest.errors import InputError
from quest.sim.objects import SimObject
from quest.sim.portrait import Portrait
from quest.types import LABELS
from quest.viz.ink import Canvas, draw_disc, draw_entity, draw_text, fit_text, grid, text_size
from quest.viz.palette import BACKGROUND, LOST, MUTED, RGB, SURFACE, TEXT, entity_colours
from quest.wording import counted

_GAP, _PAD, _HEAD, _ROW = 4, 10, 46, 20
_MARGIN = 16
_NAMES_AT_MOST = 12
"""Objects with more entities get numbers beside the marks instead of labels."""


@dataclass(frozen=True)
class Card:
    """What a sheet shows of one object: itself and its portraits."""

    sim_object: SimObject
    portraits: Sequence[Portrait]


def object_sheet(cards: Sequence[Card], *, columns: int = 1) -> UInt8[np.ndarray, "H W 3"]:
    """Draw objects as one picture: portraits, and below them the entities by name.

    Args:
        cards: what to show; every card with as many portraits, of one size.
        columns: cards beside each other.

    Raises:
        InputError: there is nothing to show, or no column.
    """
    if not cards or columns < 1 or not all(card.portraits for card in cards):
        raise InputError(
            f"sheet of objects: expected at least one object with portraits and one column, got {len(cards)} objects "
            f"and {columns} columns; name more"
        )
    drawn = [_draw_card(card) for card in cards]
    rows = [drawn[i : i + columns] for i in range(0, len(drawn), columns)]
    return grid(rows, gap=_GAP, head=_MARGIN, foot=_MARGIN, sides=_MARGIN, behind=SURFACE)


def entity_words(sim_object: SimObject) -> str:
    """Entities by label, such as ``3 handles, 1 rim``; hinges are omitted."""
    count = Counter(e.label for e in sim_object.entities if e.label in LABELS)
    return ", ".join(counted(count[label], label) for label in LABELS if count[label])


def size_words(sim_object: SimObject) -> str:
    """Width, depth and height at rest in metres."""
    depth, width, height = np.ptp(sim_object.articulation.world_points(sim_object.articulation.rest), axis=0)
    return f"{width:.2f} x {depth:.2f} x {height:.2f}"


def _draw_card(card: Card) -> Canvas:
    thing = card.sim_object
    colours = entity_colours(e.label for e in thing.entities)
    tiles = [_draw_portrait(card, portrait, colours) for portrait in card.portraits]
    edge = len(tiles[0])
    width = len(tiles) * (edge + _GAP) - _GAP + 2 * _PAD
    lines = _legend_lines(thing, colours, width - 2 * _PAD)
    foot = _PAD + _ROW * len(lines) + _PAD // 2
    canvas = grid([tiles], gap=_GAP, head=_HEAD, foot=foot, sides=_PAD, colour=SURFACE)
    facts = (
        f"{thing.category}   {size_words(thing)} m   {len(thing.articulation.joints)} joints   {entity_words(thing)}"
    )
    draw_text(canvas, thing.object_id, (_PAD, 14), size=16, colour=TEXT, width=width - 2 * _PAD)
    draw_text(canvas, facts, (_PAD, 34), size=12, colour=MUTED, width=width - 2 * _PAD)
    for n, line in enumerate(lines):
        for x, text, colour in line:
            y = _HEAD + edge + _PAD + (n + 0.5) * _ROW
            draw_disc(canvas, (_PAD + x + 4, y), 4, colour=colour)
            draw_text(canvas, text, (_PAD + x + 12, y), size=12, colour=TEXT)
    return canvas


def _legend_lines(thing: SimObject, colours: list[RGB], width: int) -> list[list[tuple[int, str, RGB]]]:
    """Entities, then warnings, as lines of (x, text, colour)."""
    words = []
    for i, e in enumerate(thing.entities):
        if e.label in LABELS:
            moves = "fixed" if e.fixed else f"moves {e.travel_m:.2f} m"
            words.append((f"{i} {e.name}, {moves}{', inside' if e.inside else ''}", colours[i]))
    words += [(warning, LOST) for warning in thing.warnings]
    lines: list[list[tuple[int, str, RGB]]] = [[]]
    x = 0
    for text, colour in words:
        text = fit_text(text, 12, width - 16)
        wide = text_size(text, 12)[0] + 30
        if x and x + wide > width:
            lines.append([])
            x = 0
        lines[-1].append((x, text, colour))
        x += wide
    return lines


def _draw_portrait(card: Card, portrait: Portrait, colours: list[RGB]) -> Canvas:
    tile = portrait.rgb.copy()
    entities = card.sim_object.entities
    followed = sum(e.label in LABELS for e in entities)
    for i, (e, colour) in enumerate(zip(entities, colours, strict=True)):
        uv = portrait.uv_px[i]
        if ((uv > 0) & (uv < len(tile))).all():  # NaN compares false
            word = "" if e.label not in LABELS else e.label if followed <= _NAMES_AT_MOST else str(i)
            xy, seen = (float(uv[0]), float(uv[1])), bool(portrait.visible[i])
            draw_entity(tile, xy, word, radius=3.5, colour=colour, visible=seen)
    words = "open" if portrait.opened else "closed"
    cv2.rectangle(tile, (0, len(tile) - 20), (text_size(words, 12)[0] + 12, len(tile)), BACKGROUND, -1)
    draw_text(tile, words, (6, len(tile) - 10), size=12, colour=MUTED)
    return tile
