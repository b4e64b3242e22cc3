"""EfficientNet-Lite0: what a picture shows at strides of 4 to 32 pixels.

Reference: Tan and Le, EfficientNet, ICML 2019; the lite variant has no squeeze-and-excitation and clips at 6.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

# Expansion, channels, kernel, stride and blocks of each stage.
_STAGES = ((1, 16, 3, 1, 1), (6, 24, 3, 2, 2), (6, 40, 5, 2, 2), (6, 80, 3, 2, 3), (6, 112, 5, 1, 3), (6, 192, 5, 2, 4),
           (6, 320, 3, 1, 1))  # fmt: skip
_STEM = 32
STRIDES = (4, 8, 16, 32)
WIDTHS = (24, 40, 112, 320)
"""Channels at each stride."""
_LAST_STAGES = (1, 2, 4, 6)
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


def _conv(inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups)


class _Block(nn.Module):
    """Expand, filter each channel, project; added to its input where the shapes agree."""

    def __init__(self, inputs: int, outputs: int, *, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        inner = inputs * expansion
        expand = [_conv(inputs, inner), nn.ReLU6(inplace=True)] if expansion > 1 else []
        filtered = [_conv(inner, inner, kernel, stride, groups=inner), nn.ReLU6(inplace=True)]
        self.layers = nn.Sequential(*expand, *filtered, _conv(inner, outputs))
        self.adds = inputs == outputs and stride == 1

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        y = self.layers(x)
        return x + y if self.adds else y


class EfficientNet(nn.Module):
    """Pictures to maps of features; the statistics of batches of ImageNet are part of the convolutions."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(_conv(3, _STEM, 3, 2), nn.ReLU6(inplace=True))
        stages, inputs = [], _STEM
        for expansion, outputs, kernel, stride, blocks in _STAGES:
            stage = []
            for i in range(blocks):
                first = stride if i == 0 else 1
                stage.append(_Block(inputs, outputs, expansion=expansion, kernel=kernel, stride=first))
                inputs = outputs
            stages.append(nn.Sequential(*stage))
        self.stages = nn.ModuleList(stages)
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, rgb: Float[Tensor, "B 3 H W"]) -> list[Float[Tensor, "B _ _ _"]]:
        """Features at each of :data:`STRIDES`.

        Args:
            rgb: colours from 0 to 1; sides are multiples of 32.
        """
        x = self.stem((rgb - self.mean) / self.std)
        maps = []
        for i, stage in enumerate(self.stages):
            x = stage(x)
            if i in _LAST_STAGES:
                maps.append(x)
        return maps
