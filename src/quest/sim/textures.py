"""Small tileable colour images: wood, tiles, marble, bricks, concrete, woven cloth, scratches, stickers and others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

TextureKind = Literal[
    "noise", "stripes", "checker", "wood", "planks", "tiles", "speckle", "brushed",
    "marble", "bricks", "concrete", "weave", "scratched", "stickers",
]  # fmt: skip
TEXTURE_KINDS: tuple[TextureKind, ...] = get_args(TextureKind)[:8]
"""What materials are drawn from unless asked otherwise; their order is part of what a seed means."""

Colour = tuple[float, float, float]
"""Red, green, blue in [0, 1]; sRGB, as in images."""


@dataclass(frozen=True)
class Texture:
    """A procedural texture; :func:`paint` makes its image.

    Attributes:
        kind: pattern.
        first: main colour.
        second: colour of the pattern's other half (grout, dark grain, second check).
        repeats: how often the pattern repeats over the image, at least 1.
        seed: seed of what is random in the pattern.
    """

    kind: TextureKind
    first: Colour
    second: Colour
    repeats: int
    seed: int


def paint(texture: Texture, *, size: int = 128) -> UInt8[np.ndarray, "S S 4"]:
    """The image of a texture; its edges match, the grain runs along x, alpha is 255.

    Args:
        texture: what to draw.
        size: edge length in pixels.
    """
    rng = np.random.default_rng(texture.seed)
    u, v = np.meshgrid(np.arange(size) / size, np.arange(size) / size)
    n = max(1, texture.repeats)
    mix, shade = _PATTERNS[texture.kind](rng, u, v, n)
    first, second = np.asarray(texture.first), np.asarray(texture.second)
    colour = first + np.clip(mix, 0, 1)[..., None] * (second - first)
    colour = np.clip(colour * (1 + shade[..., None]), 0, 1)
    image = np.full((size, size, 4), 255, dtype=np.uint8)
    image[..., :3] = np.round(colour * 255)
    return image


_Field = Float[np.ndarray, "S S"]


def _noise(rng: np.random.Generator, size: int, *, falloff: float, stretch: float = 1.0) -> _Field:
    """Periodic noise of zero mean and unit spread; ``stretch`` > 1 draws it out along x."""
    fy, fx = np.meshgrid(np.fft.fftfreq(size) * size, np.fft.rfftfreq(size) * size, indexing="ij")
    radius = np.hypot(fx * stretch, fy)
    radius[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / np.maximum(radius, 1.0) ** falloff
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, s=(size, size))
    return field / field.std()


def _cell_values(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> _Field:
    values = rng.standard_normal((n, n))
    return values[(v * n).astype(int) % n, (u * n).astype(int) % n]


def _draw_noise(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    field = _noise(rng, len(u), falloff=1.6)
    return 0.5 + 0.25 * field, 0.03 * _noise(rng, len(u), falloff=0.3)


def _draw_stripes(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    share = rng.uniform(0.2, 0.6)
    return ((v * 2 * n) % 1 < share).astype(float), 0.03 * _noise(rng, len(u), falloff=1.0)


def _draw_checker(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    odd = ((u * 2 * n).astype(int) + (v * 2 * n).astype(int)) % 2
    return odd.astype(float), 0.03 * _noise(rng, len(u), falloff=1.0)


def _grain(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    warp = 0.12 * _noise(rng, len(u), falloff=2.0, stretch=3.0)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (2 * n * v + 3 * warp))
    fine = _noise(rng, len(u), falloff=0.5, stretch=12.0)
    return 0.55 * rings**2 + 0.12 * fine, 0.03 * fine


def _draw_planks(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    mix, shade = _grain(rng, u, v, 2 * n)
    rows = 2 * n
    row = (v * rows).astype(int) % rows
    tone = 0.1 * rng.standard_normal(rows)[row]
    start = rng.uniform(0, 1, rows)[row]
    joint = ((v * rows) % 1 < 0.06) | (((u + start) % 1) < 0.012)
    return 0.7 * mix, shade + tone - 0.45 * joint


def _draw_tiles(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    width = rng.uniform(0.03, 0.08)
    grout = (((u * 2 * n) % 1) < width) | (((v * 2 * n) % 1) < width)
    return grout.astype(float), 0.07 * _cell_values(rng, u, v, 2 * n) * ~grout + 0.02 * _noise(rng, len(u), falloff=1.0)


def _draw_speckle(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    grains = _noise(rng, len(u), falloff=0.4) > rng.uniform(0.6, 1.4)
    return grains.astype(float), 0.05 * _noise(rng, len(u), falloff=0.8)


def _draw_brushed(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    return 0.5 + 0.2 * _noise(rng, len(u), falloff=0.4, stretch=25.0), np.zeros_like(u)


def _draw_marble(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    # Veins run where a slow field crosses zero; some are broad and faint, others thin and dark.
    broad = np.exp(-(np.abs(_noise(rng, len(u), falloff=1.7)) / 0.22))
    thin = np.exp(-(np.abs(_noise(rng, len(u), falloff=1.5)) / 0.05))
    return 0.45 * broad + 0.55 * thin * rng.uniform(0.5, 1.0), 0.05 * _noise(rng, len(u), falloff=1.6)


def _draw_bricks(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    rows, across = 4 * n, 2 * n
    row = (v * rows).astype(int) % rows
    x = (u + 0.5 / across * (row % 2)) % 1
    width = rng.uniform(0.05, 0.12)
    mortar = ((v * rows) % 1 < width) | ((x * across) % 1 < 0.5 * width)
    tone = rng.standard_normal((rows, across))[row, (x * across).astype(int) % across]
    return mortar.astype(float), 0.09 * tone * ~mortar + 0.05 * _noise(rng, len(u), falloff=0.8)


def _draw_concrete(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    pores = _noise(rng, len(u), falloff=0.7) > 2.2
    return 0.25 + 0.08 * _noise(rng, len(u), falloff=1.5), 0.03 * _noise(rng, len(u), falloff=0.4) - 0.2 * pores


def _draw_weave(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    threads = 16 * n
    warp, weft = np.abs(np.sin(np.pi * threads * u)), np.abs(np.sin(np.pi * threads * v))
    over = ((u * threads).astype(int) + (v * threads).astype(int)) % 2 == 0
    shade = 0.25 * (np.where(over, warp, weft) - 0.7)
    return np.where(over, 0.0, rng.uniform(0.4, 1.0)), shade + 0.03 * _noise(rng, len(u), falloff=0.5)


def _draw_scratched(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    marks = np.zeros_like(u)
    for _ in range(int(rng.integers(8, 24)) * n):
        x, y, turn = rng.random(), rng.random(), rng.uniform(0, np.pi)
        du, dv = (u - x + 0.5) % 1 - 0.5, (v - y + 0.5) % 1 - 0.5
        along, across = du * np.cos(turn) + dv * np.sin(turn), dv * np.cos(turn) - du * np.sin(turn)
        inside = (np.abs(along) < rng.uniform(0.03, 0.2)) & (np.abs(across) < rng.uniform(0.003, 0.006))
        marks = np.maximum(marks, inside * rng.uniform(0.4, 1.0))
    return marks, 0.03 * _noise(rng, len(u), falloff=1.2)


def _draw_stickers(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    mix, shade = np.zeros_like(u), 0.02 * _noise(rng, len(u), falloff=1.0)
    for _ in range(int(rng.integers(2, 5)) * n):
        x, y, size = rng.random(), rng.random(), rng.uniform(0.04, 0.1)
        du, dv = (u - x + 0.5) % 1 - 0.5, (v - y + 0.5) % 1 - 0.5
        distance = (
            np.hypot(du, dv) if rng.random() < 0.5 else np.maximum(np.abs(du) / rng.uniform(0.8, 1.8), np.abs(dv))
        )
        inside = distance < size
        print_ = inside & ((np.sin(2 * np.pi * dv / size * rng.uniform(1, 3)) > 0.4) & (distance < 0.75 * size))
        mix, shade = np.where(inside, 1.0, mix), np.where(inside, np.where(print_, -0.5, 0.1), shade)
    return mix, shade


_PATTERNS = {
    "noise": _draw_noise,
    "stripes": _draw_stripes,
    "checker": _draw_checker,
    "wood": _grain,
    "planks": _draw_planks,
    "tiles": _draw_tiles,
    "speckle": _draw_speckle,
    "brushed": _draw_brushed,
    "marble": _draw_marble,
    "bricks": _draw_bricks,
    "concrete": _draw_concrete,
    "weave": _draw_weave,
    "scratched": _draw_scratched,
    "stickers": _draw_stickers,
}
