"""Things with one lid: a laptop and a trunk."""

from __future__ import annotations

import numpy as np

from quest.sim.procedural.handles import handle_part, sample_style
from quest.sim.procedural.model import Link, ObjectModel, Part, join
from quest.sim.procedural.shapes import box, centred_box


def build_laptop(rng: np.random.Generator) -> ObjectModel:
    """A laptop: a base with keys, and a lid with a screen, closed at 0. It has no handle; its rim is followed.

    Args:
        rng: source of randomness.
    """
    width, depth = float(rng.uniform(0.28, 0.38)), float(rng.uniform(0.19, 0.26))
    base, lid = float(rng.uniform(0.009, 0.018)), float(rng.uniform(0.004, 0.008))
    keys = [
        centred_box((x, y, base + 0.0006), (0.74 * 0.85 * width / 12, 0.72 * 0.4 * depth / 5, 0.0012))
        for x in 0.85 * width * ((np.arange(12) + 0.5) / 12 - 0.5)
        for y in depth * (0.46 + 0.4 * (np.arange(5) + 0.5) / 5)
    ]
    pad = centred_box((0, 0.24 * depth, base + 0.0002), (0.3 * width, 0.26 * depth, 0.0005))
    body = (
        Part("base_frame", box((-width / 2, 0, 0), (width / 2, depth, base)), "metal"),
        Part("keyboard", join(keys), "dark"),
        Part("touchpad", pad, "dark"),
    )
    # The lid in its joint's frame: the axis lies along x at the back, the screen looks down when closed.
    gap = 0.002
    bezel = 0.012
    shell = box((-width / 2, -depth, gap), (width / 2, 0.0, gap + lid))
    screen = box((-width / 2 + bezel, -depth + bezel, gap - 0.0006), (width / 2 - bezel, -2 * bezel, gap + 0.0005))
    parts = (Part("lid", shell, "metal"), Part("screen", screen, "dark"))
    opening = float(np.deg2rad(rng.uniform(95, 130)))
    link = Link("link_0", parts, "revolute", (0.0, depth, base), (-1.0, 0.0, 0.0), opening)
    return ObjectModel("Laptop", body, (link,))


def build_trunk(rng: np.random.Generator) -> ObjectModel:
    """An open box with a lid hinged at the back, with or without a handle at the lid's front.

    Args:
        rng: source of randomness.
    """
    width, depth, height = float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.3, 0.5)), float(rng.uniform(0.25, 0.5))
    wall = float(rng.uniform(0.01, 0.02))
    body = Part("box_body", join([
        box((-width / 2, 0, 0), (-width / 2 + wall, depth, height)),
        box((width / 2 - wall, 0, 0), (width / 2, depth, height)),
        box((-width / 2 + wall, 0, 0), (width / 2 - wall, wall, height)),
        box((-width / 2 + wall, depth - wall, 0), (width / 2 - wall, depth, height)),
        box((-width / 2 + wall, wall, 0), (width / 2 - wall, depth - wall, wall)),
    ]), "body")  # fmt: skip
    over, thick, skirt = 0.008, float(rng.uniform(0.012, 0.03)), float(rng.uniform(0.03, 0.08))
    front = -depth - over
    top = box((-width / 2 - over, front, 0.001), (width / 2 + over, 0.0, thick))
    flap = box((-width / 2 - over, front, -skirt), (width / 2 + over, front + over - 0.001, 0.001))
    parts = [Part("lid", join([top, flap]), "front")]
    if rng.random() < 0.7:
        style = sample_style(rng)
        middle = (thick - skirt) / 2
        parts.append(handle_part(style, at=(0, front, middle), vertical=False, room_m=(0.6 * width, thick + skirt)))
    opening = float(np.deg2rad(rng.uniform(80, 110)))
    link = Link("link_0", tuple(parts), "revolute", (0.0, depth, height), (-1.0, 0.0, 0.0), opening)
    return ObjectModel("Box", (body,), (link,))
