"""The training loop: resuming, stopping, and the loss curve."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from quest.errors import ConfigError, WeightsError
from quest.model.config import NetworkConfig
from quest.model.network import QuestNetwork
from quest.train import loop
from quest.train.checkpoint import load_checkpoint
from quest.train.loop import StepReport, fit
from quest.train.settings import LossWeights, TrainingConfig
from quest.train.validation import WindowScores, validate
from quest.train.windows import WindowSampler
from tests.tiny import DEFAULT, PAPER, make_network
from tests.train.prepared import make_sampler

pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

SHORT = TrainingConfig(
    steps=4, warmup_steps=2, learning_rate=1e-3, validate_every=2, validation_batches=1, precision="32-true"
)

GOLDEN_LOSSES = (18.76897, 19.05974, 14.38138, 14.94760)
"""Of four steps of SHORT from make_network(): a change here is a change of the losses, the sampler or the network."""


@pytest.fixture(scope="module")
def samplers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, WindowSampler]:
    return {
        c.preset: make_sampler(tmp_path_factory.mktemp(c.preset), make_network(c), batch=2) for c in (DEFAULT, PAPER)
    }


Run = Callable[..., tuple[QuestNetwork, list[StepReport]]]


@pytest.fixture
def run(samplers: dict[str, WindowSampler], tmp_path: Path) -> Run:
    """Trains into a folder of ``tmp_path``; the same network at every call."""

    def go(
        config: TrainingConfig = SHORT,
        *,
        out: str = "run",
        network: NetworkConfig = DEFAULT,
        weights: LossWeights | None = None,
    ) -> tuple[QuestNetwork, list[StepReport]]:
        net, reports, sampler = make_network(network), [], samplers[network.preset]
        fit(net, sampler, sampler, config, weights or LossWeights(), out=tmp_path / out, report=reports.append)
        return net, reports

    return go


def weights_of(network: QuestNetwork) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in network.state_dict().items()}


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=lambda c: c.preset)
def test_both_presets_train(run: Run, tmp_path: Path, config: NetworkConfig, precision: str):
    before = weights_of(make_network(config))
    network, reports = run(replace(SHORT, steps=2, precision=precision), network=config)
    assert [r.step for r in reports] == [1, 2]
    after = weights_of(network)
    assert all(torch.equal(after[n], before[n]) for n in after if n.startswith("encoder."))
    assert any(not torch.equal(after[n], before[n]) for n in after)
    assert load_checkpoint(tmp_path / "run" / "best", network, None).step == 2
    assert list((tmp_path / "run" / "curves").iterdir())


def test_golden_loss_curve(run: Run):
    _, reports = run()
    assert [r.loss for r in reports] == pytest.approx(GOLDEN_LOSSES, rel=2e-3)


def test_resuming_is_as_if_never_interrupted(run: Run):
    straight, reports = run(out="straight")
    # The second half knows only what is on disk: killed after step 2 of 4.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "_log", killed_at(3))
        with pytest.raises(KeyboardInterrupt):
            run(out="halves")
    resumed, rest = run(out="halves")
    assert [r.step for r in rest] == [3, 4]
    assert [r.loss for r in rest] == [r.loss for r in reports[2:]]
    assert [r.best for r in rest] == [r.best for r in reports[2:]]
    for name, tensor in weights_of(straight).items():
        assert torch.equal(resumed.state_dict()[name], tensor), name


def killed_at(step: int) -> Callable[..., None]:
    def log(writer: object, terms: object, loss: object, at: int) -> None:
        if at == step:
            raise KeyboardInterrupt

    return log


def test_a_finished_run_stays_as_it_is(run: Run, tmp_path: Path):
    run()
    before = (tmp_path / "run" / "last" / "weights.safetensors").read_bytes()
    _, reports = run()
    assert reports == []
    assert (tmp_path / "run" / "last" / "weights.safetensors").read_bytes() == before


def test_a_run_of_another_network_is_not_resumed(run: Run):
    run(replace(SHORT, steps=1))
    with pytest.raises(WeightsError):
        run(network=replace(DEFAULT, slots=7))
    with pytest.raises(WeightsError):
        run(network=PAPER)


@pytest.mark.parametrize(
    ("scores", "best_step", "stopped"),
    [([0.5, 0.6, 0.5, 0.4], 1, 3), ([0.5, 0.4, 0.6, 0.7], 2, 4), ([float("nan")] * 4, 1, 3)],
)
def test_patience(run: Run, tmp_path: Path, monkeypatch, scores: list[float], best_step: int, stopped: int):
    """Training stops after two validations without a better score, and there is a best checkpoint whatever happens."""
    left = iter(scores)
    monkeypatch.setattr(loop, "validate", lambda *_, **__: WindowScores(1.0, next(left), 0.5, 0.5, 1))
    config = replace(SHORT, steps=9, validate_every=1, patience=2)
    network, reports = run(config)
    assert reports[-1].step == stopped
    assert load_checkpoint(tmp_path / "run" / "best", network, None).step == best_step
    assert run(config)[1] == [], "a run that has stopped stays stopped"


def test_a_loss_that_explodes_is_an_error(run: Run):
    with pytest.raises(ConfigError, match="learning rate"):
        run(weights=replace(LossWeights(), aff=float("inf")))


def test_schedule():
    config = TrainingConfig(steps=100, warmup_steps=10)
    rates = [loop._schedule(step, config) for step in range(1, 101)]
    assert rates[:10] == pytest.approx([s / 10 for s in range(1, 11)])
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(0.05)


@pytest.mark.parametrize("changes", [{"steps": 0}, {"patience": 0}, {"precision": "16"}, {"validate_every": 0}])
def test_settings_out_of_range(changes: dict):
    with pytest.raises(ConfigError):
        replace(SHORT, **changes)


@pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=lambda c: c.preset)
def test_validation_is_the_same_at_every_call(samplers: dict[str, WindowSampler], config: NetworkConfig):
    network = make_network(config)
    one, two = (validate(network, samplers[config.preset], batches=2, device=torch.device("cpu")) for _ in range(2))
    assert one == two
    assert one.answers > 0
    assert 0 <= one.mean_distance <= 1
    assert 0 <= one.right <= 1
    assert 0 <= one.discovery_f1 <= 1
