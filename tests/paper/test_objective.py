"""What learned slots are taught: one match for all frames, to say so where there is nothing; and that they learn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from quest.model.frames import FrameBatch
from quest.paper.network import PaperNetwork
from quest.paper.objective import (
    LOSSES,
    PaperStageOne,
    SlotRollout,
    coordinate_loss,
    early_loss,
    exists_loss,
    roll_out,
    slot_confidence_loss,
    slot_label_loss,
    where_loss,
)
from quest.train.answers import RIGHT_PX
from quest.train.loop import StepReport, fit
from quest.train.losses import weighted_sum, weights_of
from quest.train.settings import TrainingConfig
from quest.train.windows import WindowSampler, WindowTruth
from tests.paper.tiny import PAPER, make_paper
from tests.train.prepared import make_sampler

WEIGHTS = weights_of(LOSSES, {})

Batch = tuple[PaperNetwork, FrameBatch, WindowTruth]


@pytest.fixture(scope="module")
def sampler(tmp_path_factory: pytest.TempPathFactory) -> WindowSampler:
    return make_sampler(tmp_path_factory.mktemp("slots"), make_paper(), batch=3)


@pytest.fixture
def batch(sampler: WindowSampler) -> Batch:
    return make_paper(), *sampler.draw(np.random.default_rng(0), disturb=False)


def answer(batch: Batch, *, whole: bool, **changes: torch.Tensor) -> SlotRollout:
    network, frames, truth = batch
    with torch.no_grad():
        return roll_out(network, frames, replace(truth, **changes), whole=whole)


def far(truth: WindowTruth) -> torch.Tensor:
    """Truth that is elsewhere in the window, and as it was at the anchor frame."""
    return torch.cat((truth.uv[:, :1], 1 - truth.uv[:, 1:]), dim=1)


def test_judged_answers_are_matched_by_the_anchor_frame_alone(batch: Batch):
    truth = batch[-1]
    honest, lie = answer(batch, whole=False), answer(batch, whole=False, uv=far(truth), visible=truth.visible.clone())
    assert (honest.slot == lie.slot).all()
    assert (honest.asked == (truth.visible[:, 0] & truth.exists)).all()


def test_training_matches_by_all_frames_together(batch: Batch):
    honest, truth = answer(batch, whole=True), batch[-1]
    # What shows up later is somebody's too: its slot must not be told that there is nothing.
    late = torch.cat((torch.zeros_like(truth.visible[:, :1]), torch.ones_like(truth.visible[:, 1:])), dim=1)
    found = answer(batch, whole=True, visible=late)
    assert (found.asked == truth.exists).all()
    for b, k in truth.exists.nonzero().tolist():
        assert (found.of_entities.uv[b, :, k] == found.slots.uv[b, :, found.slot[b, k]]).all()
        assert (found.uv[b, :, k] == found.slots.uv[b, 1:, found.slot[b, k]]).all()
    moved = [answer(batch, whole=True, uv=(truth.uv + 0.2 * n).remainder(1)).slot for n in range(5)]
    assert any((slot != honest.slot).any() for slot in moved)


def test_slots_are_taken_once_and_answer_at_the_anchor_frame_by_themselves(batch: Batch):
    network, frames, truth = batch
    roll = answer(batch, whole=False)
    with torch.no_grad():
        start, window = network(frames.during(slice(0, 1))), network(frames.during(slice(1, None)))
    torch.testing.assert_close(roll.slots.uv, torch.cat((start.uv, window.uv), dim=1))
    for b in range(len(truth.unit)):
        taken = roll.slot[b, roll.asked[b]].tolist()
        assert len(set(taken)) == len(taken)


@pytest.mark.parametrize("near", [False, True])
def test_confidence_of_all_slots_against_a_plain_loop(batch: Batch, near: bool):
    roll = answer(batch, whole=True)
    if near:
        roll = replace(roll, truth=replace(roll.truth, uv=roll.of_entities.uv + 4 / 64))
    right, exists = torch.zeros_like(roll.slots.logit), torch.zeros_like(roll.slots.logit)
    for i, t, k in (roll.truth.visible & roll.asked[:, None]).nonzero().tolist():
        slot = int(roll.slot[i, k])
        gap = float((roll.slots.uv[i, t, slot] - roll.truth.uv[i, t, k]).norm()) * 64
        right[i, t, slot], exists[i, t, slot] = gap < RIGHT_PX, 1
    assert right.any() or not near
    for loss, target in ((slot_confidence_loss, right), (exists_loss, exists)):  # the second however far it is off
        expected = F.binary_cross_entropy_with_logits(roll.slots.logit, target)
        assert float(loss(roll)) == pytest.approx(float(expected), rel=1e-4)


def test_unmatched_slots_learn_that_there_is_nothing(batch: Batch):
    roll = roll_out(*batch, whole=True)
    logit = roll.slots.logit
    logit.retain_grad()
    slot_confidence_loss(roll).backward()
    assert logit.grad is not None
    for b in range(len(logit)):
        others = [q for q in range(PAPER.slots) if q not in roll.slot[b, roll.asked[b]].tolist()]
        assert others
        assert (logit.grad[b, :, others] > 0).all()


def test_an_entity_without_a_slot_says_nothing_of_slot_0(batch: Batch):
    roll = answer(batch, whole=True)
    asked = torch.zeros_like(roll.asked)
    asked[:, 1] = True
    logit = torch.full_like(roll.slots.logit, -50.0)
    logit[:, :, 0] = 50.0
    roll = replace(roll, slot=torch.zeros_like(roll.slot), asked=asked, slots=replace(roll.slots, logit=logit))
    near = replace(roll.truth, uv=roll.of_entities.uv.clone(), visible=torch.ones_like(roll.truth.visible))
    assert slot_confidence_loss(replace(roll, truth=near)) == pytest.approx(0, abs=1e-6)


def test_labels_of_matched_slots_against_a_plain_loop(batch: Batch):
    roll = answer(batch, whole=True)
    expected = [
        -float(roll.slots.label_logits[b, t, roll.slot[b, k]].log_softmax(-1)[roll.truth.label[b, k]])
        for b, t, k in (roll.truth.visible & roll.asked[:, None]).nonzero().tolist()
    ]
    assert float(slot_label_loss(roll)) == pytest.approx(float(np.mean(expected)), rel=1e-4)


def test_entity_i_has_slot_i(batch: Batch):
    network, frames, truth = batch
    with torch.no_grad():
        roll = roll_out(network, frames, truth, whole=True, order="entity")
    assert roll.asked.any()
    for b, k in roll.asked.nonzero().tolist():
        assert (roll.uv[b, :, k] == roll.slots.uv[b, 1:, k]).all()


def test_where_slots_look_is_drawn_to_the_token_of_their_entity(batch: Batch):
    roll = answer(batch, whole=True)
    side = PAPER.encoder.grid
    token = (roll.truth.uv.nan_to_num() * side).long().clamp(0, side - 1) @ torch.tensor([1, side])
    perfect = F.one_hot(token, side**2).float()
    where = torch.full_like(roll.slots.where, 1 / side**2)
    for b, k in roll.asked.nonzero().tolist():
        where[b, :, roll.slot[b, k]] = perfect[b, :, k]
    assert float(where_loss(replace(roll, slots=replace(roll.slots, where=where)))) == pytest.approx(0, abs=1e-4)
    blind = replace(roll.slots, where=torch.full_like(where, 1 / side**2))
    assert float(where_loss(replace(roll, slots=blind))) == pytest.approx(np.log(side**2), rel=1e-3)


def test_earlier_layers_are_drawn_to_the_same_places(batch: Batch):
    roll = answer((make_paper(decoder_layers=3), *batch[1:]), whole=True)
    assert roll.slots.earlier_uv.shape[3:] == (2, 2)
    same = replace(roll, slots=replace(roll.slots, earlier_uv=roll.slots.uv.unsqueeze(-2).repeat(1, 1, 1, 2, 1)))
    assert float(early_loss(same)) == pytest.approx(float(coordinate_loss(roll)), rel=1e-4)


def test_every_loss_is_finite_and_the_gradient_reaches_every_part(batch: Batch):
    network, frames, truth = batch
    values = PaperStageOne(network).losses(frames, truth)
    assert set(values) == set(LOSSES)
    assert all(value.isfinite() for value in values.values())
    assert min(values[name] for name in ("aff", "conf", "label")) > 0
    weighted_sum(values, WEIGHTS).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() and p.grad.any() for p in network.trainable())


def test_nothing_to_learn_from_is_no_nan(batch: Batch):
    network, frames, truth = batch
    dark = replace(frames, depth_m=0 * frames.depth_m)
    nothing = replace(truth, visible=torch.zeros_like(truth.visible), uv=torch.full_like(truth.uv, torch.nan))
    for seen, known in ((dark, truth), (frames, nothing)):
        weighted_sum(PaperStageOne(network).losses(seen, known), WEIGHTS).backward()
        assert all(p.grad.isfinite().all() for p in network.trainable() if p.grad is not None)


def test_a_step_lowers_the_loss_and_a_tiny_set_is_learned_by_heart(batch: Batch):
    network, frames, truth = batch
    network.train().encoder.requires_grad_(False)
    optimizer = torch.optim.AdamW(network.trainable(), lr=5e-3)
    history = []
    for step in range(16):
        optimizer.param_groups[0]["lr"] = 5e-3 if step else 1e-3  # a small step is what lowers the loss for sure
        loss = weighted_sum(PaperStageOne(network).losses(frames, truth), WEIGHTS)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        history.append(float(loss.detach()))
    assert history[1] < history[0]
    assert np.mean(history[-3:]) < 0.7 * history[0]


@pytest.mark.parametrize("accumulate", [1, 3])
def test_the_one_loop_trains_it(sampler: WindowSampler, tmp_path: Path, accumulate: int):
    pytest.importorskip("lightning_fabric")
    pytest.importorskip("tensorboard")
    config = TrainingConfig(
        steps=2, warmup_steps=1, validate_every=2, validation_batches=1, precision="32-true", accumulate=accumulate
    )
    network, reports = make_paper(), list[StepReport]()
    fit(PaperStageOne(network, {"feat": 0.0}), sampler, sampler, config, out=tmp_path / "run", report=reports.append)
    assert [report.step for report in reports] == [1, 2]
    assert all(p.grad is not None for p in network.trainable())
