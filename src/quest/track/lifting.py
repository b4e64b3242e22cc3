"""The 3D point of a pixel, where depth falls off a thin part onto what is behind it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from quest.model.decoder import Prediction
from quest.model.observation import FrameBatch


def lift_near(prediction: Prediction, frames: FrameBatch, tolerance: float) -> Float[Tensor, "K 3"]:
    """The lifted pixels where they agree with the predicted points, else the predicted points.

    At a depth edge the pixel may lie on what is before or behind the entity; of the pixels around it the one
    nearest to the predicted depth is taken.

    Args:
        prediction: answers for one frame (B = T = 1).
        frames: that frame.
        tolerance: largest distance between both, reference units.
    """
    size, predicted = frames.depth_m.shape[-1], prediction.point[0, 0].float()
    uv_px = prediction.uv * size
    step = torch.arange(-2.0, 3.0, device=uv_px.device)
    around = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).reshape(1, 1, 1, 25, 2)
    k = uv_px.shape[2]
    pixels = (uv_px.unsqueeze(-2) + around).reshape(1, 1, k * 25, 2)
    depth = frames.depth_at(pixels)
    # Depth is taken from a neighbour, the ray from the pixel itself.
    rays = uv_px.unsqueeze(-2).expand(1, 1, k, 25, 2).reshape(1, 1, k * 25, 2)
    lifted = frames.to_reference(rays, depth).reshape(k, 25, 3)
    gap = (lifted - predicted[:, None]).norm(dim=-1).nan_to_num(torch.inf)
    best = gap.argmin(dim=-1)
    chosen = lifted[torch.arange(k), best]
    agrees = gap[torch.arange(k), best] < tolerance
    return torch.where(agrees.unsqueeze(-1), chosen, predicted)
