"""A second look at each grip, door and drawer, for its edges: what the maps show in and around the first look's box.

A cell of a map answers for a whole box from what it sees around itself; the second look sees every part of the box at
the box's own scale, and asks of every place along each axis how well an edge would fit there.

References: Cai and Vasconcelos, Cascade R-CNN, CVPR 2018, for looking again at boxes; He et al., Mask R-CNN, ICCV 2017,
for features on a grid in a box; Wang et al., Side-Aware Boundary Localization, ECCV 2020, for edges found along axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

GRID = 16
"""Points along each side of what is looked at."""
AROUND = 1.7
"""Size of what is looked at, in boxes ..."""
MARGIN_PX = 6.0
"""... and so many pixels on every side."""
_PLACES = 4 * GRID
"""Places of an edge that are told apart along an axis."""
_WIDTH, _GROUPS, _DROPPED = 64, 8, 0.3
_VIEWS = 4
"""Sums over rows, or columns, that a place along an axis sees; each weighs them as it has learned."""
_NEAR = 0.25
"""Standard deviation of an edge around that of the first look before anything is learned, half sides of what is
looked at."""


class SecondLook(nn.Module):
    """Boxes to better boxes; before anything is learned they stay what they are.

    Args:
        channels: of the features, level by level.
        strides: of the features, pixels.
    """

    def __init__(self, channels: Sequence[int], *, strides: Sequence[int]) -> None:
        super().__init__()
        self.strides = tuple(strides)
        self.narrow = nn.ModuleList(nn.Conv2d(count, _WIDTH, 1) for count in channels)
        self.around = nn.Sequential(
            *(
                nn.Sequential(nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1), nn.GroupNorm(_GROUPS, _WIDTH), nn.ReLU())
                for _ in range(2)
            )
        )
        self.dropout = nn.Dropout2d(_DROPPED)
        self.weigh = nn.Conv2d(_WIDTH, 2 * _VIEWS, 1)
        self.along = nn.Sequential(
            nn.Sequential(nn.Conv1d(_VIEWS * _WIDTH + 2, _WIDTH, 3, padding=1), nn.ReLU()),
            nn.Sequential(nn.Conv1d(_WIDTH, _WIDTH, 3, padding=1), nn.GroupNorm(_GROUPS, _WIDTH), nn.ReLU()),
        )
        self.fit = nn.Conv1d(_WIDTH, 2, 3, padding=1)
        self.near = nn.Parameter(torch.tensor(_NEAR))
        nn.init.zeros_(self.fit.weight)
        nn.init.zeros_(self.fit.bias)  # type: ignore[arg-type]

    def forward(
        self, features: Sequence[Float[Tensor, "B _ _ _"]], box_px: Float[Tensor, "N 4"], picture: Int[Tensor, " N"]
    ) -> Float[Tensor, "N 4"]:
        """Left, top, right and bottom edges after a second look.

        Args:
            features: of the pictures, level by level.
            box_px: of the first look, pixels of the pictures.
            picture: the picture that each is in, as an index.
        """
        centre, half = (box_px[:, :2] + box_px[:, 2:]) / 2, (box_px[:, 2:] - box_px[:, :2]) / 2
        reach = AROUND * half + MARGIN_PX
        levels = zip(self.narrow, features, self.strides, strict=True)
        told = [narrow(_grid(own, stride, centre, reach, picture)) for narrow, own, stride in levels]
        seen = self.dropout(self.around(F.relu(torch.stack(told).sum(dim=0))))
        across, down = self.weigh(seen).chunk(2, dim=1)
        edge, size = half / reach, (2 * half).clamp(min=1).log() / 4 - 1
        moves = (
            self._moves(seen, across, edge[:, 0], size[:, 0]),
            self._moves(seen.mT, down.mT, edge[:, 1], size[:, 1]),
        )
        return box_px + (torch.stack(moves, dim=-1) * reach[:, None]).flatten(1)

    def _moves(
        self,
        seen: Float[Tensor, "N C G G"],
        weight: Float[Tensor, "N V G G"],
        edge: Float[Tensor, " N"],
        size: Float[Tensor, " N"],
    ) -> Float[Tensor, "N 2"]:
        """By how much the lower and the upper edge along the last axis move, half sides of what is looked at.

        Args:
            seen: what is looked at.
            weight: logits of the places across the axis, for each of the sums over these.
            edge: where the first look has the upper edge; the lower one is at minus that.
            size: of the box along the axis, as a logarithm.
        """
        sums = torch.einsum("nvyx,ncyx->nvcx", weight.softmax(dim=-2), seen).flatten(1, 2)
        told = torch.stack((edge, size), dim=1)[..., None].expand(-1, -1, GRID)
        fit = F.interpolate(
            self.fit(self.along(torch.cat((sums, told), dim=1))), _PLACES, mode="linear", align_corners=False
        )
        place = (2 * torch.arange(_PLACES, device=edge.device) + 1) / _PLACES - 1
        first = torch.stack((-edge, edge), dim=1)[..., None]
        before = -(((place - first) / self.near) ** 2) / 2
        return (((before + fit).softmax(dim=-1) - before.softmax(dim=-1)) * place).sum(dim=-1)


class SecondLooks(nn.Module):
    """One for grips and one for doors and drawers: an edge of a thin bar does not look like one of a door.

    Args:
        channels: of the features, level by level.
        strides: of the features, pixels.
    """

    def __init__(self, channels: Sequence[int], *, strides: Sequence[int]) -> None:
        super().__init__()
        self.grip, self.panel = (SecondLook(channels, strides=strides) for _ in range(2))


def _grid(
    features: Float[Tensor, "B C h w"],
    stride: int,
    centre: Float[Tensor, "N 2"],
    reach: Float[Tensor, "N 2"],
    picture: Int[Tensor, " N"],
) -> Float[Tensor, "N C G G"]:
    """Features of a level on a grid over what is looked at."""
    size = stride * torch.tensor(features.shape[:1:-1], device=features.device)
    step = (2 * torch.arange(GRID, device=features.device) + 1) / GRID - 1
    grid = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1)
    at = 2 * (centre[:, None, None] + reach[:, None, None] * grid) / size - 1
    out = features.new_empty(len(at), features.shape[1], GRID, GRID, dtype=torch.float32)
    for b in picture.unique():
        own = picture == b
        rows = F.grid_sample(features[b][None].float(), at[own].flatten(0, 1)[None], "bilinear", "border", False)
        out[own] = rows[0].unflatten(1, (-1, GRID)).transpose(0, 1)
    return out
