"""Windows, their truth, and which answers are right."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from quest.errors import ConfigError
from quest.geometry import invert, project, transform
from quest.train.answers import is_right
from quest.train.feature_cache import CachedView
from quest.train.settings import WindowConfig
from quest.train.windows import WindowSampler
from quest.types import Camera
from tests.paper.tiny import PAPER, make_paper
from tests.tolerances import EXACT
from tests.train.prepared import prepare

WINDOW = PAPER.window


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[CachedView]:
    """One view with two entities, one with three, one of an object with NaN pixels."""
    return prepare(tmp_path_factory.mktemp("prepared"), make_paper(), seeds=(0, 1, 2))


def sampler(views: list[CachedView], **changes) -> WindowSampler:
    return WindowSampler(views, PAPER, replace(WindowConfig(batch=6), **changes))


@pytest.mark.parametrize("disturb", [True, False])
def test_shapes_and_masks(views: list[CachedView], disturb: bool):
    frames, truth = sampler(views).draw(np.random.default_rng(0), disturb=disturb)
    assert frames.features.shape == (6, 1 + WINDOW, 16, 32)
    assert frames.depth_m.shape == (6, 1 + WINDOW, 64, 64)
    assert truth.uv.shape == (6, 1 + WINDOW, 3, 2)
    assert truth.visible[:, 0].any(dim=1).all(), "something must be seen in the anchor frame"
    assert (truth.exists.sum(dim=1) >= 2).all()
    assert not truth.exists.all(), "one object has fewer entities than the other"
    assert not truth.visible.transpose(1, 2)[~truth.exists].any()


def test_truth_is_what_the_frames_show(views: list[CachedView]):
    """The pixels are the projections of the points, so are the depths where an entity is seen."""
    frames, truth = sampler(views).draw(np.random.default_rng(1), disturb=False)
    metric = truth.point * frames.scale[:, None, None, None] + frames.center[:, None, None]
    cam = transform(invert(frames.ref_from_cam)[:, :, None], metric)
    for b in range(6):
        seen = truth.exists[b]
        fx, fy, cx, cy = frames.intrinsics[b].tolist()
        uv = project(cam[b][:, seen], Camera(fx, fy, cx, cy, 64, 64))
        torch.testing.assert_close(uv, 64 * truth.uv[b][:, seen], rtol=1e-4, atol=0.02)
    depth = frames.depth_at(64 * truth.uv)
    assert ((depth - cam[..., 2]).abs()[truth.visible] < 0.02).all()


def test_entities_keep_to_their_axis(views: list[CachedView]):
    _, truth = sampler(views).draw(np.random.default_rng(2), disturb=False)
    origin, direction = truth.axis[:, None, :, :3], truth.axis[:, None, :, 3:]
    torch.testing.assert_close(direction.norm(dim=-1)[truth.exists[:, None]], torch.ones(int(truth.exists.sum())))
    height = ((truth.point - origin) * direction).sum(-1)
    radius = (truth.point - origin - height.unsqueeze(-1) * direction).norm(dim=-1)
    turning = (truth.exists & truth.revolute)[:, None].expand_as(height)
    sliding = (truth.exists & ~truth.revolute)[:, None].expand_as(height)
    assert turning.any()
    assert sliding.any()
    # Radius is constant for both kinds; height only where an entity turns.
    assert ((radius - radius[:, :1]).abs()[turning | sliding] < 1e-3).all()
    assert ((height - height[:, :1]).abs()[turning] < 1e-3).all()


def test_unit_is_half_the_diagonal(views: list[CachedView]):
    frames, truth = sampler(views).draw(np.random.default_rng(3))
    known = {round(v.half_diagonal_m, 4) for v in views}
    assert {round(float(m), 4) for m in truth.unit * frames.scale} <= known


def test_the_same_seed_draws_the_same_windows(views: list[CachedView]):
    one, two = (sampler(views).draw(np.random.default_rng(5)) for _ in range(2))
    other = sampler(views).draw(np.random.default_rng(6))
    for a, b, c in zip(one, two, other, strict=True):
        for f in fields(a):
            torch.testing.assert_close(getattr(a, f.name), getattr(b, f.name), equal_nan=True, **EXACT)
        assert any(not torch.equal(getattr(a, f.name), getattr(c, f.name)) for f in fields(a))


def test_windows_are_in_order_with_one_stride(views: list[CachedView]):
    s, rng = sampler(views), np.random.default_rng(7)
    strides = set()
    for _ in range(60):
        view, (anchor, *window), following = s._pick(views[0], rng)
        assert view.visible[anchor].any()
        assert all(0 <= t < len(view) for t in window)
        steps = np.diff(window)
        inner = steps[(np.array(window[1:]) > 0) & (np.array(window[1:]) < len(view) - 1)]
        assert len(set(inner)) <= 1 or (steps >= 0).all() or (steps <= 0).all()
        strides |= set(steps.tolist())
        assert following == -1 or following - window[-1] == steps[-1]
    assert strides >= {-3, -1, 0, 1, 3}


def test_windows_lose_their_depth_only_where_they_are_disturbed(views: list[CachedView]):
    always, rng = sampler(views, depth_drop_share=1.0), np.random.default_rng(0)
    frames, _ = always.draw(rng, disturb=False)
    assert (frames.depth_m > 0).any()
    frames, truth = always.draw(rng)
    assert (frames.depth_m == 0).all()
    assert (frames.scale == 1).all()
    assert truth.point.isfinite().all()
    some, _ = sampler(views, depth_drop_share=0.5, batch=40).draw(rng)
    with_depth = (some.depth_m > 0).flatten(1).any(dim=1)
    assert with_depth.any()
    assert not with_depth.all()


def test_views_in_which_nothing_is_seen(views: list[CachedView]):
    blind = replace(views[0], visible=np.zeros_like(views[0].visible))
    assert sampler([blind, views[1]]).views == [views[1]]
    with pytest.raises(ConfigError, match="visible"):
        sampler([blind])


def test_what_is_behind_the_camera_has_no_pixel(views: list[CachedView]):
    uv = np.array(views[0].uv_px)
    visible = np.array(views[0].visible)
    uv[3:, 0], visible[3:, 0] = np.nan, False
    _, truth = sampler([replace(views[0], uv_px=uv, visible=visible)]).draw(np.random.default_rng(0))
    assert truth.uv.isnan().any()
    assert not truth.visible[truth.uv.isnan().any(-1)].any()


def test_is_right_against_a_plain_loop(views: list[CachedView]):
    _, truth = sampler(views, batch=3).draw(np.random.default_rng(0), disturb=False)
    b, s, k = truth.visible.shape
    torch.manual_seed(0)
    point = truth.point[:, 1:].clone()
    point += truth.unit[:, None, None, None] * 0.06 * torch.randn_like(point)
    point[0, :, 0] = truth.point[0, 1:, 1]
    point[1, 0] = torch.nan
    px = 16 * torch.rand(b, s - 1, k)
    px[1, 0, 0] = torch.nan
    right = is_right(point, truth, px)
    for i, t, q in truth.exists[:, None].expand(-1, s - 1, -1).nonzero().tolist():
        if point[i, t, q].isnan().any():
            expected = float(px[i, t, q]) < 8
        else:
            gaps = [
                float((point[i, t, q] - truth.point[i, t + 1, e]).norm() / truth.unit[i])
                for e in range(k)
                if truth.exists[i, e]
            ]
            expected = min(gaps) == gaps[q] and gaps[q] < 0.1
        assert bool(right[i, t, q]) == expected
    assert right.any()
    assert not right[0, :, 0].any()


def test_where_nothing_is_lifted_pixels_decide(views: list[CachedView]):
    """And an answer for what is behind the camera is wrong, as it has no pixel."""
    _, truth = sampler(views, batch=3).draw(np.random.default_rng(0), disturb=False)
    point = torch.full_like(truth.point[:, 1:], torch.nan)
    px = torch.full(point.shape[:3], 7.9)
    px[:, 1], px[:, 2] = 8.1, torch.nan
    right = is_right(point, truth, px)
    assert right[:, 0].all()
    assert not right[:, 1:3].any()
