"""How far each pixel stands out of its surroundings.

A handle in the colours of its front is told from it by a few centimetres, which are little beside the metres to it.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_GAIN = 20.0


def relief(depth_m: Float[Tensor, "*B H W"], radii_px: tuple[int, ...]) -> Float[Tensor, "*B R H W"]:
    """How far each pixel stands in front of the surface around it, squashed to (-1, 1); 0 where depth is missing.

    Over a plane inverse depth is linear in the image, so its mean over a square is the value in the middle: planes have
    no relief however they are turned. What stands out by 5 cm counts about 0.76.

    Args:
        depth_m: metres along +z, 0 where missing.
        radii_px: of the squares that surfaces are judged by: their sides are two radii and one pixel.
    """
    valid = depth_m > 0
    near = torch.where(valid, depth_m, 1.0).reciprocal() * valid
    both = torch.stack((near, valid.to(near.dtype)), dim=-3)
    planes = []
    for radius in radii_px:
        total, count = _box_sum(both, radius).unbind(-3)
        around_m = count / total.clamp(min=1e-9)
        planes.append(torch.where(valid, around_m - depth_m, 0.0))
    return (_GAIN * torch.stack(planes, dim=-3)).tanh()


def _box_sum(value: Float[Tensor, "*B H W"], radius: int) -> Float[Tensor, "*B H W"]:
    """Sums over squares of 2 radius + 1 pixels; outside the image there is nothing."""
    side = 2 * radius + 1
    rows = F.pad(value, (radius + 1, radius)).cumsum(-1)
    value = rows[..., side:] - rows[..., :-side]
    columns = F.pad(value, (0, 0, radius + 1, radius)).cumsum(-2)
    return columns[..., side:, :] - columns[..., :-side, :]
