"""Depth of cells, the reference frame, and what a frame shows."""

from __future__ import annotations

import math

import pytest
import torch

from quest.geometry import invert, project, transform
from quest.model.observation import FrameBatch, Observation, cell_centres, cell_depth, reference_of
from quest.types import Camera
from tests.tiny import DEFAULT, make_frames, make_network
from tests.tolerances import NETWORK, PIXEL_MOVED


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
    center, scale = reference_of(depth, torch.tensor([[100.0, 100.0, 32.0, 32.0]]), 64)
    assert center.tolist() == [[0.0, 0.0, 2.0]]
    assert scale.tolist() == pytest.approx([0.5 * 64 * 2.0 / 100])


def test_reference_without_depth():
    depth = torch.stack([torch.zeros(4, 4), torch.full((4, 4), 3.0)])
    center, scale = reference_of(depth, torch.tensor([[100.0, 100.0, 32.0, 32.0]] * 2), 64)
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
    point, pixel = frames.to_reference(uv_px, depth_m), frames.from_reference(frames.to_reference(uv_px, depth_m))
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(frames.to_reference(uv_px, depth_m), point)
        torch.testing.assert_close(frames.from_reference(point), pixel)


def test_points_of_the_whole_image_are_those_of_its_pixels():
    frames = make_frames()
    turn = torch.linalg.qr(torch.randn(2, 4, 3, 3, generator=torch.Generator().manual_seed(0))).Q
    frames.ref_from_cam[..., :3, :3] = turn
    h, w = frames.depth_m.shape[-2:]
    y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    uv = torch.stack((x, y), dim=-1).reshape(1, 1, h * w, 2).expand(*frames.depth_m.shape[:2], -1, -1)
    expected = frames.to_reference(uv, frames.depth_m.flatten(2)).nan_to_num(0.0)
    assert torch.allclose(frames.image_points().flatten(3).transpose(2, 3), expected, atol=1e-5)


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
    assert frames.near_depth_at(uv[:, :, :1]).item() == 2.0
    frames.depth_m[:] = 0
    assert (frames.near_depth_at(uv) == 0).all()


def test_depth_of_thin_parts_and_of_slopes():
    frames = make_frames(batch=1, frames=1)
    frames.depth_m[:] = 3.0
    frames.depth_m[0, 0, :, 21] = 2.0  # a wire
    frames.depth_m[0, 0, 40:] = 3.0 - 0.1 * torch.arange(24)[:, None]  # a slope
    frames.depth_m[0, 0, 5, 40] = 0.0
    uv = torch.tensor(
        [[[[22.2, 11.5], [21.5, 11.5], [24.5, 11.5], [50.5, 50.5], [40.5, 5.5], [64.0, 3.0], [66.0, 3.0]]]]
    )
    expected = torch.tensor([2.0, 2.0, 3.0, 2.0, 3.0, 3.0, 0.0])
    torch.testing.assert_close(frames.edge_depth_at(uv)[0, 0], expected)
    frames.depth_m[:] = 0
    assert (frames.edge_depth_at(uv) == 0).all()


def test_cells_are_counted_row_by_row():
    centres = cell_centres(DEFAULT)
    assert centres.shape == (64, 2)
    assert centres[0].tolist() == [4.0, 4.0]
    assert centres[9].tolist() == [12.0, 12.0]
    assert centres[7].tolist() == [60.0, 4.0]


def one(frames: FrameBatch, b: int) -> FrameBatch:
    return frames.of(slice(b, b + 1))


def test_neither_batch_nor_time_mix():
    network, frames = make_network(), make_frames(batch=3)
    with torch.no_grad():
        together = network.observe(frames)
        alone = network.observe(one(frames, 1).during(slice(2, 3)))
    for name in Observation.__dataclass_fields__:
        expected = getattr(together, name)[1:2, 2:3]
        torch.testing.assert_close(getattr(alone, name), expected, **NETWORK, equal_nan=True)


def test_stack_undoes_during():
    observed = make_network().observe(make_frames())
    again = Observation.stack([observed.during(slice(t, t + 1)) for t in range(4)])
    assert (again.tokens == observed.tokens).all()
    assert (again.fine == observed.fine).all()


def test_no_depth_is_no_nan():
    observed = make_network().observe(make_frames(depth=False))
    assert observed.cell_point.isnan().all()
    assert observed.tokens.isfinite().all()
    assert observed.fine.isfinite().all()


def test_depth_is_used_only_where_it_is_asked_for():
    for points3d, differs in ((True, True), (False, False)):
        network = make_network(DEFAULT, points3d=points3d)
        with_depth, without = make_frames(), make_frames(depth=False)
        same = (network.observe(with_depth).tokens == network.observe(without).tokens).all()
        assert bool(same) != differs


def test_pixels_of_lifted_points_are_the_pixels():
    frames = make_frames()
    uv_px = 64 * torch.rand(2, 4, 5, 2, generator=torch.Generator().manual_seed(1))
    point = frames.to_reference(uv_px, torch.full((2, 4, 5), 1.3))
    torch.testing.assert_close(frames.from_reference(point), uv_px, **PIXEL_MOVED)
    behind = frames.to_reference(uv_px, torch.full((2, 4, 5), 1.3)) - torch.tensor([0.0, 0.0, 100.0])
    assert frames.from_reference(behind).isnan().all()
