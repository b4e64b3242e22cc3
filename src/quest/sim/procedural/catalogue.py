"""Which procedural objects there are, and the one function that writes them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from quest.errors import ConfigError
from quest.sim.procedural.appliances import APPLIANCES, with_dials
from quest.sim.procedural.clutter import with_clutter
from quest.sim.procedural.furniture import STORAGE, TABLES
from quest.sim.procedural.handles import with_long_handles
from quest.sim.procedural.layouts import FURNITURE
from quest.sim.procedural.model import ObjectModel, write_object
from quest.sim.procedural.room_door import build_room_door
from quest.sim.procedural.synthesizer import KITCHEN, build_kitchen
from quest.sim.procedural.things import THINGS, build_laptop, build_trunk
from quest.types import GRIPS

_OFTEN_BARE = (
    "chest", "night_stand", "cabinet", "wardrobe", "sideboard", "desk", "drawer_desk", "wall_unit", "refrigerator",
    "french_refrigerator", "microwave", "apron_table",
)  # fmt: skip


_OFTEN_LONG = (
    "chest", "cabinet", "wardrobe", "sideboard", "wall_unit", "base_cabinet", "wall_cabinet", "refrigerator",
    "french_refrigerator", "microwave", "range", "dishwasher", "rack_dishwasher", "drawer_oven",
)  # fmt: skip
_OFTEN_BUSY = (
    "chest", "cabinet", "sideboard", "wall_unit", "desk", "base_cabinet", "refrigerator", "long_refrigerator",
    "bare_microwave", "microwave", "long_microwave", "range", "dishwasher", "long_drawer_oven",
)  # fmt: skip

_OFTEN_DIALS = (
    "range", "long_range", "drawer_oven", "long_drawer_oven", "microwave", "bare_microwave", "long_microwave",
    "dishwasher", "rack_dishwasher", "washing_machine",
)  # fmt: skip


def _build_bare(category: str, rng: np.random.Generator) -> ObjectModel:
    """Furniture that opens without handles: its fronts and rims are followed."""
    model = _BUILDERS[category](rng)
    links = [replace(link, parts=tuple(p for p in link.parts if p.role not in GRIPS)) for link in model.links]
    return replace(model, links=tuple(links))


def _build_long(category: str, rng: np.random.Generator) -> ObjectModel:
    """Furniture and appliances with handles as long as their fronts."""
    return with_long_handles(_BUILDERS[category](rng), rng)


def _build_busy(category: str, rng: np.random.Generator) -> ObjectModel:
    """Furniture and appliances with what is no handle on and around them."""
    return with_clutter(_BUILDERS[category](rng), rng)


def _build_dials(category: str, rng: np.random.Generator) -> ObjectModel:
    """Appliances with dials that turn."""
    return with_dials(_BUILDERS[category](rng), rng)


_BUILDERS: dict[str, Callable[[np.random.Generator], ObjectModel]] = {
    **FURNITURE,
    **{name: partial(build_kitchen, name) for name in KITCHEN},
    "laptop": build_laptop,
    "trunk": build_trunk,
    **STORAGE,
    **APPLIANCES,
    **THINGS,
    "room_door": build_room_door,
    **TABLES,
    **{f"bare_{name}": partial(_build_bare, name) for name in _OFTEN_BARE},
    **{f"long_{name}": partial(_build_long, name) for name in _OFTEN_LONG},
    **{f"busy_{name}": partial(_build_busy, name) for name in _OFTEN_BUSY},
    **{f"dial_{name}": partial(_build_dials, name) for name in _OFTEN_DIALS},
}

_WEIGHTS = {
    "chest": 6, "desk": 4, "cabinet": 6, "lockers": 5, "sideboard": 3, "wardrobe": 2, "night_stand": 1, "wall_unit": 2,
    "laptop": 2, "trunk": 1, "base_cabinet": 4, "wall_cabinet": 2, "island": 2, "sink_cabinet": 1, "microwave": 3,
    "refrigerator": 2, "french_refrigerator": 2, "range": 2, "dishwasher": 2,
}  # fmt: skip
"""The usual mix, whose seeds keep their meaning: it never changes. What has no weight comes by its name, or broadly."""

_MORE_WEIGHTS = {
    "locker_bank": 1, "drawer_desk": 4, "apothecary": 3, "filing_cabinet": 3, "toolbox": 3, "rack_dishwasher": 3,
    "drawer_oven": 2, "washing_machine": 2, "eyeglasses": 2, "stapler": 2, "bucket": 2, "pot": 2, "room_door": 3,
}  # fmt: skip

MIXES: dict[str, dict[str, int]] = {"usual": _WEIGHTS, "broad": {**_WEIGHTS, **_MORE_WEIGHTS}}
"""How often each category comes: the usual mix, and one of everything but tables with drawers in their apron,
sunglasses, what has no handles (``bare_``), long ones (``long_``), what is no handle beside its own (``busy_``), or
dials that turn (``dial_``)."""

CATEGORIES: tuple[str, ...] = tuple(_BUILDERS)
"""Names that :func:`make_object` knows."""


def category_for_seed(seed: int, *, mix: str = "usual") -> str:
    """The category that a seed stands for in a mix.

    Args:
        seed: seed of an object.
        mix: a key of :data:`MIXES`.

    Raises:
        ConfigError: there is no such mix.
    """
    if mix not in MIXES:
        raise ConfigError(f"procedural objects: unknown mix {mix!r}; expected one of {', '.join(MIXES)}")
    weight_of = MIXES[mix]
    names = [name for name in CATEGORIES if name in weight_of]
    weights = np.array([weight_of[name] for name in names], dtype=float)
    rng = np.random.default_rng([zlib.crc32(b"category"), seed])
    return names[int(rng.choice(len(names), p=weights / weights.sum()))]


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
