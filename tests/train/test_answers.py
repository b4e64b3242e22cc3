"""Which answers are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from quest.train.answers import is_right
from tests.paper.tiny import make_paper
from tests.train.prepared import make_sampler


def test_is_right_against_a_plain_loop(tmp_path: Path):
    _, truth = make_sampler(tmp_path, make_paper(), batch=3).draw(np.random.default_rng(0), disturb=False)
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


def test_where_nothing_is_lifted_pixels_decide(tmp_path: Path):
    """And an answer for what is behind the camera is wrong, as it has no pixel."""
    _, truth = make_sampler(tmp_path, make_paper(), batch=3).draw(np.random.default_rng(0), disturb=False)
    point = torch.full_like(truth.point[:, 1:], torch.nan)
    px = torch.full(point.shape[:3], 7.9)
    px[:, 1], px[:, 2] = 8.1, torch.nan
    right = is_right(point, truth, px)
    assert right[:, 0].all()
    assert not right[:, 1:3].any()
