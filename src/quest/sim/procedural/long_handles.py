"""Handles that run along their whole front: those of many refrigerators, ovens and kitchens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quest.sim.procedural.handles import HandleKind, handle_part, sample_style
from quest.sim.procedural.model import HANDLE_ROLES, Link, ObjectModel

_KINDS: tuple[HandleKind, ...] = ("bar", "square_bar", "arched", "bracket", "lip", "bow", "d_pull", "edge_pull")
_SHARE = (0.45, 0.98)
_SHORTEST_M = 0.05
_THICKER = (0.9, 2.2)
_THICKEST = 0.45
"""Of how far it sticks out."""


def with_long_handles(model: ObjectModel, rng: np.random.Generator) -> ObjectModel:
    """The object with one handle on every front that had one or more, nearly as long as the front.

    Upright on what turns about an upright axis, level on all else; where the first of the old ones was across that, and
    all of one style. Strips of a few centimetres keep theirs.

    Args:
        model: an object whose fronts look along -y.
        rng: source of randomness.
    """
    style = sample_style(rng, knobs=False)
    kind = _KINDS[int(rng.integers(len(_KINDS)))]
    thickness = min(style.thickness_m * float(rng.uniform(*_THICKER)), _THICKEST * style.reach_m)
    style = replace(style, kind=kind, thickness_m=thickness)
    share = float(rng.uniform(*_SHARE))

    def with_long(link: Link) -> Link:
        old = [part for part in link.parts if part.role in HANDLE_ROLES]
        others = tuple(part for part in link.parts if part.role not in HANDLE_ROLES)
        if not (old and others):
            return link
        bounds = np.stack([part.mesh.bounds for part in others])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        at, foot = old[0].mesh.bounds.mean(axis=0), float(old[0].mesh.bounds[1, 1])
        vertical = link.kind == "revolute" and abs(link.axis[2]) > 0.5
        along = 2 if vertical else 0
        at[along] = (low[along] + high[along]) / 2
        length = share * float(high[along] - low[along])
        if length < _SHORTEST_M:
            return link
        # A bowed door is foremost elsewhere.
        reach = style.reach_m + max(0.0, foot - float(low[1]))
        place, room = (float(at[0]), foot, float(at[2])), (0.1, length / 0.8) if vertical else (length / 0.8, 0.1)
        own = replace(style, length_m=length, reach_m=reach)
        return replace(link, parts=(*others, handle_part(own, at=place, vertical=vertical, room_m=room)))

    return replace(model, links=tuple(with_long(link) for link in model.links))
