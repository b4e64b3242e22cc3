"""What the network knows of a window of frames before any query looks at it.

Reference frame: the camera axes of the frame at which a stream began, centred on the scene and divided by
the half width that the image spans at the median depth, so that coordinates are of order one for a pair of glasses
and for a wardrobe. A NaN coordinate means that depth is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from quest.geometry import exact_product, invert, transform
from quest.model.config import NetworkConfig
from quest.model.layers import DetailStem, PointCode, TokenLayer
from quest.model.relief import relief

_EDGE = 0.02
"""Smallest step in depth that is an edge, reference units ..."""
_BENT = 0.5
"""... if the surface bends there by at least this share of it."""


@dataclass(frozen=True)
class FrameBatch:
    """Frames as the network takes them, letterboxed to its input size."""

    features: Float[Tensor, "B T N E"]
    """Tokens of the encoder."""
    rgb: UInt8[Tensor, "B T H W 3"]
    """Colours."""
    depth_m: Float[Tensor, "B T H W"]
    """Depth along +z, 0 where missing."""
    cell_depth_m: Float[Tensor, "B T Hc Wc"]
    """Near depth of each cell (see :func:`cell_depth`), 0 where missing."""
    intrinsics: Float[Tensor, "B 4"]
    """Fx, fy, cx, cy of the letterboxed input, pixels."""
    ref_from_cam: Float[Tensor, "B T 4 4"]
    """Rigid motion from each frame's camera to the reference camera, metres."""
    center: Float[Tensor, "B 3"]
    """Origin of the reference frame in the reference camera, metres."""
    scale: Float[Tensor, " B"]
    """Metres per unit of the reference frame."""
    enlarged: Float[Tensor, "B T C E"] | None = None
    """Tokens of the images at twice their size, one per cell, where they are known already; None where the network is
    to encode them when it looks for entities."""

    def during(self, frames: slice | list[int]) -> FrameBatch:
        """Some of the frames."""
        return replace(
            self,
            features=self.features[:, frames],
            rgb=self.rgb[:, frames],
            depth_m=self.depth_m[:, frames],
            cell_depth_m=self.cell_depth_m[:, frames],
            ref_from_cam=self.ref_from_cam[:, frames],
            enlarged=None if self.enlarged is None else self.enlarged[:, frames],
        )

    def of(self, batch: slice) -> FrameBatch:
        """Some of the batch."""
        return FrameBatch(**{name: value[batch] for name, value in self._tensors().items()})

    def ends(self) -> FrameBatch:
        """The first and the last frame."""
        return self.during([0, -1])

    def to(self, device: torch.device) -> FrameBatch:
        """The same on a device."""
        return FrameBatch(**{name: value.to(device) for name, value in self._tensors().items()})

    def _tensors(self) -> dict[str, Tensor]:
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}

    def to_reference(
        self, uv_px: Float[Tensor, "B T Q 2"], depth_m: Float[Tensor, "B T Q"]
    ) -> Float[Tensor, "B T Q 3"]:
        """Points of the reference frame under pixels of the input; NaN where depth is 0."""
        fx, fy, cx, cy = self.intrinsics[:, None, None].unbind(-1)
        # NaN comes in last: earlier it would turn the gradient of the pixels into NaN, even where nothing asks for it.
        valid = depth_m > 0
        z = torch.where(valid, depth_m, torch.ones_like(depth_m))
        point = torch.stack(((uv_px[..., 0] - cx) / fx * z, (uv_px[..., 1] - cy) / fy * z, z), dim=-1)
        # One matrix per frame times many points: far faster than a product per point.
        point = exact_product(point, self.ref_from_cam[..., :3, :3].mT) + self.ref_from_cam[..., None, :3, 3]
        point = (point - self.center[:, None, None]) / self.scale[:, None, None, None]
        return torch.where(valid.unsqueeze(-1), point, torch.full_like(point, torch.nan))

    def image_points(self) -> Float[Tensor, "B T 3 H W"]:
        """Points of the reference frame under the centres of all pixels; 0 where depth is 0."""
        h, w = self.depth_m.shape[-2:]
        fx, fy, cx, cy = self.intrinsics[:, None, None].unbind(-1)
        x = (torch.arange(w, device=self.depth_m.device) + 0.5 - cx) / fx
        y = (torch.arange(h, device=self.depth_m.device) + 0.5 - cy) / fy
        scale = self.scale[:, None, None]
        right, down, ahead = (self.ref_from_cam[..., :3, :3] / scale[..., None]).unbind(-1)
        # Rays first, which are sums of a row and a column: every pixel is gone through thrice, in place.
        column = (down.unsqueeze(-1) * y.unsqueeze(-2) + ahead.unsqueeze(-1)).unsqueeze(-1)
        point = (right.unsqueeze(-1) * x.unsqueeze(-2)).unsqueeze(-2) + column
        point *= self.depth_m.unsqueeze(2)
        point += ((self.ref_from_cam[..., :3, 3] - self.center[:, None]) / scale)[..., None, None]
        return point.mul_((self.depth_m > 0).unsqueeze(2))

    def to_camera(self, point: Float[Tensor, "B T Q 3"]) -> Float[Tensor, "B T Q 3"]:
        """Points of the reference frame in each frame's camera, metres."""
        metric = point * self.scale[:, None, None, None] + self.center[:, None, None]
        return transform(invert(self.ref_from_cam)[:, :, None], metric)

    def from_reference(self, point: Float[Tensor, "B T Q 3"]) -> Float[Tensor, "B T Q 2"]:
        """Pixels of the input under points of the reference frame; NaN behind the camera."""
        x, y, z = self.to_camera(point).unbind(-1)
        z = torch.where(z > 1e-6, z, torch.full_like(z, torch.nan))
        fx, fy, cx, cy = self.intrinsics[:, None, None].unbind(-1)
        return torch.stack((fx * x / z + cx, fy * y / z + cy), dim=-1)

    def depth_at(self, uv_px: Float[Tensor, "B T Q 2"]) -> Float[Tensor, "B T Q"]:
        """Depth of the pixel that each position falls in; 0 where missing or outside."""
        h, w = self.depth_m.shape[-2:]
        inside = (uv_px >= 0).all(-1) & (uv_px[..., 0] < w) & (uv_px[..., 1] < h)
        x = uv_px[..., 0].nan_to_num().long().clamp(0, w - 1)
        y = uv_px[..., 1].nan_to_num().long().clamp(0, h - 1)
        depth = self.depth_m.flatten(-2).gather(-1, y * w + x)
        return torch.where(inside, depth, torch.zeros_like(depth))

    def near_depth_at(self, uv_px: Float[Tensor, "B T Q 2"]) -> Float[Tensor, "B T Q"]:
        """Smallest depth in the 3 x 3 pixels around each position; 0 where all are missing.

        An entity lies on an outer surface, so of a thin part and what is behind it the near one is meant.
        """
        depth = self._depth_beside(uv_px, _steps_around(uv_px.device))
        near = torch.where(depth > 0, depth, torch.inf).amin(dim=-1)
        return torch.where(torch.isfinite(near), near, torch.zeros_like(near))

    def edge_depth_at(self, uv_px: Float[Tensor, "B T Q 2"]) -> Float[Tensor, "B T Q"]:
        """Depth of the pixel that each position falls in, or of a neighbour that stands free before it; 0 if missing.

        The pixel of a position on a thin part may show what is behind that part. On a slope a neighbour is nearer too,
        but there the one opposite is as much farther.
        """
        around = _steps_around(uv_px.device)
        around = around[around.abs().sum(dim=-1) > 0]
        at, own = uv_px.unsqueeze(-2), self.depth_at(uv_px).unsqueeze(-1)
        near, far = self._depth_beside(uv_px, around), self._depth_beside(uv_px, -around)
        jump, bend = own - near, 2 * own - near - torch.where(far > 0, far, own)
        edge = (jump > _EDGE * self.scale[:, None, None, None]) & (bend > _BENT * jump)
        free = (near > 0) & (edge | (own <= 0))
        gap = torch.where(free, (at.floor() + 0.5 + around - at).norm(dim=-1), torch.inf)
        nearest = gap.argmin(dim=-1, keepdim=True)
        return torch.where(free.any(dim=-1, keepdim=True), near.gather(-1, nearest), own).squeeze(-1)

    def _depth_beside(self, uv_px: Float[Tensor, "B T Q 2"], step: Float[Tensor, "N 2"]) -> Float[Tensor, "B T Q N"]:
        """Depth some steps beside each position."""
        beside = uv_px.unsqueeze(-2) + step
        return self.depth_at(beside.flatten(2, 3)).reshape(beside.shape[:-1])

    def near_point_at(self, uv_px: Float[Tensor, "B T Q 2"]) -> Float[Tensor, "B T Q 3"]:
        """What is seen at each position, lifted by :meth:`near_depth_at`: reference frame, NaN without depth."""
        return self.to_reference(uv_px, self.near_depth_at(uv_px))


@dataclass(frozen=True)
class Observation:
    """Tokens and cells of a window."""

    tokens: Float[Tensor, "B T N D"]
    """One per patch, with position codes."""
    fine: Float[Tensor, "B T C F"]
    """One per cell of the heatmap."""
    cell_point: Float[Tensor, "B T C 3"]
    """Lifted point of each cell in the reference frame, NaN where depth is missing."""
    close: Float[Tensor, "B T M G"]
    """One per close cell, half as wide as the heatmap's."""
    close_point: Float[Tensor, "B T M 3"]
    """Lifted point of each close cell, NaN where depth is missing."""

    def during(self, frames: slice) -> Observation:
        """Some of the frames."""
        return Observation(**{f.name: getattr(self, f.name)[:, frames] for f in fields(self)})

    def of(self, batch: slice) -> Observation:
        """Some of the batch."""
        return Observation(**{f.name: getattr(self, f.name)[batch] for f in fields(self)})

    @staticmethod
    def stack(frames: list[Observation]) -> Observation:
        """Join observations along time."""
        return Observation(
            **{f.name: torch.cat([getattr(o, f.name) for o in frames], dim=1) for f in fields(Observation)}
        )


def gather_cells(cells: Float[Tensor, "B T C D"], index: Int[Tensor, "B T K M"]) -> Float[Tensor, "B T K M D"]:
    """Cells by their index."""
    b, t, k, m = index.shape
    flat = index.reshape(b, t, k * m, 1).expand(-1, -1, -1, cells.shape[-1])
    return cells.gather(2, flat).reshape(b, t, k, m, -1)


def _steps_around(device: torch.device) -> Float[Tensor, "9 2"]:
    """From a pixel to itself and its neighbours."""
    step = torch.tensor([-1.0, 0.0, 1.0], device=device)
    return torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).reshape(9, 2)


def cell_depth(depth_m: Float[Tensor, "B H W"], cell_px: int) -> Float[Tensor, "B Hc Wc"]:
    """Near depth of each cell: the first quartile of its valid pixels, 0 if less than an eighth are valid.

    The quartile, not the median, so that a thin handle before a large front keeps its own depth.
    """
    b, h, w = depth_m.shape
    patches = depth_m.reshape(b, h // cell_px, cell_px, w // cell_px, cell_px).transpose(2, 3).flatten(3)
    valid = patches > 0
    ordered = torch.where(valid, patches, torch.inf).sort(dim=-1).values
    count = valid.sum(dim=-1)
    index = ((count - 1).clamp(min=0) * 0.25).long()
    near = ordered.gather(-1, index.unsqueeze(-1)).squeeze(-1)
    return torch.where(count * 8 >= cell_px * cell_px, near, torch.zeros_like(near))


def reference_of(
    cell_depth_m: Float[Tensor, "B Hc Wc"], intrinsics: Float[Tensor, "B 4"], image_size: int
) -> tuple[Float[Tensor, "B 3"], Float[Tensor, " B"]]:
    """Centre and scale of the reference frame from the first frame's depth; without depth (0, 0, 1) m and 1 m."""
    flat = cell_depth_m.flatten(1)
    valid = flat > 0
    median = torch.where(valid, flat, torch.nan).nanmedian(dim=1).values
    z = torch.where(valid.any(dim=1), median, torch.ones_like(median))
    center = torch.stack((torch.zeros_like(z), torch.zeros_like(z), z), dim=-1)
    scale = 0.5 * image_size * z / intrinsics[:, 0]
    return center, torch.where(valid.any(dim=1), scale, torch.ones_like(scale))


class Observer(nn.Module):
    """Turns a :class:`FrameBatch` into an :class:`Observation`."""

    fine_width = 128
    close_width = 48

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        grid, d = config.encoder.grid, config.width
        self.project = nn.Linear(config.encoder.width, d)
        self.position = nn.Parameter(0.02 * torch.randn(grid * grid, d))
        self.layers = nn.ModuleList(TokenLayer(d, config.heads) for _ in range(config.token_layers))
        self.norm = nn.LayerNorm(d)
        self.points = PointCode(d) if config.points3d else None
        f = self.fine_width
        self.stem = DetailStem(self.close_width, f, d)
        self.up = nn.Linear(d, 4 * f)
        self.fine_points = PointCode(f) if config.points3d else None
        self.fine_position = nn.Parameter(0.02 * torch.randn(config.cells**2, f))
        self.fine_mlp = nn.Sequential(nn.LayerNorm(f), nn.Linear(f, 2 * f), nn.GELU(), nn.Linear(2 * f, f))
        self.fine_norm = nn.LayerNorm(f)

    def forward(self, frames: FrameBatch) -> Observation:
        """Observe every frame by itself; nothing crosses time here."""
        b, t = frames.features.shape[:2]
        grid, side = self.config.encoder.grid, self.config.cells
        cell_point = self._cell_points(frames)
        image = self._detail_image(frames)
        close, detail, token_detail = (
            m.flatten(2).transpose(1, 2).unflatten(0, (b, t)) for m in self.stem(image.flatten(0, 1))
        )
        tokens = self.project(frames.features) + self.position + token_detail
        if self.points is not None:
            # The nearest of a patch's four cells: the one that a thin part would fill.
            quads = cell_point.reshape(b, t, grid, 2, grid, 2, 3).transpose(3, 4).flatten(4, 5)
            z = torch.where(torch.isfinite(quads[..., 2]), quads[..., 2], torch.inf)
            nearest = z.argmin(dim=-1)[..., None, None].expand(*z.shape[:-1], 1, 3)
            tokens = tokens + self.points(quads.gather(-2, nearest).squeeze(-2).flatten(2, 3))
        flat = tokens.flatten(0, 1)
        for layer in self.layers:
            flat = layer(flat)
        flat = self.norm(flat)
        up = self.up(flat).reshape(b * t, grid, grid, 2, 2, -1).transpose(2, 3).reshape(b, t, side * side, -1)
        fine = detail + up + self.fine_position
        if self.fine_points is not None:
            fine = fine + self.fine_points(cell_point)
        fine = self.fine_norm(fine + self.fine_mlp(fine))
        return Observation(flat.unflatten(0, (b, t)), fine, cell_point, close, self._close_points(frames))

    def _close_points(self, frames: FrameBatch) -> Float[Tensor, "B T M 3"]:
        """Lifted points of the close cells, each by its nearest pixel."""
        b, t = frames.depth_m.shape[:2]
        side = self.config.cell_px // 2
        depth = frames.depth_m.flatten(0, 1).unsqueeze(1)
        near = -F.max_pool2d(torch.where(depth > 0, -depth, -torch.inf), side)
        near = torch.where(torch.isfinite(near), near, 0.0).reshape(b, t, -1)
        centre = grid_centres(2 * self.config.cells, side, device=depth.device).expand(b, t, -1, -1)
        return frames.to_reference(centre, near)

    def _cell_points(self, frames: FrameBatch) -> Float[Tensor, "B T C 3"]:
        b, t = frames.features.shape[:2]
        centre = cell_centres(self.config, device=frames.depth_m.device).expand(b, t, -1, -1)
        return frames.to_reference(centre, frames.cell_depth_m.flatten(2))

    def _detail_image(self, frames: FrameBatch) -> Float[Tensor, "B T S H W"]:
        rgb = frames.rgb.permute(0, 1, 4, 2, 3).to(frames.depth_m.dtype) / 127.5 - 1
        if not self.config.points3d:
            return F.pad(rgb, (0, 0, 0, 0, 0, DetailStem.channels - 3))
        depth = frames.depth_m
        point, valid = frames.image_points().clamp_(-4, 4), (depth > 0).to(depth.dtype).unsqueeze(2)
        standing_out = relief(depth, frames.scale[:, None].expand(depth.shape[:2]))
        return torch.cat((rgb, point, valid, standing_out), dim=2)


def cell_centres(config: NetworkConfig, *, device: torch.device | None = None) -> Float[Tensor, "C 2"]:
    """Centre pixel of every cell of the heatmap, row by row."""
    return grid_centres(config.cells, config.cell_px, device=device)


def grid_centres(cells: int, cell_px: int, *, device: torch.device | None = None) -> Float[Tensor, "C 2"]:
    """Centre pixel of every cell of a square grid, row by row."""
    side = (torch.arange(cells, device=device) + 0.5) * cell_px
    y, x = torch.meshgrid(side, side, indexing="ij")
    return torch.stack((x, y), dim=-1).reshape(-1, 2)
