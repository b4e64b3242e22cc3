"""Drawing on RGB arrays: anti-aliased text, rounded boxes and translucent lines.

Text comes from Pillow's own font, so that it looks the same on every machine; masks are cached, because a video draws
the same words on every frame.
"""

from __future__ import annotations

import unicodedata
from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from quest.viz.palette import BACKGROUND, RGB, TEXT

Canvas = UInt8[np.ndarray, "_ _ 3"]
Number = float | int
XY = tuple[Number, Number]
Align = Literal["left", "centre", "right"]
_SUBPIXEL_BITS = 4


def blank(height: int, width: int, colour: RGB = BACKGROUND) -> Canvas:
    """A canvas of one colour."""
    return np.full((height, width, 3), colour, dtype=np.uint8)


def grid(
    rows: Sequence[Sequence[Canvas]], *, gap: int = 0, head: int = 0, foot: int = 0, sides: int = 0,
    least_width: int = 0, colour: RGB = BACKGROUND, behind: RGB = BACKGROUND,
) -> Canvas:  # fmt: skip
    """Pictures of any sizes beside and below each other, from the top left.

    Between two are ``gap`` pixels, and free ones are above, below and left and right. ``colour`` is that of what is
    free, ``behind`` that below pictures that are lower than their row.
    """
    width = max(least_width, *(sum(len(p[0]) + gap for p in row) - gap for row in rows))
    heights = [max(map(len, row)) for row in rows]
    sheet = blank(head + sum(heights) + gap * (len(rows) - 1) + foot, width + 2 * sides, colour)
    top = head
    for row, height in zip(rows, heights, strict=True):
        left = sides
        for picture in row:
            right = left + picture.shape[1]
            sheet[top : top + height, left:right] = behind
            sheet[top : top + len(picture), left:right] = picture
            left = right + gap
        top += height + gap
    return sheet


def text_size(text: str, size: int) -> tuple[int, int]:
    """Width and height in pixels of a line of text."""
    height, width = _text_mask(text, size).shape
    return width, height


def draw_text(
    canvas: Canvas, text: str, xy: XY, *, size: int, colour: RGB, align: Align = "left", width: Number = float("inf")
) -> None:
    """Draw a line of text, cut to a width; ``xy`` is its left end, middle or right end, vertically centred."""
    mask = _text_mask(fit_text(text, size, width), size)
    shift = {"left": 0.0, "centre": 0.5, "right": 1.0}[align]
    blend(canvas, mask, round(xy[0] - shift * mask.shape[1]), round(xy[1] - mask.shape[0] / 2), colour)


def draw_outlined(canvas: Canvas, text: str, xy: XY, *, size: int, align: Align = "left") -> None:
    """Draw a line of text that reads on any background."""
    x, y = xy
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        draw_text(canvas, text, (x + dx, y + dy), size=size, colour=BACKGROUND, align=align)
    draw_text(canvas, text, xy, size=size, colour=TEXT, align=align)


def draw_entity(canvas: Canvas, xy: XY, word: str, *, radius: Number, colour: RGB, visible: bool) -> None:
    """Draw an entity's mark, filled where it is visible, hollow where not, and a word beside it."""
    if visible:
        draw_disc(canvas, xy, radius, colour=colour, edge=1.5)
    else:
        draw_ring(canvas, xy, radius + 1, colour=colour, width=2, edge=1)
    right = xy[0] + text_size(word, 13)[0] + 12 < canvas.shape[1]
    at = (xy[0] + (8 if right else -8), min(max(xy[1] - 8, 8), len(canvas) - 8))
    draw_outlined(canvas, word, at, size=13, align="left" if right else "right")


def fit_text(text: str, size: int, width: Number) -> str:
    """The text, cut with an ellipsis where it is wider than ``width`` pixels."""
    if text_size(text, size)[0] <= width:
        return text
    too_long = bisect_left(
        range(len(text)), True, key=lambda letters: text_size(text[:letters] + "...", size)[0] > width
    )
    return text[: max(too_long - 1, 0)] + "..."


def draw_box(
    canvas: Canvas,
    x: Number,
    y: Number,
    width: Number,
    height: Number,
    *,
    colour: RGB,
    opacity: Number = 1.0,
    radius: int = 0,
) -> None:
    """Draw a filled box with rounded corners, from its top left corner."""
    mask = _box_mask(max(1, round(width)), max(1, round(height)), radius)
    blend(canvas, mask, round(x), round(y), colour, opacity)


def draw_line(canvas: Canvas, a: XY, b: XY, *, colour: RGB, width: int = 1, opacity: Number = 1.0) -> None:
    """Draw an anti-aliased line, translucent if asked."""
    if opacity >= 1.0:
        cv2.line(canvas, _fixed(a), _fixed(b), colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
        return
    margin = width + 2
    low = np.maximum(np.minimum(a, b).astype(int) - margin, 0)
    high = np.minimum(np.maximum(a, b).astype(int) + margin + 1, canvas.shape[1::-1])
    if (low >= high).any():
        return
    region = canvas[low[1] : high[1], low[0] : high[0]]
    drawn = region.copy()
    start, end = (_fixed((xy[0] - low[0], xy[1] - low[1])) for xy in (a, b))
    cv2.line(drawn, start, end, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
    cv2.addWeighted(drawn, opacity, region, 1 - opacity, 0, dst=region)


def draw_path(canvas: Canvas, path: Float[np.ndarray, "N 2"], *, colour: RGB, width: int = 1) -> None:
    """Draw a polyline, interrupted where points are NaN."""
    known = np.isfinite(path).all(axis=1)
    edges = np.flatnonzero(np.diff(known.astype(np.int8), prepend=0, append=0))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        fixed = np.array([_fixed((x, y)) for x, y in path[start:stop]], dtype=np.int32)
        cv2.polylines(canvas, [fixed], False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_cased_path(canvas: Canvas, path: Float[np.ndarray, "N 2"], *, colour: RGB, width: int = 1) -> None:
    """Draw a polyline with a dark edge, which reads on any background; interrupted where points are NaN."""
    draw_path(canvas, path, colour=BACKGROUND, width=width + 2)
    draw_path(canvas, path, colour=colour, width=width)


def draw_disc(canvas: Canvas, centre: XY, radius: Number, *, colour: RGB, edge: Number = 0) -> None:
    """Draw a filled disc, with a dark edge if asked."""
    if edge:
        draw_disc(canvas, centre, radius + edge, colour=BACKGROUND)
    cv2.circle(canvas, _fixed(centre), round(radius * 2**_SUBPIXEL_BITS), colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_ring(
    canvas: Canvas, centre: XY, radius: Number, *, colour: RGB, width: int = 1, dashes: int = 0, edge: int = 0
) -> None:
    """Draw a circle, or one of ``dashes`` arcs, with dark edges if asked."""
    if edge:
        draw_ring(canvas, centre, radius, colour=BACKGROUND, width=width + 2 * edge, dashes=dashes)
    axes = (round(radius * 2**_SUBPIXEL_BITS),) * 2
    if not dashes:
        cv2.circle(canvas, _fixed(centre), axes[0], colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
    for start in (360 * dash / dashes for dash in range(dashes)):
        end = start + 220 / dashes
        cv2.ellipse(canvas, _fixed(centre), axes, 0, start, end, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def blend(canvas: Canvas, mask: UInt8[np.ndarray, "h w"], x: int, y: int, colour: RGB, opacity: Number = 1.0) -> None:
    """Paint ``colour`` through a mask whose top left corner is at ``(x, y)``; what falls off the canvas is cut."""
    height, width = mask.shape
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + width, canvas.shape[1]), min(y + height, canvas.shape[0])
    if x0 >= x1 or y0 >= y1:
        return
    region = canvas[y0:y1, x0:x1]
    alpha = mask[y0 - y : y1 - y, x0 - x : x1 - x, None].astype(np.float32) * np.float32(opacity / 255)
    region[:] = np.rint(region + (np.array(colour, np.float32) - region) * alpha).astype(np.uint8)


def _fixed(xy: XY) -> tuple[int, int]:
    """Fixed-point coordinates for OpenCV, whose pixel centres are at integers."""
    limit = 2.0**14  # beyond, OpenCV's fixed-point arithmetic overflows
    x, y = (round((min(max(float(value), -limit), limit) - 0.5) * 2**_SUBPIXEL_BITS) for value in xy)
    return x, y


@lru_cache(maxsize=32)
def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont), "wheels of Pillow carry FreeType"
    return font


def _drawable(text: str) -> str:
    """What Pillow's own font has letters for: without accents, a question mark for what has no such letter."""
    plain = (unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode() or "?" for letter in text)
    return text if text.isascii() else "".join(plain)


@lru_cache(maxsize=4096)
def _text_mask(text: str, size: int) -> np.ndarray:
    font, text = _font(size), _drawable(text)
    ascent, descent = font.getmetrics()
    width = max(1, int(np.ceil(font.getlength(text))) + 1)
    image = Image.new("L", (width, ascent + descent))
    ImageDraw.Draw(image).text((0, 0), text, fill=255, font=font)
    return np.array(image)


@lru_cache(maxsize=512)
def _box_mask(width: int, height: int, radius: int) -> np.ndarray:
    image = Image.new("L", (4 * width, 4 * height))
    shape = (0, 0, 4 * width - 1, 4 * height - 1)
    ImageDraw.Draw(image).rounded_rectangle(shape, radius=4 * min(radius, width // 2, height // 2), fill=255)
    return np.array(image.resize((width, height), Image.Resampling.BOX))
