"""The optimiser, what it does with which parameters, and the running mean of the weights."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from quest.errors import ConfigError
from quest.train.optimizer import SHARE, Muon, RunningMean, make_optimizer
from quest.train.settings import TrainingConfig

CONFIG = TrainingConfig(learning_rate=1e-2)


class Small(nn.Module):
    """A matrix inside, one that maps to a handful of numbers, a table, a bias, and a matrix that is not trained."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.inner = nn.Linear(64, 96)
        self.out = nn.Linear(96, 3)
        self.table = nn.Parameter(torch.randn(100, 64))
        self.fixed = nn.Linear(64, 64)
        self.kept: dict | None = None

    def trained(self) -> list[nn.Parameter]:
        return [p for name, p in self.named_parameters() if not name.startswith("fixed")]

    def learn(self, optimizer: torch.optim.Optimizer, steps: int = 1) -> None:
        for _ in range(steps):
            optimizer.zero_grad()
            (self.out(self.inner(self.table).tanh()) - 1).square().mean().backward()
            optimizer.step()


def test_every_trained_parameter_is_in_one_group_and_nothing_else_is() -> None:
    network = Small()
    rest, inner = make_optimizer(network, network.trained(), CONFIG).param_groups
    assert [id(p) for p in inner["params"]] == [id(network.inner.weight)]
    assert {id(p) for p in rest["params"]} == {id(p) for p in network.trained()} - {id(network.inner.weight)}
    assert rest["lr"] == inner["lr"] == CONFIG.learning_rate
    assert rest["weight_decay"] == inner["weight_decay"] == CONFIG.weight_decay


def test_a_step_of_an_inner_matrix_turns_all_its_directions_alike() -> None:
    network = Small()
    before, fixed = network.inner.weight.detach().clone(), network.fixed.weight.detach().clone()
    network.learn(make_optimizer(network, network.trained(), replace(CONFIG, weight_decay=0.0)))
    strengths = torch.linalg.svdvals(before - network.inner.weight.detach())
    # Of a gradient of rank 3 there are three directions; with AdamW the first would be far the strongest.
    assert strengths[2] > 0.5 * strengths[0]
    assert torch.equal(network.fixed.weight, fixed)


@pytest.mark.parametrize("fast", [True, False])
def test_a_step_of_muon_is_that_of_torch(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """To the bit where bfloat16 is fast, and but for its rounding where products are in float32."""
    monkeypatch.setattr("quest.train.optimizer.fast_bfloat16", lambda device: fast)
    one, other = Small(), Small()
    one.learn(Muon([one.inner.weight]), steps=3)
    other.learn(torch.optim.Muon([other.inner.weight], adjust_lr_fn="match_rms_adamw"), steps=3)
    steps = [n.inner.weight - Small().inner.weight for n in (one, other)]
    assert torch.linalg.norm(steps[0] - steps[1]) <= (0 if fast else 0.05) * torch.linalg.norm(steps[1])


def test_adamw_alone_is_that_of_torch() -> None:
    one, other = Small(), Small()
    one.learn(make_optimizer(one, one.trained(), replace(CONFIG, optimizer="adamw")), steps=3)
    same = {"lr": CONFIG.learning_rate, "weight_decay": CONFIG.weight_decay, "fused": True}
    other.learn(torch.optim.AdamW(other.trained(), **same), steps=3)
    assert all(torch.equal(p, q) for p, q in zip(one.parameters(), other.parameters(), strict=True))


def test_what_has_no_inner_matrix_is_left_to_adamw() -> None:
    network = Small()
    assert isinstance(make_optimizer(network, [network.table], CONFIG), torch.optim.AdamW)


def test_a_state_that_is_loaded_goes_on() -> None:
    straight, halves = Small(), Small()
    straight.learn(make_optimizer(straight, straight.trained(), CONFIG), steps=4)
    for _ in range(2):
        optimizer = make_optimizer(halves, halves.trained(), CONFIG)
        if halves.kept is not None:
            optimizer.load_state_dict(halves.kept)
        halves.learn(optimizer, steps=2)
        halves.kept = optimizer.state_dict()
    assert all(torch.equal(p, q) for p, q in zip(straight.parameters(), halves.parameters(), strict=True))


def test_another_optimizer_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"sgd|Literal"):
        replace(CONFIG, optimizer="sgd")


def test_what_is_refined_learns_at_its_share_of_the_rate_by_adamw() -> None:
    network = Small()
    rest, slow = make_optimizer(
        network, network.trained(), CONFIG, refined=list(network.inner.parameters())[:1]
    ).param_groups
    assert [id(p) for p in slow["params"]] == [id(network.inner.weight)]
    assert (rest[SHARE], slow[SHARE]) == (1, CONFIG.refined_rate)


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
    parameter = nn.Parameter(torch.zeros(3))
    mean = RunningMean([parameter], torch.optim.AdamW([parameter]), decay)
    with mean.applied():
        assert parameter.tolist() == [0.0] * 3, "what was never learned has no mean"
    for step, value in enumerate((1.0, 2.0, 4.0), start=1):
        with torch.no_grad():
            parameter.fill_(value)
        mean.update(step)

    def interrupted() -> None:
        with mean.applied():
            assert parameter.tolist() == pytest.approx([expected] * 3)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert parameter.tolist() == [4.0] * 3, "the weights come back, also after an error"
