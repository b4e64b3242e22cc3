"""Which peaks of the affordance map are one long handle: a ridge in the map, a bar in depth.

The middle of a bar as long as its door looks like every other place on it, so its score has several tops. Two tops are
one thing if the score hardly falls between them (the prominence of topographers), if they point to places nearer to
each other than they are, and if what stands out of its surroundings at both does so without a gap in between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from quest.model.config import NetworkConfig
from quest.model.observation import cell_centres
from quest.model.relief import relief

ALIKE = 2.0
"""Cells of one thing have logits at most so much below its best one's."""
_LEAST_RELIEF = 0.05
"""What stands out less, as :func:`quest.model.relief.relief` tells, is no bar."""
_SAME_RELIEF = 0.5
"""Share of the relief at the lower end that a bar has all along."""
_NEAR_PX = 4
"""A bar lies at most so far from the middles of its cells."""


@dataclass
class Ridge:
    """Cells around one or more tops of the map that are one thing.

    Attributes:
        tops: cells whose score is the best around, the best first.
        cells: all its cells.
    """

    tops: list[int]
    cells: list[int]


def find_ridges(
    score: Float[Tensor, "S S"],
    pointed_px: Float[Tensor, "C 2"],
    floor: float,
    *,
    prominence: float,
    depth_m: Float[Tensor, "H W"],
    scale: Float[Tensor, ""],
    config: NetworkConfig,
) -> list[Ridge]:
    """Cells above a floor, by the thing that they are on; without depth every top is a thing of its own.

    Args:
        score: logits of one label and purpose.
        pointed_px: where its cells point to, pixels of the network's input.
        floor: least logit of a top that matters.
        prominence: tops between which the logit falls by this or more below the lower one are two things.
        depth_m: depth along +z of the network's input, 0 where missing.
        scale: metres per unit of the reference frame.
        config: of the network.
    """
    side = score.shape[0]
    flat = score.flatten().tolist()
    stands_out = relief(depth_m, scale)[0].cpu().numpy()
    centres = cell_centres(config, device=score.device)
    ridge_of: dict[int, Ridge] = {}
    for cell in sorted((c for c in range(side * side) if flat[c] > floor - ALIKE), key=lambda c: -flat[c]):
        beside = {id(ridge_of[c]): ridge_of[c] for c in _neighbours(cell, side) if c in ridge_of}
        if not beside:
            ridge_of[cell] = Ridge([cell], [cell])
            continue
        best, *others = sorted(beside.values(), key=lambda ridge: -flat[ridge.tops[0]])
        best.cells.append(cell)
        ridge_of[cell] = best
        for other in others:
            tops = [best.tops[0], other.tops[0]]
            between, aims = centres[tops].diff(dim=0).norm(), pointed_px[tops].diff(dim=0).norm()
            falls = flat[tops[1]] - flat[cell]
            if falls < prominence and aims < between and _is_bar(stands_out, centres[tops]):
                best.tops += other.tops
                best.cells += other.cells
                ridge_of |= dict.fromkeys(other.cells, best)
    return list({id(ridge): ridge for ridge in ridge_of.values()}.values())


def _neighbours(cell: int, side: int) -> list[int]:
    row, column = divmod(cell, side)
    return [
        r * side + c
        for r in range(max(row - 1, 0), min(row + 2, side))
        for c in range(max(column - 1, 0), min(column + 2, side))
    ]


def _is_bar(stands_out: Float[np.ndarray, "H W"], ends: Float[Tensor, "2 2"]) -> bool:
    """Whether what stands out near two pixels (x, y) does so, without a gap, all the way from one to the other."""
    low = (ends.amin(dim=0) - _NEAR_PX).clamp(min=0).long().tolist()
    high = (ends.amax(dim=0) + _NEAR_PX + 1).long().tolist()
    part = stands_out[low[1] : high[1], low[0] : high[0]]
    around = []
    for x, y in (ends.long() - torch.tensor(low, device=ends.device)).tolist():
        around.append((slice(max(y - _NEAR_PX, 0), y + _NEAR_PX + 1), slice(max(x - _NEAR_PX, 0), x + _NEAR_PX + 1)))
    least = min(float(part[near].max()) for near in around)
    if least < _LEAST_RELIEF:
        return False
    pieces = np.zeros(part.shape, np.int32)
    ndimage.label(part > _SAME_RELIEF * least, structure=np.ones((3, 3)), output=pieces)
    first, second = (set(np.unique(pieces[near]).tolist()) - {0} for near in around)
    return bool(first & second)
