"""What learned slots are taught: one match for all frames, and to say so where there is nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.train.slots import CONFIDENT_PX, SlotAnswers, answer_slots, slot_confidence_loss, slot_label_loss
from quest.train.windows import WindowSampler, WindowTruth
from tests.tiny import PAPER, make_network
from tests.tolerances import LOSS, approx
from tests.train.prepared import make_sampler

Batch = tuple[QuestNetwork, FrameBatch, WindowTruth]


@pytest.fixture(scope="module")
def sampler(tmp_path_factory: pytest.TempPathFactory) -> WindowSampler:
    return make_sampler(tmp_path_factory.mktemp("slots"), make_network(PAPER), batch=3)


@pytest.fixture
def batch(sampler: WindowSampler) -> Batch:
    return make_network(PAPER), *sampler.draw(np.random.default_rng(0), disturb=False)


def answer(batch: Batch, *, whole: bool, **changes: torch.Tensor) -> tuple[SlotAnswers, WindowTruth]:
    network, frames, truth = batch
    truth = replace(truth, **changes)
    with torch.no_grad():
        return answer_slots(network, network.observe(frames), frames, truth, whole=whole), truth


def far(truth: WindowTruth) -> torch.Tensor:
    """Truth that is elsewhere in the window, and as it was at the anchor frame."""
    return torch.cat((truth.uv[:, :1], 1 - truth.uv[:, 1:]), dim=1)


def test_judged_answers_are_matched_by_the_anchor_frame_alone(batch: Batch):
    honest, truth = answer(batch, whole=False)
    lie, _ = answer(batch, whole=False, uv=far(truth), visible=truth.visible.clone())
    assert (honest.slot == lie.slot).all()
    assert (honest.matched == (truth.visible[:, 0] & truth.exists)).all()


def test_training_matches_by_all_frames_together(batch: Batch):
    honest, truth = answer(batch, whole=True)
    # What shows up later is somebody's too: its slot must not be told that there is nothing.
    late = torch.cat((torch.zeros_like(truth.visible[:, :1]), torch.ones_like(truth.visible[:, 1:])), dim=1)
    found, _ = answer(batch, whole=True, visible=late)
    assert (found.matched == truth.exists).all()
    chosen = found.of_entities
    for b, k in truth.exists.nonzero().tolist():
        assert (chosen.uv[b, :, k] == found.prediction.uv[b, :, found.slot[b, k]]).all()
    moved = [answer(batch, whole=True, uv=(truth.uv + 0.2 * n).remainder(1))[0].slot for n in range(5)]
    assert any((slot != honest.slot).any() for slot in moved)


def test_entities_that_are_left_out_of_queries_keep_their_slots(batch: Batch):
    whole, truth = answer(batch, whole=True)
    dropped, _ = answer(batch, whole=True, bound=torch.zeros_like(truth.bound))
    assert (whole.matched == dropped.matched).all()


@pytest.mark.parametrize("near", [False, True])
def test_confidence_of_all_slots_against_a_plain_loop(batch: Batch, near: bool):
    answers, truth = answer(batch, whole=True)
    if near:
        truth = replace(truth, uv=answers.of_entities.uv + 4 / 64)
    logit = answers.prediction.right_logit
    b, s, q = logit.shape
    target = torch.zeros(b, s, q)
    for i, t, k in (truth.visible & answers.matched[:, None]).nonzero().tolist():
        slot = int(answers.slot[i, k])
        gap = float((answers.prediction.uv[i, t, slot] - truth.uv[i, t, k]).norm()) * 64
        target[i, t, slot] = gap < CONFIDENT_PX
    assert target.any() or not near
    expected = F.binary_cross_entropy_with_logits(logit, target)
    assert float(slot_confidence_loss(answers, truth, image_size=64)) == approx(float(expected), LOSS)


def test_unmatched_slots_learn_that_there_is_nothing(batch: Batch):
    network, frames, truth = batch
    answers = answer_slots(network, network.observe(frames), frames, truth, whole=True)
    logit = answers.prediction.right_logit
    logit.retain_grad()
    slot_confidence_loss(answers, truth, image_size=64).backward()
    assert logit.grad is not None
    for b in range(len(logit)):
        others = [q for q in range(PAPER.slots) if q not in answers.slot[b, answers.matched[b]].tolist()]
        assert others
        assert (logit.grad[b, :, others] > 0).all()


def test_an_entity_without_a_slot_says_nothing_of_slot_0(batch: Batch):
    answers, truth = answer(batch, whole=True)
    answers = replace(answers, slot=torch.zeros_like(answers.slot), matched=torch.zeros_like(answers.matched))
    answers.matched[:, 1] = True
    near = replace(truth, uv=answers.of_entities.uv.clone(), visible=torch.ones_like(truth.visible))
    logit = torch.full_like(answers.prediction.right_logit, -50.0)
    logit[:, :, 0] = 50.0
    sure = replace(answers, prediction=replace(answers.prediction, right_logit=logit))
    assert slot_confidence_loss(sure, near, image_size=64) == approx(0, LOSS)


def test_labels_of_matched_slots_against_a_plain_loop(batch: Batch):
    answers, truth = answer(batch, whole=True)
    expected = [
        -float(answers.label_logits[b, t, answers.slot[b, k]].log_softmax(-1)[truth.label[b, k]])
        for b, t, k in (truth.visible & answers.matched[:, None]).nonzero().tolist()
    ]
    assert float(slot_label_loss(answers, truth)) == approx(float(np.mean(expected)), LOSS)
