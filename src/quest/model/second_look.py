"""A second look at each grip, for its edges: what the maps show in and around the box of the first look.

A cell of a map answers for a whole box from what it sees around itself; the second look sees every part of the box at
the box's own scale.

References: Cai and Vasconcelos, Cascade R-CNN, CVPR 2018, for looking again at boxes; He et al., Mask R-CNN, ICCV 2017,
for features on a grid in a box.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

GRID = 9
"""Points along each side of what is looked at."""
AROUND = 1.5
"""Size of what is looked at, in boxes ..."""
MARGIN_PX = 6.0
"""... and so many pixels on every side."""
_WIDTH, _HIDDEN, _GROUPS, _DROPPED = 64, 128, 8, 0.3


class SecondLook(nn.Module):
    """Boxes to better boxes; before anything is learned they stay what they are.

    Args:
        channels: of the features.
        stride: of the features, pixels.
    """

    def __init__(self, channels: int, *, stride: int) -> None:
        super().__init__()
        self.stride = stride
        self.narrow = nn.Conv2d(channels, _WIDTH, 1)
        self.near, self.far = (nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1) for _ in range(2))
        self.near_norm, self.far_norm = (nn.GroupNorm(_GROUPS, _WIDTH) for _ in range(2))
        self.hidden = nn.Linear(_WIDTH * GRID**2 + 2, _HIDDEN)
        self.edges = nn.Linear(_HIDDEN, 4)
        self.dropout = nn.Dropout(_DROPPED)
        nn.init.zeros_(self.edges.weight)
        nn.init.zeros_(self.edges.bias)

    def forward(
        self, features: Float[Tensor, "B C h w"], box_px: Float[Tensor, "N 4"], picture: Int[Tensor, " N"]
    ) -> Float[Tensor, "N 4"]:
        """Left, top, right and bottom edges after a second look.

        Args:
            features: of the pictures.
            box_px: of the first look, pixels of the pictures.
            picture: the picture that each is in, as an index.
        """
        centre, side = (box_px[:, :2] + box_px[:, 2:]) / 2, box_px[:, 2:] - box_px[:, :2]
        reach = AROUND / 2 * side + MARGIN_PX
        seen = F.relu(self.narrow(self._grid(features.float(), centre, reach, picture)))
        for conv, norm in ((self.near, self.near_norm), (self.far, self.far_norm)):
            seen = F.relu(norm(conv(seen)))
        size = side.clamp(min=1).log() / 4 - 1
        hidden = F.relu(self.hidden(torch.cat((self.dropout(seen.flatten(1)), size), dim=1)))
        move = self.edges(self.dropout(hidden))
        return box_px + move * reach.repeat(1, 2)

    def _grid(
        self,
        features: Float[Tensor, "B C h w"],
        centre: Float[Tensor, "N 2"],
        reach: Float[Tensor, "N 2"],
        picture: Int[Tensor, " N"],
    ) -> Float[Tensor, "N C G G"]:
        """Features on a grid over what is looked at."""
        size = self.stride * torch.tensor(features.shape[:1:-1], device=features.device)
        step = torch.linspace(-1, 1, GRID, device=features.device)
        grid = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1)
        at = 2 * (centre[:, None, None] + reach[:, None, None] * grid) / size - 1
        out = features.new_empty(len(at), features.shape[1], GRID, GRID)
        for b in picture.unique():
            own = picture == b
            rows = F.grid_sample(features[b][None], at[own].flatten(0, 1)[None], "bilinear", "border", False)
            out[own] = rows[0].unflatten(1, (-1, GRID)).transpose(0, 1)
        return out
