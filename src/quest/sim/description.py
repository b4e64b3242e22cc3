"""A user's description of an object: ``entities.json`` beside a URDF says what its visuals are called in our words.

A URDF tells how an object moves, not where its handles are. A few lines tell the rest::

    {"category": "Toolbox", "size_m": 0.45, "front": "-y",
     "entities": [{"visual": "grip*", "label": "handle"},
                  {"link": "tray", "label": "front"},
                  {"link": "lid", "label": "knob", "point": [0.0, -0.21, 0.04]}]}

Links that no entry speaks of keep the entities that are found without a description.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from quest.errors import ObjectError
from quest.sim.articulation import Articulation, Part, apply
from quest.sim.entities import PlacedEntity
from quest.types import GRIPS, LABELS
from quest.untrusted import build, read_json

DESCRIPTION_NAME = "entities.json"
"""Name of the file beside the URDF."""
CREDIT_NAME = "credit.json"
"""Name of the file beside it in which an import says whose model it is."""

FRONTS = {"+x": 0.0, "+y": np.pi / 2, "-x": np.pi, "-y": -np.pi / 2}
"""Azimuth of each direction that an object's front may look along, in the frame of the URDF's root link."""

_KEYS = ("category", "size_m", "height_m", "front", "entities")
_ENTITY_KEYS = ("link", "visual", "label", "point")


@dataclass(frozen=True)
class DescribedEntity:
    """One entry of ``entities``."""

    where: str
    """File and entry, for messages."""
    label: str
    link: str | None
    """Name of the URDF's link, or None."""
    visual: str | None
    """Pattern of names of visuals or mesh files (``*`` stands for anything), or None."""
    point: tuple[float, float, float] | None
    """Position in the link's frame, in the URDF's units, or None."""


@dataclass(frozen=True)
class Description:
    """What a user says of an object."""

    category: str | None = None
    """What it is; None if not told."""
    size_m: float | None = None
    """Its longest extent at rest, or None."""
    height_m: float | None = None
    """Its height at rest, or None."""
    front: str | None = None
    """A key of :data:`FRONTS`, or None to find out."""
    entities: tuple[DescribedEntity, ...] = ()
    """What can be followed."""


NOTHING_SAID = Description()

CORRECTIONS = {
    "01909": Description(entities=(DescribedEntity("01909", "handle", None, "original-56", None),)),
    "door_dh": Description(entities=(DescribedEntity("door_dh", "handle", None, "fixed_part*", None),)),
}
"""Handles that the annotation of PartNet-Mobility calls something else, by object."""


def read_description(path: Path) -> Description:
    """Read a description.

    Raises:
        ObjectError: it is not JSON, or an entry has a field that is unknown, missing or of a wrong kind.
    """
    raw = read_json(path, ObjectError, "mend it, see docs/objects.md")
    _check_keys(raw, _KEYS, str(path))
    sizes = {key: _positive(raw[key], f"{path}: {key}") for key in ("size_m", "height_m") if key in raw}
    if len(sizes) > 1:
        raise ObjectError(f"{path}: expected size_m or height_m, got both; leave one out")
    front = raw.get("front")
    if front is not None and (not isinstance(front, str) or front not in FRONTS):
        raise ObjectError(f"{path}: front is {front!r}, expected one of {', '.join(FRONTS)}; name where doors open to")
    entities = raw.get("entities", [])
    if not isinstance(entities, list):
        raise ObjectError(f"{path}: entities is {type(entities).__name__}, expected a list; see docs/objects.md")
    category = raw.get("category")
    if category is not None and (not isinstance(category, str) or not category):
        raise ObjectError(f"{path}: category is {category!r}, expected a word such as StorageFurniture; name one")
    described = tuple(_described(entry, f"{path}: entities[{n}]") for n, entry in enumerate(entities))
    return Description(category, sizes.get("size_m"), sizes.get("height_m"), front, described)


def _check_keys(raw: Any, known: tuple[str, ...], where: str) -> None:
    if not isinstance(raw, dict):
        raise ObjectError(f"{where}: expected an object in braces, got {type(raw).__name__}; see docs/objects.md")
    unknown = sorted(set(raw) - set(known))
    if unknown:
        raise ObjectError(f"{where}: unknown field {unknown[0]!r}; expected fields out of {', '.join(known)}")


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e4:
        raise ObjectError(f"{where} is {value!r}, expected metres > 0; give the object's real size")
    return float(value)


def _described(raw: Any, where: str) -> DescribedEntity:
    _check_keys(raw, _ENTITY_KEYS, where)
    label, link, visual, point = (raw.get(key) for key in ("label", "link", "visual", "point"))
    if label not in LABELS:
        raise ObjectError(f"{where}: label is {label!r}, expected one of {', '.join(LABELS)}; name one")
    for key, value in (("link", link), ("visual", visual)):
        if value is not None and (not isinstance(value, str) or not value):
            raise ObjectError(f"{where}: {key} is {value!r}, expected a name; use one of the URDF's names")
    if link is None and visual is None:
        raise ObjectError(f"{where}: expected a link or a visual, found neither; say which part of the URDF is meant")
    if point is None:
        if visual is None and label in GRIPS:
            raise ObjectError(f"{where}: a {label} needs a visual or a point; say where on link {link!r} it is")
        return DescribedEntity(where, label, link, visual, None)
    if visual is not None:
        raise ObjectError(f"{where}: got a visual and a point, expected one of them; leave one out")
    try:
        return DescribedEntity(where, label, link, None, build(tuple[float, float, float], point))
    except ValueError as error:
        raise ObjectError(
            f"{where}: point is {point!r}, expected [x, y, z] in the frame of its link; give three numbers"
        ) from error


def place(
    description: Description,
    articulation: Articulation,
    body_of_link: Mapping[str, tuple[int, Float[np.ndarray, "4 4"]]],
    scale: float,
) -> tuple[PlacedEntity, ...]:
    """A description's entities as bodies and parts of the object.

    ``body_of_link`` has the body that each URDF link belongs to, and the link's pose in it in the URDF's units, one of
    which is ``scale`` metres.

    Raises:
        ObjectError: a link or a visual is not in the URDF, or a rim or front is asked of a link without the joint
            that it needs.
    """
    return tuple(_placed(entry, articulation, body_of_link, scale) for entry in description.entities)


def _names(part: Part) -> tuple[str, str, str]:
    """What a part may be called: by the URDF, by an annotation, by its mesh file."""
    return part.visual, part.name, part.mesh.stem if isinstance(part.mesh, Path) else ""


def _placed(
    entry: DescribedEntity,
    articulation: Articulation,
    body_of_link: Mapping[str, tuple[int, Float[np.ndarray, "4 4"]]],
    scale: float,
) -> PlacedEntity:
    body = None
    if entry.link is not None:
        if entry.link not in body_of_link:
            raise ObjectError(
                f"{entry.where}: the URDF has no link {entry.link!r}; expected one of {', '.join(body_of_link)}"
            )
        body = body_of_link[entry.link][0]
    if entry.visual is not None:
        parts = tuple(
            i
            for i, part in enumerate(articulation.parts)
            if (body is None or part.body == body) and any(fnmatchcase(name, entry.visual) for name in _names(part))
        )
        if not parts:
            names = sorted({next(filter(None, (*_names(part), part.shape))) for part in articulation.parts})
            raise ObjectError(
                f"{entry.where}: no visual is called {entry.visual!r}; expected a name or pattern out of "
                f"{', '.join(names[:12])}{' ...' if len(names) > 12 else ''}"
            )
        return PlacedEntity(entry.where, entry.label, body or 0, None, parts)
    assert body is not None
    if entry.point is None:
        kind = None if body == 0 else articulation.joints[body - 1].joint.kind
        needs = "revolute" if entry.label == "rim" else "prismatic"
        if kind != needs:
            raise ObjectError(
                f"{entry.where}: the {entry.label} of link {entry.link!r} cannot be found, because its joint is "
                f"{kind or 'fixed'} and not {needs}; give a point"
            )
        return PlacedEntity(entry.where, entry.label, body, None, ())
    point = scale * apply(body_of_link[str(entry.link)][1], np.array(entry.point))
    return PlacedEntity(entry.where, entry.label, body, point, ())
