"""Frames of a window as the published network takes them, and the reference frame of their points.

Reference frame: the camera axes of the frame at which a stream began, centred on the scene and divided by
the half width that the image spans at the median depth, so that coordinates are of order one for a pair of glasses
and for a wardrobe. A NaN coordinate means that depth is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from quest.geometry import exact_product


@dataclass(frozen=True)
class FrameBatch:
    """Frames as the network takes them, letterboxed to its input size."""

    features: Float[Tensor, "B T N E"]
    """Tokens of the encoder."""
    depth_m: Float[Tensor, "B T H W"]
    """Depth along +z, 0 where missing."""
    intrinsics: Float[Tensor, "B 4"]
    """Fx, fy, cx, cy of the letterboxed input, pixels."""
    ref_from_cam: Float[Tensor, "B T 4 4"]
    """Rigid motion from each frame's camera to the reference camera, metres."""
    center: Float[Tensor, "B 3"]
    """Origin of the reference frame in the reference camera, metres."""
    scale: Float[Tensor, " B"]
    """Metres per unit of the reference frame."""

    def during(self, frames: slice) -> FrameBatch:
        """Some of the frames."""
        return replace(
            self,
            features=self.features[:, frames],
            depth_m=self.depth_m[:, frames],
            ref_from_cam=self.ref_from_cam[:, frames],
        )

    def to(self, device: torch.device) -> FrameBatch:
        """The same on a device."""
        return FrameBatch(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

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

    def depth_at(self, uv_px: Float[Tensor, "B T Q 2"]) -> Float[Tensor, "B T Q"]:
        """As :func:`depth_at`."""
        return depth_at(self.depth_m, uv_px)


def depth_at(depth_m: Float[Tensor, "*B H W"], uv_px: Float[Tensor, "*B Q 2"]) -> Float[Tensor, "*B Q"]:
    """Depth of the pixel that each position falls in; 0 where missing or outside."""
    h, w = depth_m.shape[-2:]
    inside = (uv_px >= 0).all(-1) & (uv_px[..., 0] < w) & (uv_px[..., 1] < h)
    x = uv_px[..., 0].nan_to_num().long().clamp(0, w - 1)
    y = uv_px[..., 1].nan_to_num().long().clamp(0, h - 1)
    depth = depth_m.flatten(-2).gather(-1, y * w + x)
    return torch.where(inside, depth, torch.zeros_like(depth))


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
    depth_m: Float[Tensor, "B H W"], intrinsics: Float[Tensor, "B 4"], *, cell_px: int
) -> tuple[Float[Tensor, "B 3"], Float[Tensor, " B"]]:
    """Centre and scale of the reference frame that begins with a frame.

    Args:
        depth_m: of the frame, 0 where missing.
        intrinsics: fx, fy, cx, cy, pixels.
        cell_px: side of the cells over which the median is taken, pixels.

    Returns:
        Its origin in the frame's camera, metres, and metres per unit; without depth (0, 0, 1) m and 1 m.
    """
    flat = cell_depth(depth_m, cell_px).flatten(1)
    valid = flat > 0
    median = torch.where(valid, flat, torch.nan).nanmedian(dim=1).values
    z = torch.where(valid.any(dim=1), median, torch.ones_like(median))
    center = torch.stack((torch.zeros_like(z), torch.zeros_like(z), z), dim=-1)
    scale = 0.5 * depth_m.shape[-1] * z / intrinsics[:, 0]
    return center, torch.where(valid.any(dim=1), scale, torch.ones_like(scale))
