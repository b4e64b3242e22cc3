"""Which entities candidates are right about."""

from __future__ import annotations

import torch

from quest.model.discovery import match_peaks


def test_each_entity_is_found_once_by_the_best_near_candidate_of_its_label():
    uv_px = torch.tensor([[10.0, 10.0], [12.0, 10.0], [13.0, 10.0], [60.0, 60.0], [40.0, 40.0]])
    label = torch.tensor([0, 0, 1, 0, 1])
    true_px, true_label = torch.tensor([[14.0, 10.0], [40.0, 56.1], [26.0, 10.0]]), torch.tensor([0, 1, 0])
    # The second is left the farther entity; no entity of its label is within 16 px of the others.
    assert match_peaks(uv_px, label, true_px, true_label).tolist() == [0, 2, -1, -1, -1]
    nearer = true_px.clone()
    nearer[1, 1] = 55.9
    assert match_peaks(uv_px, label, nearer, true_label).tolist() == [0, 2, -1, -1, 1]


def test_nothing_seen_is_nothing_found():
    uv_px, label = torch.zeros(2, 2), torch.zeros(2, dtype=torch.long)
    nothing = torch.zeros(0, 2), torch.zeros(0, dtype=torch.long)
    assert match_peaks(uv_px, label, *nothing).tolist() == [-1, -1]
    assert match_peaks(*nothing, uv_px, label).tolist() == []
