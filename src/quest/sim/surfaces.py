"""Materials: what a surface looks like, drawn at random, and put on SAPIEN's render parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.sim.textures import TEXTURE_KINDS, Colour, Texture, TextureKind, paint

TILE_M = 0.5
"""Edge of the square that one texture image covers."""


@dataclass(frozen=True)
class Surface:
    """A material.

    Attributes:
        colour: sRGB colour where there is no texture.
        roughness: 0 mirror, 1 matt.
        metallic: 0 or near it for paint and wood, near 1 for metal.
        specular: strength of the highlight of what is not metal.
        texture: colours instead of ``colour``, or None.
    """

    colour: Colour
    roughness: float
    metallic: float
    specular: float
    texture: Texture | None = None


def sample_colour(rng: np.random.Generator) -> Colour:
    """Draw a colour that furniture and rooms have: wood, white to grey, paint, nearly black."""
    family = rng.choice(4, p=[0.35, 0.32, 0.26, 0.07])
    if family == 0:  # wood
        hue, saturation, value = rng.uniform(0.04, 0.12), rng.uniform(0.2, 0.75), rng.uniform(0.2, 0.9)
    elif family == 1:  # white to grey
        hue, saturation, value = rng.random(), rng.uniform(0.0, 0.1), rng.uniform(0.35, 0.97)
    elif family == 2:  # paint
        hue, saturation, value = rng.random(), rng.uniform(0.1, 0.7), rng.uniform(0.3, 0.9)
    else:  # nearly black
        hue, saturation, value = rng.random(), rng.uniform(0.0, 0.3), rng.uniform(0.12, 0.28)
    return _from_hsv(float(hue), float(saturation), float(value))


def _from_hsv(hue: float, saturation: float, value: float) -> Colour:
    rgb = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return triple(value * (1 - saturation * (1 - rgb)))


def sample_surface(
    rng: np.random.Generator, *, kinds: Sequence[TextureKind] = TEXTURE_KINDS, textured: float
) -> Surface:
    """Draw a material.

    Args:
        rng: source of randomness.
        kinds: textures that may come out.
        textured: how often there is a texture.
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
    kind = rng.choice(5, p=[0.4, 0.2, 0.15, 0.1, 0.15])
    if kind == 0:  # steel
        grey = float(rng.uniform(0.6, 0.9))
        return Surface((grey, grey, grey), float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.4, 0.85)), 0.5)
    if kind == 1:  # black
        grey = float(rng.uniform(0.03, 0.15))
        return Surface((grey, grey, grey), float(rng.uniform(0.3, 0.9)), 0.0, 0.4)
    if kind == 2:  # brass
        value = float(rng.uniform(0.55, 0.9))
        colour = (value, 0.8 * value, 0.45 * value)
        return Surface(colour, float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.4, 0.8)), 0.5)
    if kind == 3:  # white
        return Surface((0.93, 0.93, 0.91), float(rng.uniform(0.3, 0.7)), 0.0, 0.4)
    return sample_surface(rng, kinds=("wood", "noise"), textured=0.3)


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
