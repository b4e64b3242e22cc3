"""Dense features of grey pictures: a small convolutional network that runs on a processor.

Reference: Potje, Cadar, Araujo, Martins and Nascimento, XFeat: Accelerated Features for Lightweight Image Matching,
CVPR 2024. Of the published network this is the descriptor branch and the reliability map; the branch of keypoints and
the fine matcher are left out, and batch normalisation is folded into the convolutions. ``benchmarks/import_xfeat.py``
makes the file of weights.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from quest.errors import InputError
from quest.model.encoder import load_exactly
from quest.model.tensor_file import read_tensors

PACKAGED = Path(str(resources.files("quest") / "assets" / "xfeat.safetensors"))
"""File of the published weights."""
LEAST_PX = 16
"""Shortest side of a picture, pixels."""
_MULTIPLE = 32
"""Sides of the pictures that the network reads are multiples of this, in pixels."""


class XFeat(nn.Module):
    """Descriptors and reliability at an eighth of the resolution.

    Shapes: H, W of the source; h = H // 32 * 4, w = W // 32 * 4, so that a cell covers 8 pixels or more.
    """

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(_layer(1, 4), _layer(4, 8, stride=2), _layer(8, 8), _layer(8, 24, stride=2))
        self.block2 = nn.Sequential(_layer(24, 24), _layer(24, 24))
        self.block3 = nn.Sequential(_layer(24, 64, stride=2), _layer(64, 64), _layer(64, 64, kernel=1))
        self.block4 = nn.Sequential(_layer(64, 64, stride=2), _layer(64, 64), _layer(64, 64))
        self.block5 = nn.Sequential(
            _layer(64, 128, stride=2), _layer(128, 128), _layer(128, 128), _layer(128, 64, kernel=1)
        )
        self.block_fusion = nn.Sequential(_layer(64, 64), _layer(64, 64), nn.Conv2d(64, 64, 1))
        self.heatmap_head = nn.Sequential(_layer(64, 64, kernel=1), _layer(64, 64, kernel=1), nn.Conv2d(64, 1, 1))

    @classmethod
    def from_package(cls) -> XFeat:
        """The published network, from the packaged file: on the CPU, in evaluation mode, without gradients.

        Raises:
            WeightsError: the file is missing or torn.
        """
        _, tensors = read_tensors(PACKAGED)
        network = cls()
        load_exactly(network, tensors, what=f"weights {PACKAGED}")
        # On a processor, channels last take a seventh less time; bfloat16 takes ten times as long where it is emulated.
        network = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue] (documented)
        return network.eval().requires_grad_(False)

    def forward(self, image: Float[Tensor, "B 1 H W"]) -> tuple[Float[Tensor, "B 64 h w"], Float[Tensor, "B 1 h w"]]:
        """Descriptors of length 1, and the probability that a cell can be matched.

        Args:
            image: grey values from 0 to 1; sides are multiples of 32 pixels.
        """
        image = F.instance_norm(image)
        quarter = self.block2(self.block1(image) + self.skip1(image))
        eighth = self.block3(quarter)
        sixteenth = self.block4(eighth)
        coarse = (sixteenth, self.block5(sixteenth))
        pyramid = [F.interpolate(level, size=eighth.shape[-2:], mode="bilinear") for level in coarse]
        fused = self.block_fusion(eighth + pyramid[0] + pyramid[1])
        return F.normalize(fused, dim=1), self.heatmap_head(fused).sigmoid()

    def features(self, grey: UInt8[Tensor, "H W"]) -> tuple[Float[Tensor, "64 h w"], Float[Tensor, "h w"]]:
        """Descriptors and reliability of a picture.

        The picture is resized, bilinearly, so that its sides are the next smaller multiples of 32 pixels, at least 32.
        Its corners stay corners: the source's pixel (x, y) lies at (x * w / W, y * h / H) of the maps. Centres of
        pixels and of cells are at half-integers. :func:`sample` reads descriptors there.

        Args:
            grey: mean of red, green and blue, at the source's resolution, on the network's device.

        Returns:
            Descriptors of length 1, and the probability, from 0 to 1, that a cell can be matched.

        Raises:
            InputError: a side is shorter than 16 pixels, or these are no grey values of 8 bits.
        """
        if grey.dtype != torch.uint8 or grey.ndim != 2 or min(grey.shape) < LEAST_PX:
            raise InputError(
                f"picture for XFeat: expected uint8 [H, W] with sides of at least {LEAST_PX} pixels, got {grey.dtype} "
                f"{list(grey.shape)}; enlarge small pictures, and average colours"
            )
        size = [max(side // _MULTIPLE, 1) * _MULTIPLE for side in grey.shape]
        image = F.interpolate(grey[None, None].float() / 255, size=size, mode="bilinear")
        descriptors, reliability = self(image)
        return descriptors[0], reliability[0, 0]


def sample(
    features: Float[Tensor, "D h w"], uv_px: Float[Tensor, "N 2"], size: tuple[int, int]
) -> Float[Tensor, "N D"]:
    """Descriptors at points of the source, bilinear between cells and of length 1.

    Args:
        features: of :meth:`XFeat.features`.
        uv_px: points (x, y) in pixels of the source; pixel centres at half-integers, the picture spans [0, W] x
            [0, H]. Points outside get the descriptor of the nearest cell at the border.
        size: width and height (W, H) of the source in pixels.
    """
    place = 2 * uv_px / uv_px.new_tensor(size) - 1
    grid = place.to(features.dtype)[None, None]
    sampled = F.grid_sample(features[None], grid, mode="bilinear", padding_mode="border", align_corners=False)
    return F.normalize(sampled[0, :, 0].T, dim=1)


def _layer(inner: int, outer: int, *, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inner, outer, kernel, stride, padding=kernel // 2), nn.ReLU(inplace=True))
