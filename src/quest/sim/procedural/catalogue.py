"""Which procedural objects there are, and the one function that writes them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from quest.errors import ConfigError
from quest.sim.procedural.laptop import build_laptop, build_trunk
from quest.sim.procedural.layouts import FURNITURE
from quest.sim.procedural.model import ObjectModel
from quest.sim.procedural.synthesizer import KITCHEN, build_kitchen
from quest.sim.procedural.urdf import write_object

_BUILDERS: dict[str, Callable[[np.random.Generator], ObjectModel]] = {
    **FURNITURE,
    **{name: partial(build_kitchen, name) for name in KITCHEN},
    "laptop": build_laptop,
    "trunk": build_trunk,
}

_WEIGHTS = {
    "chest": 6, "desk": 4, "cabinet": 6, "lockers": 5, "sideboard": 3, "wardrobe": 2, "night_stand": 1, "wall_unit": 2,
    "laptop": 2, "trunk": 1, "base_cabinet": 4, "wall_cabinet": 2, "island": 2, "sink_cabinet": 1, "microwave": 3,
    "refrigerator": 2, "french_refrigerator": 2, "range": 2, "dishwasher": 2,
}  # fmt: skip
"""The usual mix; a category without a weight is made for a suite and comes only by its name."""

CATEGORIES: tuple[str, ...] = tuple(_BUILDERS)
"""Names that :func:`make_object` knows."""

_MIX = tuple(name for name in CATEGORIES if name in _WEIGHTS)


def category_for_seed(seed: int) -> str:
    """The category that a seed stands for in the usual mix.

    Args:
        seed: seed of an object.
    """
    weights = np.array([_WEIGHTS[name] for name in _MIX], dtype=float)
    rng = np.random.default_rng([zlib.crc32(b"category"), seed])
    return _MIX[int(rng.choice(len(_MIX), p=weights / weights.sum()))]


def build_model(category: str, seed: int) -> ObjectModel:
    """The object of a category and a seed, not written yet.

    Args:
        category: one of :data:`CATEGORIES`.
        seed: same category and seed, same object.

    Raises:
        ConfigError: If the category is unknown or the seed negative.
    """
    if category not in _BUILDERS:
        raise ConfigError(f"procedural object: unknown category {category!r}; expected one of {', '.join(CATEGORIES)}")
    if seed < 0:
        raise ConfigError(f"procedural object: expected a seed >= 0, got {seed}")
    return _BUILDERS[category](np.random.default_rng([zlib.crc32(category.encode()), seed]))


def make_object(category: str, seed: int, folder: Path) -> Path:
    """Write a procedural object as a folder of PartNet-Mobility's shape, in metres.

    The folder gets ``mobility.urdf``, ``textured_objs/*.obj`` and ``meta.json``. Visuals of moving links are
    called ``handle-N`` or ``knob-N`` where they are one. Joints are 0 when closed; lower limits are 0.

    Args:
        category: one of :data:`CATEGORIES`.
        seed: same category and seed, same files.
        folder: where to write; made if missing.

    Returns:
        The folder.

    Raises:
        ConfigError: If the category is unknown or the seed negative.
    """
    name = f"{category}-{seed}"
    meta = {"category": category, "seed": seed, "source": "procedural", "unit_m": 1.0}
    return write_object(build_model(category, seed), Path(folder), name=name, meta=meta)
