"""Which procedural objects there are, and the one function that makes them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from quest.errors import ConfigError
from quest.sim.objects import SimObject, object_from_urdf
from quest.sim.procedural import appliances, furniture, things
from quest.sim.procedural.appliances import with_dials
from quest.sim.procedural.clutter import with_clutter
from quest.sim.procedural.handles import with_long_handles
from quest.sim.procedural.model import Dice, ObjectModel, as_urdf
from quest.sim.procedural.synthesizer import KITCHEN, build_kitchen


def _without_handles(model: ObjectModel, rng: Dice) -> ObjectModel:
    """Furniture that opens without handles: its fronts and rims are followed."""
    return replace(model, links=tuple(replace(link, parts=link.rest) for link in model.links))


_BUILDERS: dict[str, Callable[[Dice], ObjectModel]] = {
    "chest": furniture.chest, "night_stand": furniture.night_stand, "cabinet": furniture.cabinet,
    "lockers": furniture.lockers, "locker_bank": furniture.locker_bank, "wardrobe": furniture.wardrobe,
    "sideboard": furniture.sideboard, "desk": furniture.desk, "wall_unit": furniture.wall_unit,
    "french_refrigerator": furniture.french_refrigerator,
    **{name: partial(build_kitchen, name) for name in KITCHEN},
    "laptop": things.laptop, "trunk": things.trunk,
    "drawer_desk": furniture.drawer_desk, "apothecary": furniture.apothecary,
    "filing_cabinet": furniture.filing_cabinet, "toolbox": furniture.toolbox,
    "rack_dishwasher": appliances.rack_dishwasher, "drawer_oven": appliances.drawer_oven,
    "washing_machine": appliances.washing_machine,
    "eyeglasses": things.eyeglasses, "sunglasses": things.sunglasses, "stapler": things.stapler,
    "bucket": things.bucket, "pot": things.pot, "room_door": things.room_door,
    "apron_table": furniture.apron_table,
}  # fmt: skip
"""Their order is part of what a seed of a mix means."""
_CHANGES: dict[str, tuple[Callable[[ObjectModel, Dice], ObjectModel], tuple[str, ...]]] = {
    "bare": (_without_handles, (
        "chest", "night_stand", "cabinet", "wardrobe", "sideboard", "desk", "drawer_desk", "wall_unit", "refrigerator",
        "french_refrigerator", "microwave", "apron_table",
    )),
    "long": (with_long_handles, (
        "chest", "cabinet", "wardrobe", "sideboard", "wall_unit", "base_cabinet", "wall_cabinet", "refrigerator",
        "french_refrigerator", "microwave", "range", "dishwasher", "rack_dishwasher", "drawer_oven",
    )),
    "busy": (with_clutter, (
        "chest", "cabinet", "sideboard", "wall_unit", "desk", "base_cabinet", "refrigerator", "long_refrigerator",
        "bare_microwave", "microwave", "long_microwave", "range", "dishwasher", "long_drawer_oven",
    )),
    "dial": (with_dials, (
        "range", "long_range", "drawer_oven", "long_drawer_oven", "microwave", "bare_microwave", "long_microwave",
        "dishwasher", "rack_dishwasher", "washing_machine",
    )),
}  # fmt: skip
"""What can be done to an object, by the first word of its category, and the categories that it is done to."""

CATEGORIES: tuple[str, ...] = (
    *_BUILDERS,
    *(f"{word}_{category}" for word, (_, categories) in _CHANGES.items() for category in categories),
)
"""Names that :func:`make_object` knows."""

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


def category_for_seed(seed: int, *, mix: str = "usual") -> str:
    """The category that the seed of an object stands for in a mix, a key of :data:`MIXES`.

    Raises:
        ConfigError: there is no such mix.
    """
    if mix not in MIXES:
        raise ConfigError(f"procedural objects: unknown mix {mix!r}; expected one of {', '.join(MIXES)}")
    names = [name for name in CATEGORIES if name in MIXES[mix]]
    weights = np.array([MIXES[mix][name] for name in names], dtype=float)
    rng = np.random.default_rng([zlib.crc32(b"category"), seed])
    return names[int(rng.choice(len(names), p=weights / weights.sum()))]


def build_model(category: str, seed: int) -> ObjectModel:
    """The model of a category and a seed.

    Raises:
        ConfigError: the category is unknown or the seed negative.
    """
    if category not in CATEGORIES:
        raise ConfigError(f"procedural object: unknown category {category!r}; expected one of {', '.join(CATEGORIES)}")
    if seed < 0:
        raise ConfigError(f"procedural object: expected a seed >= 0, got {seed}")
    return _built(category, Dice(np.random.PCG64([zlib.crc32(category.encode()), seed])))


def _built(category: str, rng: Dice) -> ObjectModel:
    word, _, changed = category.partition("_")
    if word in _CHANGES:
        return _CHANGES[word][0](_built(changed, rng), rng)
    return _BUILDERS[category](rng)


def make_object(category: str, seed: int) -> SimObject:
    """A procedural object in metres; same category and seed, same object.

    Its joints are 0 when closed, which is their lower limit.

    Raises:
        ConfigError: the category is unknown or the seed negative.
    """
    model = build_model(category, seed)
    return object_from_urdf(as_urdf(model), f"{category}-{seed}", model.model_cat, source="procedural")
