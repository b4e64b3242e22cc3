"""A second look around the best cell, at twice the resolution, beside what surrounded the query when it was bound.

Reference: Cho et al., Local All-Pair Correspondence for Point Tracking, ECCV 2024 (section 3.2), for comparing two
neighbourhoods with each other instead of one feature with a neighbourhood.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from quest.model.config import NetworkConfig
from quest.model.observation import Observation, Observer, gather_cells

_SIDE = 9
_TEMPLATE_SIDE = 7
_WIDTH = 64


class SecondLook(nn.Module):
    """Position to a fraction of a cell, from a square of close cells (half as wide as the cells of the heatmap).

    Every close cell is described by its own detail, its cell of the heatmap, its place relative to the centre and its
    similarity to every close cell around the anchor; a small convolutional network then scores each and moves it.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.describe = nn.Linear(Observer.close_width + Observer.fine_width, _WIDTH)
        self.compare = nn.Linear(_TEMPLATE_SIDE**2, _WIDTH)
        self.place = nn.Linear(4, _WIDTH)
        self.ask = nn.Linear(config.width, _WIDTH)
        self.position = nn.Parameter(0.02 * torch.randn(_SIDE**2, _WIDTH))
        self.mix = nn.ModuleList(nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1) for _ in range(2))
        self.norm = nn.ModuleList(nn.GroupNorm(8, _WIDTH) for _ in range(2))
        self.out = nn.Linear(_WIDTH, 6)

    def template(self, observed: Observation, uv: Float[Tensor, "B K 2"]) -> Float[Tensor, "B K M F"]:
        """Descriptions of the close cells around where queries are bound, of unit length.

        Args:
            observed: the frame of binding (T = 1).
            uv: where, in [0, 1]^2 of the input.
        """
        cell = self._close_cell(uv.unsqueeze(1))
        index, _ = _square(cell, self._side, _TEMPLATE_SIDE)
        return F.normalize(self._describe(observed, index).squeeze(1).float(), dim=-1)

    def forward(
        self,
        x: Float[Tensor, "B T K D"],
        template: Float[Tensor, "B K M F"],
        valid: Bool[Tensor, "B K"],
        observed: Observation,
        uv: Float[Tensor, "B T K 2"],
    ) -> tuple[Float[Tensor, "B T K 2"], Float[Tensor, "B T K 3"]]:
        """Coordinates in [0, 1]^2 and the point in the reference frame, NaN where no cell around has depth.

        Args:
            x: the queries after the decoder.
            template: from :meth:`template`.
            valid: False for padding, whose answers are the input.
            observed: the frames.
            uv: where to look, in [0, 1]^2 of the input.
        """
        cell = self._close_cell(uv)
        index, inside = _square(cell, self._side, _SIDE)
        description = self._describe(observed, index)
        point = gather_cells(observed.close_point, index)
        # Padding is not worth the convolutions.
        asked = valid[:, None].expand(uv.shape[:3])
        row = torch.nonzero(asked, as_tuple=True)
        description, point, inside = description[row], point[row], inside[row]
        lifted = torch.isfinite(point).all(-1)
        middle = _median_point(point, lifted)
        relative = torch.where(lifted.unsqueeze(-1), point - middle.unsqueeze(1), 0.0).clamp(-1, 1)
        similar = F.normalize(description.float(), dim=-1) @ template[row[0], row[2]].transpose(-1, -2)
        h = description + self.compare(8 * similar) + self.ask(x[row]).unsqueeze(1) + self.position
        h = h + self.place(torch.cat((8 * relative, lifted.unsqueeze(-1).to(relative.dtype)), dim=-1))
        h = h.transpose(1, 2).unflatten(2, (_SIDE, _SIDE))
        for mix, norm in zip(self.mix, self.norm, strict=True):
            h = h + F.gelu(norm(mix(F.gelu(h))))
        out = self.out(h.flatten(2).transpose(1, 2)).float()
        weight = torch.where(inside, out[..., 0], -torch.inf).softmax(-1).unsqueeze(-1)
        centre = self._centre(index[row])
        fine_uv = (weight * (centre + self._close_px * out[..., 1:3])).sum(1) / self.config.encoder.image_size
        with_depth = weight * lifted.unsqueeze(-1)
        total = with_depth.sum(1)
        moved = torch.where(lifted.unsqueeze(-1), point, 0.0) + 0.1 * out[..., 3:]
        mean = (with_depth * moved).sum(1) / total.clamp(min=1e-6)
        fine_point = torch.where(total > 1e-4, mean, torch.nan)
        nowhere = torch.full((*uv.shape[:3], 3), torch.nan, device=uv.device)
        return uv.float().index_put(row, fine_uv), nowhere.index_put(row, fine_point)

    @property
    def _side(self) -> int:
        return 2 * self.config.cells

    @property
    def _close_px(self) -> float:
        return self.config.cell_px / 2

    def _close_cell(self, uv: Float[Tensor, "B T K 2"]) -> Int[Tensor, "B T K 2"]:
        return (uv * self._side).long().clamp(0, self._side - 1)

    def _centre(self, index: Int[Tensor, "R M"]) -> Float[Tensor, "R M 2"]:
        column, row = index % self._side, index.div(self._side, rounding_mode="floor")
        return (torch.stack((column, row), dim=-1) + 0.5) * self._close_px

    def _describe(self, observed: Observation, index: Int[Tensor, "B T K M"]) -> Float[Tensor, "B T K M F"]:
        column, row = index % self._side, index.div(self._side, rounding_mode="floor")
        parent = row.div(2, rounding_mode="floor") * self.config.cells + column.div(2, rounding_mode="floor")
        # The linear map before the gathering: there are fewer cells than gathered ones.
        close_w, fine_w = self.describe.weight.split((Observer.close_width, Observer.fine_width), dim=1)
        close = F.linear(observed.close, close_w, self.describe.bias)
        fine = F.linear(observed.fine, fine_w)
        return gather_cells(close, index) + gather_cells(fine, parent)


def _square(
    cell: Int[Tensor, "B T K 2"], grid: int, side: int
) -> tuple[Int[Tensor, "B T K M"], Bool[Tensor, "B T K M"]]:
    """Indices of a square of cells around each, row by row, and which of them lie in the grid."""
    step = torch.arange(side, device=cell.device) - side // 2
    column, row = cell[..., :1, None] + step, cell[..., 1:, None] + step[:, None]
    inside = (column >= 0) & (column < grid) & (row >= 0) & (row < grid)
    index = row.clamp(0, grid - 1) * grid + column.clamp(0, grid - 1)
    return index.flatten(-2), inside.flatten(-2)


def _median_point(point: Float[Tensor, "R M 3"], lifted: Bool[Tensor, "R M"]) -> Float[Tensor, "R 3"]:
    """Median of the lifted points, per coordinate; 0 where there is none."""
    masked = torch.where(lifted.unsqueeze(-1), point, torch.nan)
    return masked.nanmedian(dim=1).values.nan_to_num()
