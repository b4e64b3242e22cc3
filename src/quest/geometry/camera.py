"""Pinhole projection and lifting.

Pixel centres lie at half-integers, camera axes are OpenCV's (x right, y down, z forward).

Reference: Hartley and Zisserman, Multiple View Geometry, section 6.1.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from quest.types import Camera


def project(point_cam: Float[Tensor, "*B 3"], camera: Camera) -> Float[Tensor, "*B 2"]:
    """Pixels of camera-frame points in metres; NaN for points that are not in front of the camera."""
    z = point_cam[..., 2]
    valid = z > 1e-6
    # NaN comes in last, so that it never reaches the gradient of the points that are in front.
    z = torch.where(valid, z, torch.ones_like(z))
    x = camera.fx * point_cam[..., 0] / z + camera.cx
    y = camera.fy * point_cam[..., 1] / z + camera.cy
    uv_px = torch.stack((x, y), dim=-1)
    return torch.where(valid.unsqueeze(-1), uv_px, torch.full_like(uv_px, torch.nan))


def lift(uv_px: Float[Tensor, "*B 2"], depth_m: Float[Tensor, "*B"], camera: Camera) -> Float[Tensor, "*B 3"]:
    """Camera-frame points in metres of pixels with depth along +z; NaN where depth is 0 or not finite."""
    valid = (depth_m > 0) & torch.isfinite(depth_m)
    z = torch.where(valid, depth_m, torch.ones_like(depth_m))
    x = (uv_px[..., 0] - camera.cx) / camera.fx * z
    y = (uv_px[..., 1] - camera.cy) / camera.fy * z
    point = torch.stack((x, y, z), dim=-1)
    return torch.where(valid.unsqueeze(-1), point, torch.full_like(point, torch.nan))


def lift_depth(depth_m: Float[Tensor, "*B H W"], camera: Camera) -> Float[Tensor, "*B H W 3"]:
    """Camera-frame point of every pixel of a depth image, metres; NaN where depth is missing."""
    h, w = depth_m.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(h, dtype=depth_m.dtype, device=depth_m.device) + 0.5,
        torch.arange(w, dtype=depth_m.dtype, device=depth_m.device) + 0.5,
        indexing="ij",
    )
    uv_px = torch.stack((x, y), dim=-1).expand(*depth_m.shape, 2)
    return lift(uv_px, depth_m, camera)


def scale_camera(
    camera: Camera,
    *,
    scale: float | tuple[float, float],
    pad_left_px: float,
    pad_top_px: float,
    width: int,
    height: int,
) -> Camera:
    """Intrinsics after resizing an image by ``scale`` and placing it on a canvas.

    Args:
        camera: intrinsics of the source image.
        scale: target pixels per source pixel, of both axes or of x and y.
        pad_left_px: columns left of the resized image on the canvas.
        pad_top_px: rows above the resized image on the canvas.
        width: canvas width, pixels.
        height: canvas height, pixels.
    """
    x, y = scale if isinstance(scale, tuple) else (scale, scale)
    return Camera(
        camera.fx * x,
        camera.fy * y,
        camera.cx * x + pad_left_px,
        camera.cy * y + pad_top_px,
        width,
        height,
    )
