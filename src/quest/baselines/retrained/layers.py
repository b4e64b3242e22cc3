"""What the networks share: a small convolutional encoder, and reading maps at pixels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn


class Residual(nn.Module):
    """Two convolutions and a short cut."""

    def __init__(self, inner: int, outer: int, *, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inner, outer, 3, stride, 1)
        self.second = nn.Conv2d(outer, outer, 3, 1, 1)
        self.short = nn.Conv2d(inner, outer, 1, stride)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        """Instance norms, as optical flow has them: they keep a picture's own contrast out."""
        y = F.relu(F.instance_norm(self.first(x)))
        return F.relu(self.short(x) + F.instance_norm(self.second(y)))


class ConvEncoder(nn.Module):
    """Features of pictures at a stride of 4 or 8 pixels."""

    def __init__(self, width: int, *, stride: int, channels: int = 3) -> None:
        super().__init__()
        self.stem = nn.Conv2d(channels, 32, 7, 2, 3)
        self.blocks = nn.Sequential(
            Residual(32, 48, stride=2), Residual(48, 96, stride=2) if stride == 8 else Residual(48, 48, stride=1)
        )
        self.out = nn.Conv2d(96 if stride == 8 else 48, width, 1)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        """One map per picture, in float32 whatever the convolutions are computed in."""
        return self.out(self.blocks(F.relu(F.instance_norm(self.stem(x))))).float()


def as_maps(rgb: UInt8[Tensor, "*B H W 3"]) -> Float[Tensor, "*B 3 H W"]:
    """Colours from -1 to 1."""
    return rgb.movedim(-1, -3).float() / 127.5 - 1


def read_at(maps: Float[Tensor, "B C h w"], uv_px: Float[Tensor, "B *N 2"], stride: float) -> Float[Tensor, "B C *N"]:
    """Maps at pixels of the canvas, whose centres are at half-integers; bilinear, beyond the border as at it."""
    size = torch.tensor([maps.shape[-1], maps.shape[-2]], device=maps.device) * stride
    grid = (uv_px / size * 2 - 1).flatten(1, -2)[:, :, None]
    read = F.grid_sample(maps, grid, padding_mode="border", align_corners=False)[..., 0]
    return read.unflatten(-1, uv_px.shape[1:-1])


def square(radius: int, device: torch.device) -> Float[Tensor, "N 2"]:
    """Whole steps to all neighbours within a square."""
    step = torch.arange(-radius, radius + 1, device=device, dtype=torch.float32)
    return mesh(step, step).flatten(0, 1)


def mesh(x: Float[Tensor, " w"], y: Float[Tensor, " h"]) -> Float[Tensor, "h w 2"]:
    """All places (x, y)."""
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def waves(value: Float[Tensor, "*B D"], count: int) -> Float[Tensor, "*B E"]:
    """Values, and sines and cosines of them in octaves."""
    scaled = value.unsqueeze(-1) * torch.pi * 2.0 ** torch.arange(count, device=value.device)
    return torch.cat((value, scaled.sin().flatten(-2), scaled.cos().flatten(-2)), dim=-1)
