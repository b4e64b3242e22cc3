"""Relief against a plain loop."""

from __future__ import annotations

import pytest
import torch

from quest.model.relief import relief

RADII_PX = (5, 14)


def test_relief_against_a_plain_loop():
    torch.manual_seed(0)
    depth = 0.5 + torch.rand(2, 20, 17)
    depth[torch.rand(depth.shape) < 0.2] = 0
    found = relief(depth, RADII_PX)
    assert found.shape == (2, 2, 20, 17)
    for b, y, x in ((0, 10, 8), (1, 0, 0), (0, 19, 3), (1, 7, 16), (1, 11, 2)):
        for n, radius in enumerate(RADII_PX):
            if depth[b, y, x] == 0:
                assert found[b, n, y, x] == 0
                continue
            around = depth[b, max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            mean_m = 1 / float((1 / around[around > 0]).mean())
            expected = torch.tensor(20 * (mean_m - float(depth[b, y, x]))).tanh()
            assert float(found[b, n, y, x]) == pytest.approx(float(expected), abs=1e-4)


def test_planes_have_no_relief_and_what_stands_out_has():
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(60.0), indexing="ij")
    depth = 1 / (0.8 + 0.003 * x - 0.002 * y)[None]
    flat = relief(depth, RADII_PX)
    assert flat[..., 14:-14, 14:-14].abs().max() < 1e-3
    depth[:, 28:31, 20:40] -= 0.02
    raised = relief(depth, RADII_PX)
    assert (raised[0, :, 29, 22:38] > 0.2).all()
    assert relief(torch.zeros(1, 9, 9), RADII_PX).abs().max() == 0
