"""What a parallel-jaw gripper is made of: a palm with two fingers, on a wrist.

Its frame lies between the pads: x across them, y from one finger to the other, z from the fingertips back to the palm.
Sizes at scale 1 are those of common electric grippers (Franka Hand, Robotiq 2F-85): it opens to 85 mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from quest.sim.surfaces import Surface, sample_colour, sample_handle_surface

OPENING_M = 0.085
PAD_HALF_M = (0.010, 0.003, 0.012)
REACH_M = 0.044
"""From the middle of the pads back to the palm."""
LENGTH_M = 0.245
"""From the middle of the pads to the end of the wrist."""

Material = Literal["shell", "metal", "rubber"]


@dataclass(frozen=True)
class GripperPart:
    """A box, or a cylinder along z.

    Attributes:
        kind: which of them.
        material: what it is made of.
        half_m: half extents along x, y, z.
        centre_m: middle; a finger's with its jaw closed.
        side: -1 or 1 if it moves with the finger on that side along y, else 0.
    """

    kind: Literal["box", "cylinder"]
    material: Material
    half_m: tuple[float, float, float]
    centre_m: tuple[float, float, float]
    side: int = 0


def _finger(side: int) -> tuple[GripperPart, ...]:
    x, y, z = PAD_HALF_M
    return (
        GripperPart("box", "rubber", (x, y, z), (0.0, side * y, 0.0), side),
        GripperPart("box", "metal", (0.009, 0.004, 0.028), (0.0, side * (2 * y + 0.004), 0.017), side),
        GripperPart("box", "metal", (0.012, 0.009, 0.008), (0.0, side * (2 * y + 0.007), REACH_M - 0.008), side),
    )


GRIPPER_PARTS = (
    *_finger(-1),
    *_finger(1),
    GripperPart("box", "rubber", (0.016, 0.066, 0.003), (0.0, 0.0, REACH_M + 0.003)),
    GripperPart("box", "shell", (0.026, 0.070, 0.027), (0.0, 0.0, REACH_M + 0.033)),
    GripperPart("cylinder", "metal", (0.034, 0.034, 0.010), (0.0, 0.0, REACH_M + 0.070)),
    GripperPart("cylinder", "rubber", (0.028, 0.028, 0.004), (0.0, 0.0, REACH_M + 0.084)),
    GripperPart("cylinder", "shell", (0.033, 0.033, 0.0565), (0.0, 0.0, LENGTH_M - 0.0565)),
)
"""The parts at scale 1 with closed jaws."""


@dataclass(frozen=True)
class Boxes:
    """Boxes along the axes of a gripper's frame, one a part.

    Attributes:
        low: smallest coordinates, metres.
        high: largest coordinates, metres.
    """

    low: Float[np.ndarray, "P 3"]
    high: Float[np.ndarray, "P 3"]

    @classmethod
    def of(cls, scale: float, opening_m: float, *, shrink_m: float = 0.0) -> Boxes:
        """Those of a gripper with some distance between its pads, each smaller by ``shrink_m`` on all sides."""
        centre = scale * np.array([p.centre_m for p in GRIPPER_PARTS])
        centre[:, 1] += opening_m / 2 * np.array([p.side for p in GRIPPER_PARTS])
        half = scale * np.array([p.half_m for p in GRIPPER_PARTS]) - shrink_m
        return cls(centre - half, centre + half)

    def swept(self, back_m: float) -> Boxes:
        """What they pass on a straight way back, along z."""
        high = self.high.copy()
        high[:, 2] += back_m
        return Boxes(self.low, high)

    def hit(self, points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " M"]:
        """Indices of the points that lie inside."""
        about = np.flatnonzero(((points > self.low.min(axis=0)) & (points < self.high.max(axis=0))).all(axis=1))
        near = points[about, None]
        inside = ((near > self.low) & (near < self.high)).all(axis=2)
        return about[np.logical_or.reduce(inside, axis=1)]

    @property
    def corners(self) -> Float[np.ndarray, "N 3"]:
        """All their corners."""
        pick = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
        bounds = np.stack((self.low, self.high))
        return np.concatenate([bounds[pick[:, axis], :, axis].reshape(-1, 1) for axis in range(3)], axis=1)


def sample_gripper_surfaces(rng: np.random.Generator) -> dict[Material, Surface]:
    """Draw what a gripper looks like: a shell in white, grey, black or paint, metal fingers, black rubber."""
    kind, grey = rng.choice(3, p=(0.45, 0.3, 0.25)), float(rng.uniform(0.75, 0.95))
    dark = float(rng.uniform(0.08, 0.25))
    colour = ((grey, grey, grey), (dark, dark, dark), sample_colour(rng))[int(kind)]
    shell = Surface(colour, float(rng.uniform(0.35, 0.7)), 0.0, float(rng.uniform(0.2, 0.5)))
    rubber = Surface((0.07, 0.07, 0.075), 0.9, 0.0, 0.15)
    return {"shell": shell, "metal": sample_handle_surface(rng), "rubber": rubber}
