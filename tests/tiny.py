"""Networks and frames small enough for every test."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import nn

from quest.model.encoder import EncoderConfig
from quest.model.finder import FinderConfig, FinderNetwork
from quest.model.frames import FrameBatch, reference_of

ENCODER = EncoderConfig(image_size=64, patch_size=16, width=32, depth=1, heads=2)
"""Of the published network."""

FINDER = FinderConfig(encoder=EncoderConfig(image_size=64, patch_size=16, width=24, depth=12, heads=2), width=16)
"""The finder; EfficientNet comes in one size."""

Network = TypeVar("Network", bound=nn.Module)


def make_finder(config: FinderConfig = FINDER, *, seed: int = 0) -> FinderNetwork:
    """A finder in evaluation mode with random weights that finds anything anywhere."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = FinderNetwork(config).eval()
        for module in network.detail.modules():
            if isinstance(module, nn.Conv2d):  # torch's own initial weights let all signals die away
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        for head in (network.fine, network.coarse):
            nn.init.zeros_(head.score.bias)  # type: ignore[arg-type]
    return network.eval()


def shaken(network: Network, *, seed: int = 0) -> Network:
    """The network in evaluation mode with some noise on every weight, so that none is trivial."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            scale = 0.5 * parameter.shape[-1] ** -0.5 if parameter.ndim > 1 else 0.1
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return network.eval()


def make_frames(
    encoder: EncoderConfig = ENCODER, *, batch: int = 2, frames: int = 4, seed: int = 0, depth: bool = True
) -> FrameBatch:
    """Random frames of a camera that moves a little; a fifth of the depth is missing, or all."""
    generator = torch.Generator().manual_seed(seed)
    size, grid = encoder.image_size, encoder.grid
    depth_m = 1 + torch.rand(batch, frames, size, size, generator=generator)
    missing = torch.rand(depth_m.shape, generator=generator) < (0.2 if depth else 2.0)
    depth_m = depth_m.masked_fill(missing, 0.0)
    intrinsics = torch.tensor([[80.0, 80.0, size / 2, size / 2]]).repeat(batch, 1)
    center, scale = reference_of(depth_m[:, 0], intrinsics, cell_px=8)
    pose = torch.eye(4).repeat(batch, frames, 1, 1)
    pose[:, 1:, :3, 3] = 0.05 * torch.randn(batch, frames - 1, 3, generator=generator)
    return FrameBatch(
        features=torch.randn(batch, frames, grid**2, encoder.width, generator=generator),
        depth_m=depth_m,
        intrinsics=intrinsics,
        ref_from_cam=pose,
        center=center,
        scale=scale,
    )
