"""Which entities candidates are right about."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from quest.baselines.clip_frames import ClipFrames
from quest.data.mirror import mirror_take
from quest.model.affordance import AffordanceMap
from quest.model.discovery import Candidates, Peaks, _mirrored, find_peaks, match_peaks
from quest.model.observation import FrameBatch, Observation
from quest.types import LABELS, Take
from tests.synthetic import make_take
from tests.tiny import make_frames, make_network
from tests.tolerances import NETWORK


def see(take: Take, t: int) -> tuple[FrameBatch, Observation]:
    frames = ClipFrames(make_network(), take.views[0].clip, device=torch.device("cpu"))
    with torch.no_grad():
        return frames.see(t)


def test_a_mirrored_frame_is_a_frame_of_the_mirrored_take():
    take = make_take(frames=6, views=1, size=(64, 64))
    with torch.no_grad():
        got, expected = _mirrored(make_network(), see(take, 5)[0]), see(mirror_take(take), 5)[0]
    for f in fields(FrameBatch):
        if f.name != "enlarged":
            torch.testing.assert_close(getattr(got, f.name), getattr(expected, f.name), **NETWORK)


def test_in_the_mirror_image_the_mirrored_peaks_are_found():
    take, network = make_take(frames=6, views=1, size=(64, 64)), make_network()
    with torch.no_grad():
        one, other = (find_peaks(network, *see(t, 5), radius_cells=1.5) for t in (take, mirror_take(take)))
        plain = find_peaks(network, *see(take, 5), radius_cells=1.5, mirror=False)
    torch.testing.assert_close(
        one.uv, torch.tensor([1.0, 0.0]) + other.uv * torch.tensor([-1.0, 1.0]), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(one.logit, other.logit, atol=1e-3, rtol=0)
    assert one.logit[0] != plain.logit[0]


def test_a_rim_is_where_the_cells_along_it_point_to_in_the_mean():
    network, frames = make_network(), make_frames(batch=1, frames=1)
    logits, offset = torch.full((1, 1, 64, len(LABELS), 2), -9.0), torch.zeros(1, 1, 64, 2, 2)
    for cell, score, x in ((24, 3.0, 1.0), (25, 2.4, 0.3), (26, 2.1, 0.2), (27, 1.5, 0.0), (31, 2.5, 0.0)):
        logits[..., cell, [LABELS.index("rim"), LABELS.index("handle")], 0] = score
        offset[..., cell, 0, 0] = x
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "afford", lambda *_: AffordanceMap(logits, offset))
        peaks = find_peaks(network, frames, network.observe(frames), radius_cells=0.1, mirror=False)
    found = {LABELS[int(n)]: uv for n, uv in zip(peaks.label.flip(0), peaks.uv.flip(0), strict=True)}
    # Row 3 of 8: cells 0, 1, 2 point to 12, 14.4 and 21.6 px; cell 3 is 1.5 below the best, cell 7 points 48 px away.
    assert found["rim"].tolist() == pytest.approx([(12 + 14.4 + 21.6) / 3 / 64, 28 / 64])
    assert found["handle"].tolist() == pytest.approx([12 / 64, 28 / 64])


def test_of_clashing_candidates_of_one_label_the_best_of_those_that_count_stays():
    clash = torch.eye(4, dtype=torch.bool)
    clash[0, 1] = clash[1, 0] = clash[1, 2] = clash[2, 1] = clash[2, 3] = clash[3, 2] = True
    found = Candidates(
        Peaks(torch.rand(4, 2), torch.rand(4, 3), torch.tensor([2, 2, 2, 1]), torch.arange(4.0), torch.zeros(4).long()),
        clash,
    )
    assert found.apart() == [0, 2, 3], "what is of another label may be at the same place"
    assert found.apart([1, 2, 3]) == [1, 3]
    assert found.apart([]) == []
    assert found.peaks.select(found.apart()).label.tolist() == [2, 2, 1]
    assert len(found.peaks.select([])) == 0


def test_each_entity_is_found_once_by_the_best_near_candidate_of_its_label():
    point = torch.tensor([[0.10, 0.1, 1], [0.12, 0.1, 1], [0.13, 0.1, 1], [0.6, 0.6, 1], [0.4, 0.4, 1]])
    label = torch.tensor([0, 0, 1, 0, 1])
    true = torch.tensor([[0.14, 0.1, 1], [0.4, 0.4, 1.101], [0.21, 0.1, 1]])
    true_label = torch.tensor([0, 1, 0])
    # The second is left the farther entity; no entity of its label is within 0.1 of the others.
    assert match_peaks(point, label, true, true_label, half_diagonal_m=1.0).tolist() == [0, 2, -1, -1, -1]
    nearer = true.clone()
    nearer[1, 2] = 1.099
    assert match_peaks(point, label, nearer, true_label, half_diagonal_m=1.0).tolist() == [0, 2, -1, -1, 1]
    assert match_peaks(point, label, true, true_label, half_diagonal_m=1.1).tolist() == [0, 2, -1, -1, 1]
    assert match_peaks(point, label, nearer, true_label, half_diagonal_m=0.3).tolist() == [-1, 0, -1, -1, -1]


def test_a_candidate_without_depth_is_right_about_nothing():
    point = torch.tensor([[torch.nan] * 3, [0.0, 0.0, 1.0]])
    label = torch.zeros(2, dtype=torch.long)
    assert match_peaks(point, label, point[1:], label[:1], half_diagonal_m=1.0).tolist() == [-1, 0]


def test_nothing_seen_is_nothing_found():
    some = torch.zeros(2, 3), torch.zeros(2, dtype=torch.long)
    nothing = torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)
    assert match_peaks(*some, *nothing, half_diagonal_m=1.0).tolist() == [-1, -1]
    assert match_peaks(*nothing, *some, half_diagonal_m=1.0).tolist() == []
