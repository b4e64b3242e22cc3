"""The flow head: shapes, what is missing, and that only weights with one have one."""

from __future__ import annotations

import pytest
import torch

from quest.paper.flow_head import REST, FlowHead
from tests.paper.tiny import PAPER, make_paper


def embeddings(*, frames: int = 4) -> torch.Tensor:
    return torch.randn(2, frames, 3, PAPER.width, generator=torch.Generator().manual_seed(0))


def lively() -> FlowHead:
    """A head whose last layer says something."""
    head = make_paper(flow=True).flow
    assert head is not None
    return head


def test_it_starts_by_saying_that_nothing_moves():
    assert (FlowHead(PAPER.width, window=PAPER.window)(embeddings()) == 0).all()


def test_one_displacement_per_query():
    flow = lively()(embeddings())
    assert flow.shape == (2, 3, 3)
    assert flow.isfinite().all()
    assert (flow != 0).any()


def test_what_hardly_moves_rests():
    """Each query by itself, and not while the head learns."""
    head, embedding = lively(), embeddings()
    length = head.train()(embedding).norm(dim=-1)
    with torch.no_grad():
        final = head.out[-1]
        assert isinstance(final, torch.nn.Linear)
        shrink = REST / length.median()
        final.weight *= shrink
        final.bias *= shrink
    raw, settled = head(embedding), head.eval()(embedding)
    still = raw.norm(dim=-1) < REST
    assert still.any()
    assert not still.all()
    assert (settled[still] == 0).all()
    assert (settled[~still] == raw[~still]).all()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_before_there_are_enough_frames_the_oldest_stands_for_them(frames: int):
    embedding, head = embeddings(frames=frames), lively()
    repeated = torch.cat((embedding[:, :1].expand(-1, 4 - frames, -1, -1), embedding), dim=1)
    torch.testing.assert_close(head(embedding), head(repeated))


def test_queries_do_not_know_of_each_other():
    embedding, head, order = embeddings(), lively(), torch.tensor([2, 0, 1])
    torch.testing.assert_close(head(embedding[:, :, order]), head(embedding)[:, order])
