"""Depth of cells, the reference frame, and what pixels of a frame show."""

from __future__ import annotations

import math

import pytest
import torch

from quest.geometry import invert, project, transform
from quest.model.frames import cell_depth, reference_of
from quest.types import Camera
from tests.tiny import make_frames
from tests.tolerances import PIXEL_MOVED


def test_cell_depth_against_a_plain_loop():
    torch.manual_seed(0)
    depth_m = 0.5 + torch.rand(3, 16, 32)
    depth_m[torch.rand(depth_m.shape) < torch.tensor([0.0, 0.5, 0.88])[:, None, None]] = 0
    depth_m[0, :8, :8] = 0
    depth_m[1, 8, 8] = math.nan
    got = cell_depth(depth_m, 8)
    for b in range(3):
        for row in range(2):
            for column in range(4):
                cell = depth_m[b, row * 8 : row * 8 + 8, column * 8 : column * 8 + 8].flatten().tolist()
                valid = sorted(d for d in cell if d > 0)
                expected = valid[int((len(valid) - 1) * 0.25)] if len(valid) >= 8 else 0.0
                assert got[b, row, column] == pytest.approx(expected)


def test_a_thin_part_keeps_its_own_depth():
    depth_m = torch.full((1, 8, 8), 2.0)
    depth_m[0, :, 3:6] = 1.0
    assert cell_depth(depth_m, 8).item() == 1.0


def test_reference_is_centred_on_the_median():
    depth = torch.tensor([[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]])
    center, scale = reference_of(depth, torch.tensor([[100.0, 100.0, 1.5, 1.0]]), cell_px=1)
    assert center.tolist() == [[0.0, 0.0, 2.0]]
    assert scale.tolist() == pytest.approx([0.5 * 3 * 2.0 / 100])


def test_the_median_is_of_cells():
    """Where depth is sparse, a cell counts once however many of its pixels have any."""
    depth = torch.zeros(1, 24, 24)
    depth[0, :8, :8], depth[0, 8:16, 8:12], depth[0, 20:24, 16:20] = 1.0, 2.0, 3.0
    center, _ = reference_of(depth, torch.tensor([[100.0, 100.0, 12.0, 12.0]]), cell_px=8)
    assert center.tolist() == [[0.0, 0.0, 2.0]]


def test_reference_without_depth():
    depth = torch.stack([torch.zeros(64, 64), torch.full((64, 64), 3.0)])
    center, scale = reference_of(depth, torch.tensor([[100.0, 100.0, 32.0, 32.0]] * 2), cell_px=8)
    assert center.tolist() == [[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]]
    assert scale.tolist() == pytest.approx([1.0, 0.96])


def test_to_reference_is_undone_by_projection():
    frames = make_frames(batch=2, frames=3)
    uv = 64 * torch.rand(2, 3, 5, 2)
    depth = frames.depth_at(uv)
    point = frames.to_reference(uv, depth)
    assert (point.isnan().any(-1) == (depth == 0)).all()
    metric = point * frames.scale[:, None, None, None] + frames.center[:, None, None]
    cam = transform(invert(frames.ref_from_cam)[:, :, None], metric)
    back = project(cam, Camera(80.0, 80.0, 32.0, 32.0, 64, 64))
    seen = depth > 0
    assert seen.any()
    torch.testing.assert_close(back[seen], uv[seen], **PIXEL_MOVED)


def test_places_are_exact_where_the_network_computes_in_bfloat16():
    frames = make_frames(batch=1, frames=2)
    uv_px = 64 * torch.rand(1, 2, 50, 2, generator=torch.Generator().manual_seed(0))
    depth_m = torch.full((1, 2, 50), 2.0)
    point = frames.to_reference(uv_px, depth_m)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(frames.to_reference(uv_px, depth_m), point)


def test_missing_depth_does_not_spoil_the_gradient():
    frames = make_frames(batch=1, frames=1)
    uv = torch.tensor([[[[10.0, 10.0], [20.0, 20.0]]]], requires_grad=True)
    frames.to_reference(uv, torch.tensor([[[1.0, 0.0]]]))[0, 0, 0].sum().backward()
    assert uv.grad is not None
    assert uv.grad.isfinite().all()


def test_depth_under_pixels():
    frames = make_frames(batch=1, frames=1)
    frames.depth_m[0, 0, 10:13, 20:23] = torch.tensor([[3.0, 3, 3], [3, 0, 2], [3, 3, 3]])
    uv = torch.tensor([[[[21.5, 11.5], [20.0, 10.99], [64.0, 3.0], [-0.1, 3.0], [math.nan, 3.0]]]])
    assert frames.depth_at(uv)[0, 0].tolist() == [0.0, 3.0, 0.0, 0.0, 0.0]
