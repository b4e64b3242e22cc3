"""From windows to losses, for both kinds of queries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.train.losses import weighted_sum, weights_of
from quest.train.objective import LOSSES, is_right, roll_out
from quest.train.stage import StageOne
from quest.train.windows import WindowSampler, WindowTruth
from tests.tiny import DEFAULT, make_network
from tests.train.prepared import make_sampler

WEIGHTS = weights_of(LOSSES, {})


@pytest.fixture(scope="module")
def sampler(tmp_path_factory: pytest.TempPathFactory) -> WindowSampler:
    return make_sampler(tmp_path_factory.mktemp("objective"), make_network(), batch=3)


def draw(sampler: WindowSampler) -> tuple[QuestNetwork, FrameBatch, WindowTruth]:
    frames, truth = sampler.draw(np.random.default_rng(0), disturb=False)
    return make_network(), frames, truth


def test_every_loss_is_finite_and_the_gradient_reaches_every_part(sampler):
    network, frames, truth = draw(sampler)
    values = StageOne(network).losses(frames, truth)
    assert set(values) == set(LOSSES)
    assert all(value.isfinite() for value in values.values())
    assert all(values[name] > 0 for name in ("aff", "heat", "conf", "point", "vel", "geo"))
    weighted_sum(values, WEIGHTS).backward()
    assert all(p.grad is not None for p in network.trainable())
    assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)
    still = [n for n, p in network.named_parameters() if p.grad is not None and not p.grad.any()]
    # Depth is whole in these takes, so nothing teaches the codes that stand for missing points.
    assert not [n for n in still if not n.endswith(".missing") and "binder.label" not in n]


def test_windows_without_depth_teach_too(sampler):
    network, frames, truth = draw(sampler)
    dark = replace(frames, depth_m=0 * frames.depth_m, cell_depth_m=0 * frames.cell_depth_m)
    values = StageOne(network).losses(dark, truth)
    assert roll_out(network, dark, truth).point.isnan().all()
    weighted_sum(values, WEIGHTS).backward()
    assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)
    assert values["aff"] > 0
    assert values["point"] == 0


def test_nothing_to_learn_from_is_no_nan(sampler):
    network, frames, truth = draw(sampler)
    nothing = replace(truth, bound=torch.zeros_like(truth.bound), visible=torch.zeros_like(truth.visible))
    weighted_sum(
        StageOne(network).losses(frames, replace(nothing, uv=torch.full_like(truth.uv, torch.nan))), WEIGHTS
    ).backward()
    assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)


def test_answers_do_not_depend_on_the_truth_of_the_window(sampler):
    network, frames, truth = draw(sampler)
    lie = replace(truth, uv=torch.cat((truth.uv[:, :1], torch.rand_like(truth.uv[:, 1:])), dim=1))
    honest, taught = roll_out(network, frames, truth), roll_out(network, frames, lie)
    torch.testing.assert_close(honest.prediction.uv, taught.prediction.uv)
    assert not torch.allclose(honest.taught.uv, taught.taught.uv)


def test_teaching_refines_around_the_true_cell(sampler):
    network, frames, truth = draw(sampler)
    roll = roll_out(network, frames, truth)
    side = DEFAULT.cells
    for b, t, k in roll.mask.nonzero().tolist():
        peak, x, y = int(roll.prediction.peak[b, t, k]), *(roll.truth_uv[b, t, k] * side).long().tolist()
        near = max(abs(peak % side - x), abs(peak // side - y)) <= 1
        assert int(roll.taught.peak[b, t, k]) == (peak if near else y * side + x)


def test_is_right_against_a_plain_loop(sampler):
    _, _, truth = draw(sampler)
    b, s, k = truth.visible.shape
    torch.manual_seed(0)
    point = truth.point[:, 1:].clone()
    point += truth.unit[:, None, None, None] * 0.06 * torch.randn_like(point)
    point[0, :, 0] = truth.point[0, 1:, 1]
    point[1, 0] = torch.nan
    px = 16 * torch.rand(b, s - 1, k)
    px[1, 0, 0] = torch.nan
    right, judged = is_right(point, truth, px)
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
    assert (judged == px.isfinite()).all()
    assert right.any()
    assert not right[0, :, 0].any()


@pytest.mark.slow
def test_a_tiny_set_can_be_learned_by_heart(sampler):
    network, frames, truth = draw(sampler)
    network.train().encoder.requires_grad_(False)
    optimizer = torch.optim.AdamW(network.trainable(), lr=5e-3)
    history = []
    for _ in range(16):
        loss = weighted_sum(StageOne(network).losses(frames, truth), WEIGHTS)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        history.append(float(loss.detach()))
    assert np.mean(history[-3:]) < 0.7 * history[0]


def test_prepared_views_keep_their_files(tmp_path: Path):
    """Windows read memory maps: nothing of a view is copied before it is drawn."""
    sampler = make_sampler(tmp_path, make_network(), seeds=(0,))
    view = next(v for v in sampler.views if v.object_id == "panels-0")
    assert isinstance(view.features, np.memmap)
