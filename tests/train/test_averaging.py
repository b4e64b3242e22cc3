"""The running mean of the weights."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from quest.train.optimizer import RunningMean


def learner(decay: float) -> tuple[nn.Parameter, RunningMean]:
    parameter = nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.AdamW([parameter])
    return parameter, RunningMean([parameter], optimizer, decay)


def walk(parameter: nn.Parameter, mean: RunningMean, values: list[float]) -> None:
    for step, value in enumerate(values, start=1):
        with torch.no_grad():
            parameter.fill_(value)
        mean.update(step)


@pytest.mark.parametrize(
    ("decay", "expected"),
    [
        (0.0, 4.0),
        (0.1, 0.1 * (0.1 * 1 + 0.9 * 2) + 0.9 * 4),
        # Young means forget faster: the second step keeps 2 / 11 and the third 3 / 12.
        (0.9, 0.25 * (2 / 11 * 1 + 9 / 11 * 2) + 0.75 * 4),
    ],
)
def test_the_mean_forgets_exponentially(decay: float, expected: float) -> None:
    parameter, mean = learner(decay)
    walk(parameter, mean, [1.0, 2.0, 4.0])
    with mean.applied():
        assert parameter.tolist() == pytest.approx([expected] * 3)
    assert parameter.tolist() == [4.0] * 3


def test_parameters_come_back_after_an_error() -> None:
    parameter, mean = learner(0.9)
    walk(parameter, mean, [1.0, 5.0])

    def interrupted() -> None:
        with mean.applied():
            assert parameter[0] != 5
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert parameter.tolist() == [5.0] * 3


def test_what_was_never_learned_has_no_mean() -> None:
    parameter, mean = learner(0.9)
    with mean.applied():
        assert parameter.tolist() == [0.0] * 3
