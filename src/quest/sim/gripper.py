"""A parallel gripper that comes, takes hold of what is to move, moves with it, lets go and leaves.

Its frame lies between the pads: x across them, y from one finger to the other, z from the fingertips back to the palm.
Sizes at scale 1 are those of common electric grippers (Franka Hand, Robotiq 2F-85): it opens to 85 mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from quest.sim.props import Occluder, Shape
from quest.sim.pull import Boxes, Puller, Task, Tool, plan_pull
from quest.sim.surfaces import Surface, sample_colour, sample_handle_surface

OPENING_M = 0.085
PAD_HALF_M = (0.010, 0.003, 0.012)
REACH_M = 0.044
"""From the middle of the pads back to the palm."""
LENGTH_M = 0.245
"""From the middle of the pads to the end of the wrist."""
_FULL_SIZE_M = 0.3
"""Objects with at least this half diagonal meet a gripper of full size, smaller ones a smaller one."""
_SMALLEST = 0.2
_ALONG_Z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).T

Material = Literal["shell", "metal", "rubber"]


@dataclass(frozen=True)
class GripperPart:
    """A box, or a cylinder along z."""

    kind: Literal["box", "cylinder"]
    material: Material
    half_m: tuple[float, float, float]
    """Half extents along x, y, z."""
    centre_m: tuple[float, float, float]
    """Middle; a finger's with its jaw closed."""
    side: int = 0
    """-1 or 1 if it moves with the finger on that side along y, else 0."""


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


def sample_gripper_surfaces(rng: np.random.Generator) -> dict[Material, Surface]:
    """Draw what a gripper looks like: a shell in white, grey, black or paint, metal fingers, black rubber."""
    kind, grey = rng.choice(3, p=(0.45, 0.3, 0.25)), float(rng.uniform(0.75, 0.95))
    dark = float(rng.uniform(0.08, 0.25))
    colour = ((grey, grey, grey), (dark, dark, dark), sample_colour(rng))[int(kind)]
    shell = Surface(colour, float(rng.uniform(0.35, 0.7)), 0.0, float(rng.uniform(0.2, 0.5)))
    rubber = Surface((0.07, 0.07, 0.075), 0.9, 0.0, 0.15)
    return {"shell": shell, "metal": sample_handle_surface(rng), "rubber": rubber}


@dataclass(frozen=True)
class GripperTool(Tool):
    """A gripper for the search and the ways."""

    def boxes(
        self, world_from_gripper: Float[np.ndarray, "4 4"], width_m: float, opening_m: float, *, shrink_m: float = 0.0
    ) -> Boxes:
        """Its parts, each smaller by ``shrink_m`` on all sides."""
        centre = self.scale * np.array([p.centre_m for p in GRIPPER_PARTS])
        centre[:, 1] += opening_m / 2 * np.array([p.side for p in GRIPPER_PARTS])
        half = self.scale * np.array([p.half_m for p in GRIPPER_PARTS]) - shrink_m
        return np.stack((centre - half, centre + half), axis=1)


def gripper_tool(half_diagonal_m: float) -> GripperTool:
    """The gripper for an object: at scale 1 for furniture, smaller for what is small."""
    return GripperTool(
        noun="gripper",
        scale=float(np.clip(half_diagonal_m / _FULL_SIZE_M, _SMALLEST, 1.0)),
        pad_half_m=PAD_HALF_M,
        span_share=0.0,
        opening_m=OPENING_M,
        length_m=LENGTH_M,
        reaches_m=(0.016, 0.009, 0.003),
        touches=True,
        touch_open_m=0.0,
        turns=tuple(np.pi * np.arange(8) / 8),
        touch_turns=1,
        sides_alike=True,
        exits=((2, 1), (1, 1), (1, -1)),
        exit_back=0.3,
    )


def plan_gripper(task: Task, rng: np.random.Generator) -> Puller:
    """A gripper that pulls one joint after the other; errors are those of :func:`plan_pull`."""
    surfaces, tool = sample_gripper_surfaces(rng), gripper_tool(task.sim_object.half_diagonal_m)
    pull = plan_pull(task, rng, tool.noun, lambda path: [tool])
    parts = []
    for part in GRIPPER_PARTS:
        local = np.tile(np.eye(4), (len(task.script), 1, 1))
        local[:, :3, 3] = tool.scale * np.array(part.centre_m)
        local[:, 1, 3] += part.side * pull.opening_m / 2
        half = tool.scale * np.array(part.half_m)
        if part.kind == "cylinder":  # whose axis is x
            local[:, :3, :3], half = _ALONG_Z, half[[2, 0, 1]]
        shape = Shape(part.kind, half, np.eye(4))
        parts.append(Occluder(shape, surfaces[part.material], pull.world_from_gripper @ local))
    return Puller(tuple(parts), pull.held)
