"""Materials: what a surface looks like, drawn at random, and put on SAPIEN's render parts.

Textures are small tileable colour images: wood, tiles, marble, bricks, concrete, woven cloth, scratches, stickers and
others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

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
    """A procedural texture; :func:`paint` makes its image."""

    kind: TextureKind
    first: Colour
    """Main colour."""
    second: Colour
    """Colour of the pattern's other half (grout, dark grain, second check)."""
    repeats: int
    """How often the pattern repeats over the image, at least 1."""
    seed: int
    """Seed of what is random in the pattern."""


def paint(texture: Texture, *, size: int = 128) -> UInt8[np.ndarray, "S S 4"]:
    """The image of a texture; its edges match, the grain runs along x, alpha is 255."""
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


def _noise(rng: np.random.Generator, u: _Field, falloff: float, stretch: float = 1.0) -> _Field:
    """Periodic noise of zero mean and unit spread; ``stretch`` > 1 draws it out along x."""
    size = len(u)
    fy, fx = np.meshgrid(np.fft.fftfreq(size) * size, np.fft.rfftfreq(size) * size, indexing="ij")
    radius = np.hypot(fx * stretch, fy)
    radius[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / np.maximum(radius, 1.0) ** falloff
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, s=(size, size))
    return field / field.std()


def _grain(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    warp = 0.12 * _noise(rng, u, 2.0, stretch=3.0)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (2 * n * v + 3 * warp))
    fine = _noise(rng, u, 0.5, stretch=12.0)
    return 0.55 * rings**2 + 0.12 * fine, 0.03 * fine


def _planks(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    mix, shade = _grain(rng, u, v, 2 * n)
    rows = 2 * n
    row = (v * rows).astype(int) % rows
    tone = 0.1 * rng.standard_normal(rows)[row]
    start = rng.uniform(0, 1, rows)[row]
    joint = ((v * rows) % 1 < 0.06) | (((u + start) % 1) < 0.012)
    return 0.7 * mix, shade + tone - 0.45 * joint


def _tiles(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    n, width = 2 * n, rng.uniform(0.03, 0.08)
    grout = (((u * n) % 1) < width) | (((v * n) % 1) < width)
    tone = rng.standard_normal((n, n))[(v * n).astype(int) % n, (u * n).astype(int) % n]
    return grout.astype(float), 0.07 * tone * ~grout + 0.02 * _noise(rng, u, 1.0)


def _marble(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    # Veins run where a slow field crosses zero; some are broad and faint, others thin and dark.
    broad = np.exp(-(np.abs(_noise(rng, u, 1.7)) / 0.22))
    thin = np.exp(-(np.abs(_noise(rng, u, 1.5)) / 0.05))
    return 0.45 * broad + 0.55 * thin * rng.uniform(0.5, 1.0), 0.05 * _noise(rng, u, 1.6)


def _bricks(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    rows, across = 4 * n, 2 * n
    row = (v * rows).astype(int) % rows
    x = (u + 0.5 / across * (row % 2)) % 1
    width = rng.uniform(0.05, 0.12)
    mortar = ((v * rows) % 1 < width) | ((x * across) % 1 < 0.5 * width)
    tone = rng.standard_normal((rows, across))[row, (x * across).astype(int) % across]
    return mortar.astype(float), 0.09 * tone * ~mortar + 0.05 * _noise(rng, u, 0.8)


def _concrete(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    pores = _noise(rng, u, 0.7) > 2.2
    return 0.25 + 0.08 * _noise(rng, u, 1.5), 0.03 * _noise(rng, u, 0.4) - 0.2 * pores


def _weave(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    threads = 16 * n
    warp, weft = np.abs(np.sin(np.pi * threads * u)), np.abs(np.sin(np.pi * threads * v))
    over = ((u * threads).astype(int) + (v * threads).astype(int)) % 2 == 0
    shade = 0.25 * (np.where(over, warp, weft) - 0.7)
    return np.where(over, 0.0, rng.uniform(0.4, 1.0)), shade + 0.03 * _noise(rng, u, 0.5)


def _scratched(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    marks = np.zeros_like(u)
    for _ in range(int(rng.integers(8, 24)) * n):
        x, y, turn = rng.random(), rng.random(), rng.uniform(0, np.pi)
        du, dv = (u - x + 0.5) % 1 - 0.5, (v - y + 0.5) % 1 - 0.5
        along, across = du * np.cos(turn) + dv * np.sin(turn), dv * np.cos(turn) - du * np.sin(turn)
        inside = (np.abs(along) < rng.uniform(0.03, 0.2)) & (np.abs(across) < rng.uniform(0.003, 0.006))
        marks = np.maximum(marks, inside * rng.uniform(0.4, 1.0))
    return marks, 0.03 * _noise(rng, u, 1.2)


def _stickers(rng: np.random.Generator, u: _Field, v: _Field, n: int) -> tuple[_Field, _Field]:
    mix, shade = np.zeros_like(u), 0.02 * _noise(rng, u, 1.0)
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


_PATTERNS: dict[str, Callable[[np.random.Generator, _Field, _Field, int], tuple[_Field, _Field]]] = {
    "noise": lambda rng, u, v, n: (0.5 + 0.25 * _noise(rng, u, 1.6), 0.03 * _noise(rng, u, 0.3)),
    "stripes": lambda rng, u, v, n: (
        ((v * 2 * n) % 1 < rng.uniform(0.2, 0.6)).astype(float),
        0.03 * _noise(rng, u, 1.0),
    ),
    "checker": lambda rng, u, v, n: (
        (((u * 2 * n).astype(int) + (v * 2 * n).astype(int)) % 2).astype(float),
        0.03 * _noise(rng, u, 1.0),
    ),
    "wood": _grain,
    "planks": _planks,
    "tiles": _tiles,
    "speckle": lambda rng, u, v, n: (
        (_noise(rng, u, 0.4) > rng.uniform(0.6, 1.4)).astype(float),
        0.05 * _noise(rng, u, 0.8),
    ),
    "brushed": lambda rng, u, v, n: (0.5 + 0.2 * _noise(rng, u, 0.4, stretch=25.0), np.zeros_like(u)),
    "marble": _marble,
    "bricks": _bricks,
    "concrete": _concrete,
    "weave": _weave,
    "scratched": _scratched,
    "stickers": _stickers,
}
"""Share of the second colour, and shade, over an image; from horizontal and vertical places in [0, 1) and repeats."""


TILE_M = 0.5
"""Edge of the square that one texture image covers."""


@dataclass(frozen=True)
class Surface:
    """A material."""

    colour: Colour
    """sRGB colour where there is no texture."""
    roughness: float
    """0 mirror, 1 matt."""
    metallic: float
    """0 or near it for paint and wood, near 1 for metal."""
    specular: float
    """Strength of the highlight of what is not metal."""
    texture: Texture | None = None
    """Colours instead of ``colour``, or None."""


_COLOURS = (
    ((0.04, 0.12), (0.2, 0.75), (0.2, 0.9)),  # wood
    ((0.0, 1.0), (0.0, 0.1), (0.35, 0.97)),  # white to grey
    ((0.0, 1.0), (0.1, 0.7), (0.3, 0.9)),  # paint
    ((0.0, 1.0), (0.0, 0.3), (0.12, 0.28)),  # nearly black
)
"""Hue, saturation and value of the colours that furniture and rooms have."""
_HANDLES = (
    ((1.0, 1.0, 1.0), (0.6, 0.9), (0.25, 0.5), (0.4, 0.85), 0.5),  # steel
    ((1.0, 1.0, 1.0), (0.03, 0.15), (0.3, 0.9), 0.0, 0.4),  # black
    ((1.0, 0.8, 0.45), (0.55, 0.9), (0.25, 0.5), (0.4, 0.8), 0.5),  # brass
    ((0.93, 0.93, 0.91), 1.0, (0.3, 0.7), 0.0, 0.4),  # white
)
"""Tint, brightness, roughness, metallic and specular of handles: numbers, or ranges that they are drawn from."""


def sample_colour(rng: np.random.Generator) -> Colour:
    """Draw a colour that furniture and rooms have: wood, white to grey, paint, nearly black."""
    family = _COLOURS[int(rng.choice(4, p=[0.35, 0.32, 0.26, 0.07]))]
    hue, saturation, value = (float(rng.uniform(*channel)) for channel in family)
    rgb = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return triple(value * (1 - saturation * (1 - rgb)))


def sample_surface(
    rng: np.random.Generator, *, kinds: Sequence[TextureKind] = TEXTURE_KINDS, textured: float
) -> Surface:
    """Draw a material.

    ``textured`` says how often there is a texture, one of ``kinds``.
    """
    colour = sample_colour(rng)
    texture = None
    if rng.random() < textured:
        kind = kinds[int(rng.integers(len(kinds)))]
        near = np.clip(np.asarray(colour) * rng.uniform(0.5, 0.85) if rng.random() < 0.6 else sample_colour(rng), 0, 1)
        texture = Texture(kind, colour, triple(near), int(rng.integers(1, 4)), int(rng.integers(2**31)))
    metallic = 0.0 if rng.random() < 0.9 else float(rng.uniform(0.3, 0.8))
    return Surface(colour, float(rng.uniform(0.35, 1.0)), metallic, float(rng.uniform(0.0, 0.5)), texture)


def sample_handle_surface(rng: np.random.Generator) -> Surface:
    """Draw a material for handles: steel, black, brass, white, or anything."""
    kind = int(rng.choice(5, p=[0.4, 0.2, 0.15, 0.1, 0.15]))
    if kind == len(_HANDLES):
        return sample_surface(rng, kinds=("wood", "noise"), textured=0.3)
    tint, *rest = _HANDLES[kind]
    value, roughness, metallic, specular = (float(rng.uniform(*x)) if isinstance(x, tuple) else x for x in rest)
    return Surface(triple(value * np.array(tint)), roughness, metallic, specular)


def sample_glass_surface(rng: np.random.Generator) -> Surface:
    """Draw a material for panes: dark, smooth and glossy, as glass before a dark inside looks."""
    grey = float(rng.uniform(0.03, 0.22))
    tint = rng.uniform(0.9, 1.1, 3)
    return Surface(triple(np.clip(grey * tint, 0, 1)), float(rng.uniform(0.05, 0.2)), 0.0, float(rng.uniform(0.5, 0.9)))


def make_material(surface: Surface) -> Any:
    """A ``sapien.render.RenderMaterial`` of a surface."""
    import sapien

    material = sapien.render.RenderMaterial()
    wear(material, surface, make_texture(surface))
    return material


def make_texture(surface: Surface) -> Any:
    """The ``sapien.render.RenderTexture2D`` of a surface, or None if it has no texture."""
    import sapien

    if surface.texture is None:
        return None
    return sapien.render.RenderTexture2D(paint(surface.texture), "R8G8B8A8Unorm", mipmap_levels=6, srgb=True)


def wear(material: Any, surface: Surface, texture: Any) -> None:
    """Make a ``sapien.render.RenderMaterial`` look like a surface whose texture is already made."""
    linear = np.asarray(surface.colour) ** 2.2
    material.set_base_color([*linear.tolist(), 1.0] if texture is None else [1.0, 1.0, 1.0, 1.0])
    material.base_color_texture = texture
    material.emission = [0.0, 0.0, 0.0, 0.0]
    material.set_roughness(surface.roughness)
    material.set_metallic(surface.metallic)
    material.set_specular(surface.specular)


def ensure_uv(part: Any, scale: Float[np.ndarray, "3"]) -> None:
    """Project texture coordinates along each normal's main axis where a part has none.

    SAPIEN shares meshes between scenes: a part that was given coordinates before is left as it is, so that the order
    in which takes are rendered changes nothing.
    """
    if np.ptp(part.get_vertex_uv(), axis=0).max(initial=0.0) > 1e-6:
        return
    vertices, normals = part.get_vertices() * scale, part.get_vertex_normal()
    size = np.ptp(vertices, axis=0)
    main = np.abs(normals).argmax(axis=1)
    uv = np.zeros((len(vertices), 2), dtype=np.float32)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        columns = [u, v] if size[u] >= size[v] else [v, u]
        uv[main == axis] = vertices[main == axis][:, columns] / TILE_M
    part.set_vertex_uv(uv)


def triple(values: Any) -> tuple[float, float, float]:
    """Three plain floats out of anything that holds three numbers."""
    x, y, z = (float(value) for value in values)
    return x, y, z
