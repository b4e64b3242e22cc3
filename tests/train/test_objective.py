"""From windows to losses, for both kinds of queries."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.model.config import NetworkConfig
from quest.model.decoder import RegressionHead
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.train.objective import LossTerms, is_right, roll_out, stage_one
from quest.train.settings import LossWeights
from quest.train.windows import WindowSampler, WindowTruth
from tests.tiny import DEFAULT, PAPER, make_network
from tests.train.prepared import make_sampler

BOTH = pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=lambda c: c.preset)


@pytest.fixture(scope="module")
def samplers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, WindowSampler]:
    return {
        c.preset: make_sampler(tmp_path_factory.mktemp(c.preset), make_network(c), batch=3) for c in (DEFAULT, PAPER)
    }


def draw(samplers: dict[str, WindowSampler], config: NetworkConfig) -> tuple[QuestNetwork, FrameBatch, WindowTruth]:
    frames, truth = samplers[config.preset].draw(np.random.default_rng(0), disturb=False)
    return make_network(config), frames, truth


@BOTH
def test_every_loss_is_finite_and_the_gradient_reaches_every_part(samplers, config: NetworkConfig):
    network, frames, truth = draw(samplers, config)
    terms, _ = stage_one(network, frames, truth)
    assert all(getattr(terms, f.name).isfinite() for f in fields(terms))
    # Random answers of direct regression need not lie where there is depth.
    always = ("aff", "conf")
    assert all(
        getattr(terms, n) > 0 for n in ((*always, "map") if config is PAPER else (*always, "point", "vel", "geo"))
    )
    assert (terms.heat > 0) == (config.head == "heatmap")
    terms.total(LossWeights()).backward()
    assert all(p.grad is not None for p in network.trainable())
    assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)
    still = [n for n, p in network.named_parameters() if p.grad is not None and not p.grad.any()]
    # Depth is whole in these takes, so nothing teaches the codes that stand for missing points.
    assert not [n for n in still if not n.endswith(".missing") and "binder.label" not in n]


@BOTH
def test_windows_without_depth_teach_too(samplers, config: NetworkConfig):
    network, frames, truth = draw(samplers, config)
    dark = replace(frames, depth_m=0 * frames.depth_m, cell_depth_m=0 * frames.cell_depth_m)
    terms, roll = stage_one(network, dark, truth)
    assert roll.prediction.point.isnan().all()
    terms.total(LossWeights()).backward()
    assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)
    assert terms.aff > 0
    assert terms.point == 0


@BOTH
def test_nothing_to_learn_from_is_no_nan(samplers, config: NetworkConfig):
    network, frames, truth = draw(samplers, config)
    nothing = replace(truth, bound=torch.zeros_like(truth.bound), visible=torch.zeros_like(truth.visible))
    terms, _ = stage_one(network, frames, replace(nothing, uv=torch.full_like(truth.uv, torch.nan)))
    terms.total(LossWeights()).backward()
    assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)


def test_answers_do_not_depend_on_the_truth_of_the_window(samplers):
    network, frames, truth = draw(samplers, DEFAULT)
    lie = replace(truth, uv=torch.cat((truth.uv[:, :1], torch.rand_like(truth.uv[:, 1:])), dim=1))
    honest, taught = roll_out(network, frames, truth), roll_out(network, frames, lie)
    torch.testing.assert_close(honest.prediction.uv, taught.prediction.uv)
    assert not torch.allclose(honest.taught.uv, taught.taught.uv)


def test_teaching_refines_around_the_true_cell(samplers):
    network, frames, truth = draw(samplers, DEFAULT)
    roll = roll_out(network, frames, truth)
    side = DEFAULT.cells
    for b, t, k in roll.mask.nonzero().tolist():
        peak, x, y = int(roll.prediction.peak[b, t, k]), *(roll.truth_uv[b, t, k] * side).long().tolist()
        near = max(abs(peak % side - x), abs(peak // side - y)) <= 1
        assert int(roll.taught.peak[b, t, k]) == (peak if near else y * side + x)


def test_the_total_weighs_every_term():
    values = torch.arange(1.0, 1 + len(fields(LossTerms)))
    terms = LossTerms(*values)
    weights = LossWeights(*(0.5 * v for v in values.tolist()))
    assert float(terms.total(weights)) == pytest.approx(float((0.5 * values * values).sum()))
    assert [f.name for f in fields(LossTerms)] == [f.name for f in fields(LossWeights)]


def test_is_right_against_a_plain_loop(samplers):
    _, _, truth = draw(samplers, DEFAULT)
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
@BOTH
def test_a_tiny_set_can_be_learned_by_heart(samplers, config: NetworkConfig):
    network, frames, truth = draw(samplers, config)
    network.train().encoder.requires_grad_(False)
    optimizer = torch.optim.AdamW(network.trainable(), lr=5e-3)
    history = []
    for _ in range(16):
        terms, _ = stage_one(network, frames, truth)
        loss = terms.total(LossWeights())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        history.append(float(loss.detach()))
    assert np.mean(history[-3:]) < 0.7 * history[0]


def test_learned_queries_keep_their_slot_from_the_anchor_frame_on(samplers):
    network, frames, truth = draw(samplers, PAPER)
    roll = roll_out(network, frames, truth)
    slots, observed = network.slots(3), network.observe(frames)
    with torch.no_grad():
        every = network.decode(slots, observed.during(slice(1, None)), frames.during(slice(1, None)))
        start = network.decode(slots, observed.during(slice(0, 1)), frames.during(slice(0, 1)))
    assert roll.slots is not None
    assert (roll.asked == truth.bound).all()
    for b in range(3):
        taken = [int(roll.slots.slot[b, k]) for k in truth.bound[b].nonzero().flatten()]
        assert len(set(taken)) == len(taken)
    for b, k in truth.bound.nonzero().tolist():
        slot = int(roll.slots.slot[b, k])
        torch.testing.assert_close(roll.prediction.uv[b, :, k].detach(), every.uv[b, :, slot])
        torch.testing.assert_close(roll.slots.prediction.uv[b, 0, slot].detach(), start.uv[b, 0, slot])


def test_a_hidden_entity_teaches_no_lifting_of_what_hides_it(samplers):
    network, frames, truth = draw(samplers, PAPER)
    assert isinstance(network.head, RegressionHead)
    for parameter in network.head.mlp[-1].parameters():  # every slot answers the middle, where there is depth
        torch.nn.init.zeros_(parameter)
    terms, roll = stage_one(network, frames, truth)
    assert roll.prediction.point.isfinite().all()
    hidden = torch.cat((truth.visible[:, :1], torch.zeros_like(truth.visible[:, 1:])), dim=1)
    assert terms.point > 0
    assert stage_one(network, frames, replace(truth, visible=hidden))[0].point == 0


def test_prepared_views_keep_their_files(tmp_path: Path):
    """Windows read memory maps: nothing of a view is copied before it is drawn."""
    sampler = make_sampler(tmp_path, make_network(), seeds=(0,))
    view = next(v for v in sampler.views if v.object_id == "panels-0")
    assert isinstance(view.features, np.memmap)
