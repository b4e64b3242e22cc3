"""Pieces as candidates: where they lie, what clashes with them, and how scores become log odds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from quest.model.affordance import AffordanceMap
from quest.model.discovery import Candidates, find_candidates, sight
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.model.pieces import PieceHead, groups
from quest.types import GRIPS, INTENTS, LABELS
from tests.tiny import DEFAULT, make_frames, make_network

HANDLE, KNOB, RIM = (LABELS.index(label) for label in ("handle", "knob", "rim"))
SIZE = DEFAULT.encoder.image_size


def ranking_network() -> QuestNetwork:
    return make_network(replace(DEFAULT, pieces=True, intents=True))


def front(*, depth_m: float = 1.0) -> FrameBatch:
    """A front with a bar across it, from column 10 to 54 in rows 30 to 33."""
    frames = make_frames(batch=1, frames=1)
    frames.depth_m[:] = depth_m
    frames.depth_m[..., 30:34, 10:54] -= 0.05 * depth_m
    frames.scale[:] = 1.0
    return frames


def see(network: QuestNetwork, frames: FrameBatch, peaks: dict[tuple[int, int], float]) -> Candidates:
    """Candidates where the map has peaks of that score at (cell, label)."""
    logits = torch.full((1, 1, 64, len(LABELS), len(INTENTS)), -9.0)
    for (cell, label), score in peaks.items():
        logits[..., cell, label, 0] = score
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "afford", lambda *_: AffordanceMap(logits, torch.zeros(1, 1, 64, len(INTENTS), 2)))
        return find_candidates(network, frames, network.observe(frames), radius_cells=0.5, mirror=False)


def test_a_piece_lies_in_its_middle_and_peaks_on_it_clash_with_it():
    network = ranking_network()
    found = see(network, front(), {(25, HANDLE): 3.0, (30, HANDLE): 2.0, (4, RIM): 1.0})
    peaks, clash = found.peaks, found.clash
    assert (peaks.logit.diff() <= 0).all(), "best first"
    assert torch.equal(clash, clash.T)
    places = (peaks.uv * SIZE).round().tolist()
    piece = [
        i for i, (x, y) in enumerate(places) if 31 <= x <= 33 and 30 <= y <= 34 and peaks.label[i] in (HANDLE, KNOB)
    ]
    assert sorted(peaks.label[piece].tolist()) == [HANDLE, KNOB]
    ends = [i for i, place in enumerate(places) if place in ([12, 28], [52, 28]) and peaks.label[i] == HANDLE]
    assert len(ends) == 2
    assert all(clash[i, j] for i in piece for j in [*piece, *ends])
    assert not any(clash[i, j] for i in piece for j in range(len(peaks)) if places[j] == [36, 4])
    handles = set(found.apart()) & {i for i in (*piece, *ends) if peaks.label[i] == HANDLE}
    assert len(handles) == (1 if handles & {*piece} else 2)


def test_without_depth_candidates_are_the_peaks_alone():
    network, frames = ranking_network(), front()
    frames.depth_m[:] = 0.0
    found = see(network, frames, {(25, HANDLE): 3.0, (4, RIM): 1.0})
    plain = see(make_network(replace(DEFAULT, intents=True)), frames, {(25, HANDLE): 3.0, (4, RIM): 1.0})
    assert len(found.peaks) == len(plain.peaks)
    torch.testing.assert_close(found.peaks.uv, plain.peaks.uv)


def test_the_best_score_on_a_piece_counts_whatever_its_purpose():
    network, frames = ranking_network(), front()
    logits = torch.full((1, 1, 64, len(LABELS), len(INTENTS)), -9.0)
    logits[..., 27, HANDLE, 1], logits[..., 28, HANDLE, 0], logits[..., 60, HANDLE, 0] = 2.0, 1.0, 5.0
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "afford", lambda *_: AffordanceMap(logits, torch.zeros(1, 1, 64, len(INTENTS), 2)))
        sighted = sight(network, frames, network.observe(frames), radius_cells=1.5, mirror=False)
    (bar,) = [p for p, shape in enumerate(sighted.pieces.shapes) if len(shape.rows) > 100]
    assert sighted.pieces.inputs[bar, -len(GRIPS) :].tolist() == [2.0, -9.0]
    assert sighted.pieces.purpose[bar, 0] == 1


def test_peaks_are_trusted_by_label_depth_and_what_is_under_them():
    frames = front()
    frames.depth_m[..., :, 40:] = 0.0
    uv_px = torch.tensor([[12.0, 32.0], [12.0, 60.0], [60.0, 32.0], [60.0, 32.0]])
    label, on = torch.tensor([HANDLE, HANDLE, KNOB, RIM]), torch.tensor([True, False, False, False])
    group = groups(frames, uv_px, label, on).tolist()
    assert group == [len(LABELS), HANDLE, len(LABELS) + 1, RIM]


def test_log_odds_of_a_piece_leave_room_for_nothing():
    head = PieceHead()
    inputs = torch.randn(5, len(head.mean))
    with torch.no_grad():
        chance = head.classify(inputs).softmax(dim=-1)
        torch.testing.assert_close(head(inputs).sigmoid(), chance[:, 1:])
        group = torch.zeros(5, dtype=torch.long)
        torch.testing.assert_close(head.trust(inputs[:, 0], group), inputs[:, 0])
        assert head(inputs[:0]).shape == (0, 2)
