"""Means of a divided batch."""

from __future__ import annotations

import pytest
import torch

from quest.train.losses import masked_mean
from quest.train.pooling import Tally, pooled, pooling

VALUE = torch.tensor([1.0, 2.0, 4.0, 8.0])
MASK = torch.tensor([True, False, True, True])


def test_outside_a_part_is_the_whole():
    assert pooled(torch.tensor(3.0)) == 3.0
    assert masked_mean(VALUE, MASK) == pytest.approx(13 / 3)


def test_micro_batches_add_up():
    """To the mean over all, in value and gradient, although the parts have different counts."""
    value = VALUE.clone().requires_grad_()
    masked_mean(value, MASK).backward()
    whole = value.grad
    value = VALUE.clone().requires_grad_()
    tally, parts = Tally(), [slice(0, 1), slice(1, 4)]
    for part in parts:
        tally.restart()
        with pooling(tally.add), torch.no_grad():
            masked_mean(value[part], MASK[part])
            masked_mean(2 * value[part], ~MASK[part])
    total = torch.zeros(2)
    for part in parts:
        tally.restart()
        with pooling(tally.read):
            shares = [masked_mean(value[part], MASK[part]), masked_mean(2 * value[part], ~MASK[part])]
        shares[0].backward()
        total += torch.stack(shares).detach()
    assert total.tolist() == pytest.approx([13 / 3, 4.0])
    assert value.grad is not None
    assert whole is not None
    torch.testing.assert_close(value.grad, whole)


def test_processes_are_asked_once():
    tally, calls = Tally(), []

    def twice(counts: torch.Tensor) -> torch.Tensor:
        calls.append(counts)
        return 2 * counts

    tally.add(torch.tensor(1.0))
    tally.add(torch.tensor(5.0))
    tally.sum_over(twice)
    tally.restart()
    assert [float(tally.read(torch.tensor(0.0))) for _ in range(2)] == [2.0, 10.0]
    assert len(calls) == 1


def test_pooling_ends_with_an_error():
    with pytest.raises(KeyError), pooling(lambda count: count * 2):
        raise KeyError
    assert pooled(torch.tensor(3.0)) == 3.0
