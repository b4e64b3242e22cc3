"""Colours: one per query, stable over frames and runs; red and grey are kept for states."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable

from quest.types import LABELS

RGB = tuple[int, int, int]

BACKGROUND: RGB = (22, 24, 29)
SURFACE: RGB = (33, 36, 43)
LINE: RGB = (68, 73, 84)
TEXT: RGB = (236, 239, 244)
MUTED: RGB = (150, 157, 170)
HELD: RGB = (176, 182, 194)
LOST: RGB = (255, 72, 66)

_FIRST: tuple[RGB, ...] = (
    (56, 189, 255),
    (255, 184, 28),
    (60, 220, 130),
    (206, 130, 255),
    (255, 240, 90),
    (32, 230, 210),
    (255, 140, 190),
    (150, 165, 255),
    (190, 235, 80),
    (255, 150, 90),
)


def query_colour(index: int) -> RGB:
    """Colour of a query: the first ten are chosen by hand, the others walk round the hues and keep clear of red."""
    if index < len(_FIRST):
        return _FIRST[index]
    hue = 0.08 + 0.84 * ((index * 0.61803398875) % 1.0)
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.5 + 0.2 * (index % 2), 1.0)
    return round(red * 255), round(green * 255), round(blue * 255)


def entity_colours(labels: Iterable[str]) -> list[RGB]:
    """Colours of an object's entities: bright for what is tracked, grey for hinges."""
    return [query_colour(e) if label in LABELS else MUTED for e, label in enumerate(labels)]
