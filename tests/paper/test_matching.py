"""Which slot answers for which entity."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import linear_sum_assignment

from quest.paper.matching import COORDINATE_WEIGHT, assign_slots, slot_cost

B, T, Q, K = 3, 2, 5, 4


def test_the_cost_against_a_plain_loop():
    torch.manual_seed(0)
    uv, target, p = torch.rand(B, T, Q, 2), torch.rand(B, T, K, 2), torch.rand(B, T, Q, K)
    seen = torch.rand(B, T, K) < 0.6
    target[~seen] = torch.nan
    cost = slot_cost(uv, p, target, seen)
    for b in range(B):
        for k in range(K):
            for q in range(Q):
                expected = sum(
                    COORDINATE_WEIGHT * float((uv[b, t, q] - target[b, t, k]).norm()) - float(p[b, t, q, k])
                    for t in range(T)
                    if seen[b, t, k]
                )
                assert float(cost[b, k, q]) == pytest.approx(expected, abs=1e-5)


def test_labels_decide_between_slots_at_one_place():
    uv, target = torch.full((1, 1, 2, 2), 0.5), torch.full((1, 1, 2, 2), 0.5)
    alike = torch.tensor([[[[0.1, 0.9], [0.8, 0.2]]]])
    seen = torch.ones(1, 1, 2, dtype=torch.bool)
    assert assign_slots(slot_cost(uv, alike, target, seen), seen[:, 0])[0].tolist() == [[1, 0]]


def test_every_entity_that_asks_gets_a_slot_of_its_own():
    torch.manual_seed(0)
    cost = torch.randn(B, K, Q)
    wanted = torch.tensor([[True, True, False, True], [False, False, False, False], [False, True, False, False]])
    slot, matched = assign_slots(cost, wanted)
    assert (matched == wanted).all()
    for b in range(B):
        rows = wanted[b].nonzero().flatten()
        assert slot[b, rows].tolist() == linear_sum_assignment(cost[b, rows].numpy())[1].tolist()
        assert len(set(slot[b, rows].tolist())) == len(rows)
    slot, matched = assign_slots(torch.rand(1, 4, 2), torch.ones(1, 4, dtype=torch.bool))
    assert sorted(slot[matched].tolist()) == [0, 1], "more entities than slots"
    assert (slot[~matched] == 0).all()
