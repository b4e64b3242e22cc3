"""Networks and frames small enough for every test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import torch

from quest.model.config import DecoderConfig, NetworkConfig
from quest.model.encoder import EncoderConfig
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, cell_depth, reference_of

DEFAULT = NetworkConfig(
    encoder=EncoderConfig(image_size=64, patch_size=16, width=32, depth=1, heads=2),
    width=32,
    heads=2,
    decoder_layers=1,
    token_layers=1,
    slots=6,
    intents=True,
    map_layers=1,
)
"""The preset ``default``, tiny."""

Network = TypeVar("Network", bound=torch.nn.Module)


def make_network(config: NetworkConfig = DEFAULT, *, seed: int = 0, **changes: Any) -> QuestNetwork:
    """A network in evaluation mode with random weights, none of which is trivial."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = QuestNetwork(replace(config, **changes))
    return shaken(network, seed=seed)


def shaken(network: Network, *, seed: int = 0) -> Network:
    """The network in evaluation mode with some noise on every weight, so that none is trivial."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            scale = 0.5 * parameter.shape[-1] ** -0.5 if parameter.ndim > 1 else 0.1
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return network.eval()


def make_frames(
    config: DecoderConfig = DEFAULT, *, batch: int = 2, frames: int = 4, seed: int = 0, depth: bool = True
) -> FrameBatch:
    """Random frames of a camera that moves a little; a fifth of the depth is missing, or all."""
    generator = torch.Generator().manual_seed(seed)
    size, grid = config.encoder.image_size, config.encoder.grid
    depth_m = 1 + torch.rand(batch, frames, size, size, generator=generator)
    missing = torch.rand(depth_m.shape, generator=generator) < (0.2 if depth else 2.0)
    depth_m = depth_m.masked_fill(missing, 0.0)
    cells = cell_depth(depth_m.flatten(0, 1), config.cell_px).unflatten(0, (batch, frames))
    intrinsics = torch.tensor([[80.0, 80.0, size / 2, size / 2]]).repeat(batch, 1)
    center, scale = reference_of(cells[:, 0], intrinsics, size)
    pose = torch.eye(4).repeat(batch, frames, 1, 1)
    pose[:, 1:, :3, 3] = 0.05 * torch.randn(batch, frames - 1, 3, generator=generator)
    return FrameBatch(
        features=torch.randn(batch, frames, grid**2, config.encoder.width, generator=generator),
        rgb=torch.randint(0, 256, (batch, frames, size, size, 3), generator=generator, dtype=torch.uint8),
        depth_m=depth_m,
        cell_depth_m=cells,
        intrinsics=intrinsics,
        ref_from_cam=pose,
        center=center,
        scale=scale,
    )
