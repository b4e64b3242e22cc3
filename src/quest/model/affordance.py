"""The dense affordance map: per cell a score for every label and what one would take hold of it for, and offsets.

References: Law and Deng, CornerNet, ECCV 2018, for the map and its loss; Zhou et al., Objects as Points, 2019,
section 3, for offsets at peaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.config import NetworkConfig
from quest.model.layers import TokenLayer
from quest.model.observation import FrameBatch, Observer
from quest.types import INTENTS, LABELS


@dataclass(frozen=True)
class AffordanceMap:
    """What could be taken hold of, per cell.

    The rims of a closed laptop, one to open and one to lift, may lie in one cell: each purpose has scores and offsets
    of its own. A network that knows no intents has one purpose.
    """

    logits: Float[Tensor, "B T C L P"]
    """Score of every label and purpose (index into INTENTS)."""
    offset: Float[Tensor, "B T C P 2"]
    """From the cell's centre to the entity, in cells."""

    def mirrored(self) -> AffordanceMap:
        """The map of the mirror image."""
        return AffordanceMap(_flip(self.logits), _flip(self.offset) * self.offset.new_tensor([-1.0, 1.0]))

    def mean(self, other: AffordanceMap) -> AffordanceMap:
        """What two looks at the same frames agree on."""
        return AffordanceMap((self.logits + other.logits) / 2, (self.offset + other.offset) / 2)


def _flip(cells: Float[Tensor, "B T C *D"]) -> Float[Tensor, "B T C *D"]:
    """Cells of the mirror image."""
    side = math.isqrt(cells.shape[2])
    return cells.unflatten(2, (side, side)).flip(3).flatten(2, 3)


class AffordanceHead(nn.Module):
    """Reads the map off the cells that queries are matched with."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        f = Observer.fine_width
        self.purposes = len(INTENTS) if config.intents else 1
        self.mlp = nn.Sequential(nn.Linear(f, 2 * f), nn.GELU(), nn.Linear(2 * f, (len(LABELS) + 2) * self.purposes))
        final = self.mlp[-1]
        assert isinstance(final, nn.Linear)
        nn.init.constant_(final.bias[: len(LABELS) * self.purposes], -4.0)

    def forward(self, fine: Float[Tensor, "B T C F"]) -> AffordanceMap:
        """The map of every frame."""
        logits, offset = self.mlp(fine).float().split([len(LABELS) * self.purposes, 2 * self.purposes], dim=-1)
        return AffordanceMap(logits.unflatten(-1, (-1, self.purposes)), offset.unflatten(-1, (-1, 2)))


class AffordanceTrunk(nn.Module):
    """Observes frames for the map alone, with the image's tokens at twice its size.

    What a query needs to be told from its neighbours and what makes a handle a handle are different things; with a
    trunk of its own the map learns at its own pace, and a handle of a few pixels fills a token. It runs only while
    something is to be discovered.
    """

    width = 192
    _dropout = 0.1

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.observer = Observer(config)
        f, self.cells = Observer.fine_width, config.cells
        self.enlarged = nn.Sequential(
            nn.LayerNorm(config.encoder.width), nn.Dropout(self._dropout), nn.Linear(config.encoder.width, self.width)
        )
        self.fine = nn.Linear(f, self.width)
        self.layers = nn.ModuleList(TokenLayer(self.width, self.width // 32) for _ in range(config.map_layers))
        self.out = nn.Linear(self.width, f)
        self.dropout = nn.Dropout(self._dropout)
        self.mix = nn.ModuleList(nn.Conv2d(f, f, 3, padding=1) for _ in range(2))
        self.norm = nn.ModuleList(nn.GroupNorm(8, f) for _ in range(2))

    def forward(self, frames: FrameBatch, enlarged: Float[Tensor, "B T C E"]) -> Float[Tensor, "B T C F"]:
        """Cells of every frame.

        Args:
            frames: the frames.
            enlarged: tokens of their images at twice the size.
        """
        fine = self.observer(frames).fine.flatten(0, 1)
        tokens = self.enlarged(enlarged.flatten(0, 1)) + self.fine(fine)
        for layer in self.layers:
            tokens = layer(tokens)
        h = self.dropout(fine + self.out(tokens)).transpose(1, 2).unflatten(2, (self.cells, self.cells))
        for mix, norm in zip(self.mix, self.norm, strict=True):
            h = h + F.gelu(norm(mix(F.gelu(h))))
        return h.flatten(2).transpose(1, 2).unflatten(0, enlarged.shape[:2])
