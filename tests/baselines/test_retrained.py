"""Rivals that our takes teach: what they are shown, what they answer, what they learn, and where their weights lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from quest.baselines import TRACKERS, line_up
from quest.baselines.retrained.flow import FlowConfig, _move
from quest.baselines.retrained.layers import read_at
from quest.baselines.retrained.matcher import MatcherConfig, place_of
from quest.baselines.retrained.objective import KINDS, FollowPoints, read_retrained, save_retrained
from quest.baselines.retrained.refiner import RefinerConfig
from quest.baselines.retrained.windows import (
    PointConfig,
    PointSampler,
    PointTruth,
    PointWindow,
    ShownConfig,
    film,
    follow_pixels,
)
from quest.data.cut import cut_clip
from quest.data.store import TakeStore
from quest.errors import ConfigError, WeightsError
from quest.types import Query
from tests.synthetic import make_take

SIDE = 64
SMALL: dict[str, ShownConfig] = {
    "raft-3d-retrained": FlowConfig(image_size=SIDE, width=16, hidden=16, levels=2, radius=2, steps=2, embedding=4),
    "tapnet-retrained": MatcherConfig(image_size=SIDE, frames=3, width=16, hidden=4),
    "cotracker-retrained": RefinerConfig(
        image_size=SIDE, frames=6, window=4, width=16, inner=16, layers=1, levels=2, radius=1, rounds=2
    ),
}
NAMES = list(SMALL)


def small(name: str) -> Any:
    torch.manual_seed(0)
    return KINDS[name].network(SMALL[name])  # type: ignore[call-arg]


def sampler(folder: Path, frames: int) -> PointSampler:
    store = TakeStore(folder / "takes")
    if not store.names():
        store.write(make_take(frames=12, views=2, size=(SIDE, SIDE)))
    views = film(store, store.names(), folder / "filmed", size=SIDE)
    return PointSampler(views, PointConfig(batch=2, points=8, frames=frames))


def batch(folder: Path, name: str) -> tuple[PointWindow, PointTruth]:
    windows = sampler(folder, SMALL[name].frames)
    return windows.load(windows.plan(np.random.default_rng(0)))


def test_pixels_follow_their_links():
    take = make_take(frames=16, views=1, size=(96, 96))
    view, t = take.views[0], np.arange(0, 16, 5)
    seen = view.visible[0]
    pixel = np.floor(view.uv_px[0, seen]).astype(int)
    uv, visible, known = follow_pixels(
        pixel,
        view.link_id[t],
        view.clip.depth_m[t],  # type: ignore[index]
        view.clip.camera,
        view.clip.cam_from_world[t].astype(np.float32),
        take.link_pose[t],
    )
    way, true_way = uv - uv[:1], (view.uv_px[t] - view.uv_px[:1])[:, seen]
    assert abs(true_way).max() > 4
    np.testing.assert_allclose(way, true_way, atol=0.6)
    assert known.all()
    assert (visible == view.visible[t][:, seen]).mean() > 0.9


def test_windows_are_drawn_again_and_made_once(tmp_path: Path):
    first, again = (sampler(tmp_path, 3) for _ in range(2))
    assert first.views == again.views
    assert len(first.views) == 2
    a, b = (s.load(s.plan(np.random.default_rng(1)).part(slice(1, 2))) for s in (first, again))
    assert torch.equal(a[0].rgb, b[0].rgb)
    assert torch.equal(a[1].uv_px, b[1].uv_px)
    assert a[1].visible[:, 0].all()
    torch.testing.assert_close(a[0].uv_px, a[1].uv_px[:, 0])


def test_maps_are_read_at_the_middles_of_their_cells():
    maps = torch.arange(12.0).view(1, 1, 3, 4)
    uv = torch.tensor([[[2.0, 2.0], [6.0, 10.0], [4.0, 2.0]]])
    torch.testing.assert_close(read_at(maps, uv, 4)[0, 0], torch.tensor([0.0, 9.0, 0.5]))


def test_the_place_is_the_mean_around_the_highest():
    where = torch.full((1, 16, 16), -20.0)
    where[0, 4, 5], where[0, 4, 6], where[0, 14, 14] = 5.0, 5.0, 4.9
    torch.testing.assert_close(place_of(where), torch.tensor([[4 * 6.0, 4 * 4.5]]), atol=1e-3, rtol=0)


def test_points_move_with_the_bodies_that_are_trusted():
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(1, 40, 3, generator=generator) + torch.tensor([0.0, 0.0, 3.0])
    angle = torch.tensor(0.1)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]])
    end = start @ turn.T + torch.tensor([0.05, 0.0, 0.1])
    end[:, 20:] = start[:, 20:]  # the other half rests
    weight = torch.zeros(1, 2, 40)
    weight[0, 0, :20], weight[0, 1, 20:] = 1, 1
    point = torch.tensor([[[0.3, 0.2, 3.0], [0.3, 0.2, 3.0]]])
    moved = _move(point, start, end, weight)
    torch.testing.assert_close(moved[0, 0], turn @ point[0, 0] + torch.tensor([0.05, 0.0, 0.1]), atol=2e-3, rtol=0)
    torch.testing.assert_close(moved[0, 1], point[0, 1])


@pytest.mark.parametrize("name", NAMES)
def test_everything_learns(name: str, tmp_path: Path):
    network, (window, truth) = small(name), batch(tmp_path, name)
    objective = FollowPoints(name, network)
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    totals = []
    for _ in range(12):
        losses = objective.losses(window, truth)
        assert set(losses) == set(objective.weights)
        total = torch.stack([objective.weights[key] * value for key, value in losses.items()]).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(float(total.detach()))
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())
    assert totals[-1] < totals[0]
    scores = objective.validate(sampler(tmp_path, window.rgb.shape[1]), batches=1, device=torch.device("cpu"))
    assert scores.points > 0
    assert f"n = {scores.points}" in str(scores)


@pytest.mark.parametrize("name", NAMES)
def test_losses_may_be_computed_in_bfloat16(name: str, tmp_path: Path):
    with torch.autocast("cpu", torch.bfloat16):
        losses = small(name).losses(*batch(tmp_path, name))
    assert all(torch.isfinite(value) and value.dtype == torch.float32 for value in losses.values())


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("retrained")
    for name in NAMES:
        save_retrained(name, small(name), folder / f"{name}.safetensors", about="of a test")
    return folder


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("frames", [1, 2, 5, 9])
def test_trackers_answer_every_frame(name: str, frames: int, weights: Path):
    clip = make_take(frames=max(frames, 2), views=1, size=(80, 48)).views[0].clip
    clip = cut_clip(clip, slice(0, frames))
    (tracker,) = line_up([name], weights="any", rivals=weights)
    queries = [Query.point(0, 20.0, 30.0), Query.point(frames - 1, 60.0, 20.0), Query.point(0, 40.0, 24.0)]
    tracks = tracker.track(clip, queries)
    assert tracks.uv_px.shape == (frames, 3, 2)
    assert np.isfinite(tracks.uv_px[:, [0, 2]]).all()
    assert tracks.uv_px[0, 0] == pytest.approx((20, 30))
    alone = tracker.track(clip, queries[1:2])
    np.testing.assert_allclose(alone.uv_px[-1, 0], (60, 20))


def test_flow_does_without_depth(weights: Path):
    clip = make_take(frames=3, views=1, size=(SIDE, SIDE)).views[0].clip
    plain = type(clip)(clip.name, clip.camera, clip.rgb, None, clip.stamp_s, clip.cam_from_world)
    (tracker,) = line_up(["raft-3d-retrained"], weights="any", rivals=weights)
    assert np.isfinite(tracker.track(plain, [Query.point(0, 20.0, 30.0)]).uv_px).all()


def test_weights_are_of_the_right_network(weights: Path, tmp_path: Path):
    assert all(TRACKERS[name].retrained for name in NAMES)
    with pytest.raises(WeightsError, match="expected weights of tapnet-retrained"):
        read_retrained("tapnet-retrained", weights / "cotracker-retrained.safetensors")
    with pytest.raises(WeightsError, match="tapnet-retrained"):
        line_up(["tapnet-retrained"], weights="any", rivals=tmp_path)
    with pytest.raises(ConfigError, match="quest bench comparison"):
        line_up(["tapnet-retrained"], weights="any")


def test_a_network_has_a_size():
    with pytest.raises(ConfigError, match="from 1 to 4096"):
        RefinerConfig(image_size=10**9)
