"""The training loop: resuming, stopping, and the loss curve."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from quest.errors import ConfigError, WeightsError
from quest.model.frames import FrameBatch
from quest.paper.network import PaperConfig, PaperNetwork
from quest.paper.objective import PaperStageOne
from quest.train import loop
from quest.train.batches import Batch
from quest.train.checkpoint import load_checkpoint
from quest.train.loop import StepReport, fit
from quest.train.settings import TrainingConfig
from quest.train.validation import WindowScores
from quest.train.windows import WindowSampler, WindowTruth
from tests.paper.tiny import PAPER, make_paper
from tests.tolerances import TRAINED, approx
from tests.train.prepared import make_sampler

pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

SHORT = TrainingConfig(
    steps=4, warmup_steps=2, learning_rate=1e-3, validate_every=2, validation_batches=1, precision="32-true"
)

GOLDEN_LOSSES = (2.54754, 2.30203, 2.51292, 2.59650)
"""Of four steps of SHORT from make_paper(): a change here is one of losses, sampler, optimiser or network."""


@pytest.fixture(scope="module")
def sampler(tmp_path_factory: pytest.TempPathFactory) -> WindowSampler:
    return make_sampler(tmp_path_factory.mktemp("loop"), make_paper(), batch=2)


Run = Callable[..., tuple[PaperNetwork, list[StepReport]]]


@pytest.fixture
def run(sampler: WindowSampler, tmp_path: Path) -> Run:
    """Trains into a folder of ``tmp_path``; the same network at every call."""

    def go(
        config: TrainingConfig = SHORT,
        *,
        out: str = "run",
        network: PaperConfig = PAPER,
        weights: dict[str, float] | None = None,
        objective: type[PaperStageOne] = PaperStageOne,
    ) -> tuple[PaperNetwork, list[StepReport]]:
        net, reports = make_paper(network), []
        learned = objective(net, weights)
        fit(learned, sampler, sampler, config, out=tmp_path / out, report=reports.append)
        return net, reports

    return go


def weights_of(network: PaperNetwork) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in network.state_dict().items()}


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_it_trains(run: Run, tmp_path: Path, precision: str):
    before = weights_of(make_paper())
    network, reports = run(replace(SHORT, steps=2, precision=precision))
    assert [r.step for r in reports] == [1, 2]
    after = weights_of(network)
    assert all(torch.equal(after[n], before[n]) for n in after if n.startswith("encoder."))
    assert any(not torch.equal(after[n], before[n]) for n in after)
    assert all(p.grad is not None for p in network.trainable()), "DDP waits for the gradient of every parameter"
    assert load_checkpoint(tmp_path / "run" / "best", network, None).step == 2
    assert list((tmp_path / "run" / "curves").iterdir())


def test_golden_loss_curve(run: Run):
    _, reports = run()
    assert [r.loss for r in reports] == pytest.approx(GOLDEN_LOSSES, rel=2e-3)


@pytest.mark.parametrize(("checkpoint_every", "lost"), [(100, (3, 4)), (1, (4,))])
def test_resuming_is_as_if_never_interrupted(run: Run, checkpoint_every: int, lost: tuple[int, ...]):
    """Windows, generators and optimiser go on: killed in step 4, after the validation of step 2."""
    config = replace(SHORT, checkpoint_every=checkpoint_every, deterministic=True)
    torch.manual_seed(5)
    straight, reports = run(config, out="straight", objective=Noisy)
    torch.manual_seed(5)
    # The second half knows only what is on disk.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop._Learner, "learn", killed_at(4))
        with pytest.raises(KeyboardInterrupt):
            run(config, out="halves", objective=Noisy)
    torch.manual_seed(6)
    resumed, rest = run(config, out="halves", objective=Noisy)
    assert tuple(r.step for r in rest) == lost
    assert [r.loss for r in rest] == [r.loss for r in reports[-len(lost) :]]
    assert [r.best for r in rest] == [r.best for r in reports[-len(lost) :]]
    for name, tensor in weights_of(straight).items():
        assert torch.equal(resumed.state_dict()[name], tensor), name


class Noisy(PaperStageOne):
    """An objective that draws from torch's generator, as dropout would."""

    def losses(self, frames: FrameBatch, truth: WindowTruth) -> dict[str, torch.Tensor]:
        noise = torch.rand(())
        return {name: loss * noise for name, loss in super().losses(frames, truth).items()}


def killed_at(step: int) -> Callable[..., torch.Tensor]:
    learn = loop._Learner.learn

    def until(self: loop._Learner, batch: Batch, at: int) -> torch.Tensor:
        if at == step:
            raise KeyboardInterrupt
        return learn(self, batch, at)

    return until


@pytest.mark.parametrize("decay", [0.0, 0.9])
def test_the_best_checkpoint_is_the_mean_of_the_weights(run: Run, tmp_path: Path, decay: float):
    """The last one, from which training goes on, has the weights themselves."""
    network, reports = run(replace(SHORT, steps=2, average_decay=decay))
    trained = weights_of(network)
    load_checkpoint(tmp_path / "run" / "last", network, None)
    assert all(torch.equal(tensor, trained[name]) for name, tensor in weights_of(network).items())
    load_checkpoint(tmp_path / "run" / "best", network, None)
    assert all(torch.equal(tensor, trained[name]) for name, tensor in weights_of(network).items()) == (decay == 0)
    assert reports[-1].scores is not None


def test_micro_batches_add_up_to_the_batch(run: Run):
    """Windows of different numbers of entities, so that the mean of the parts' means would be another one."""
    whole, reports = run(out="whole")
    parts, same = run(replace(SHORT, accumulate=2), out="parts")
    assert [r.loss for r in same] == approx([r.loss for r in reports], TRAINED)
    assert same[0].loss == pytest.approx(reports[0].loss, rel=1e-5), "before rounding has led the weights elsewhere"
    for name, tensor in weights_of(whole).items():
        assert torch.allclose(parts.state_dict()[name], tensor, atol=2e-3), name


def test_a_batch_that_cannot_be_divided(run: Run):
    with pytest.raises(ConfigError, match="multiple of 3"):
        run(replace(SHORT, accumulate=3))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is one")
def test_an_accelerator_that_is_not_there(run: Run):
    with pytest.raises(ConfigError, match="not available"):
        run(replace(SHORT, accelerator="cuda"))


def test_deterministic_algorithms_end_with_the_run(run: Run):
    seen = []

    class Watched(PaperStageOne):
        def trained(self) -> list[torch.nn.Parameter]:
            seen.append(torch.are_deterministic_algorithms_enabled())
            return super().trained()

    run(replace(SHORT, steps=1, deterministic=True), objective=Watched)
    assert seen == [True]
    assert not torch.are_deterministic_algorithms_enabled()


def test_a_run_of_another_stage_or_network_is_not_resumed(run: Run):
    class Other(PaperStageOne):
        name = "other"

    run(replace(SHORT, steps=1))
    with pytest.raises(WeightsError, match="paper-stage-1"):
        run(replace(SHORT, steps=1), objective=Other)
    with pytest.raises(WeightsError):
        run(network=replace(PAPER, slots=7))


def test_a_finished_run_stays_as_it_is(run: Run, tmp_path: Path):
    run()
    before = (tmp_path / "run" / "last" / "weights.safetensors").read_bytes()
    _, reports = run()
    assert reports == []
    assert (tmp_path / "run" / "last" / "weights.safetensors").read_bytes() == before


def test_a_run_that_was_stopped_before_it_was_judged_is_judged_when_fewer_steps_are_asked_for(run: Run, tmp_path: Path):
    config = replace(SHORT, validate_every=100, checkpoint_every=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop._Learner, "learn", killed_at(4))
        with pytest.raises(KeyboardInterrupt):
            run(config)
    _, reports = run(replace(config, steps=2))
    assert not reports
    assert load_checkpoint(tmp_path / "run" / "best", make_paper(), None).best_step == 2


def test_what_is_set_anew_counts_when_a_run_goes_on(run: Run, monkeypatch: pytest.MonkeyPatch):
    run(replace(SHORT, steps=2))
    seen = []
    make = loop.make_optimizer
    monkeypatch.setattr(loop, "make_optimizer", lambda *given, **named: seen.append(make(*given, **named)) or seen[-1])
    run(replace(SHORT, steps=4, weight_decay=0.3))
    assert {group["weight_decay"] for group in seen[0].param_groups} == {0.3}


@pytest.mark.parametrize(
    ("scores", "best_step", "stopped"),
    [([0.5, 0.6, 0.5, 0.4], 1, 3), ([0.5, 0.4, 0.6, 0.7], 2, 4), ([float("nan")] * 4, 1, 3)],
)
def test_patience(run: Run, tmp_path: Path, monkeypatch, scores: list[float], best_step: int, stopped: int):
    """Training stops after two validations without a better score, and there is a best checkpoint whatever happens."""
    left = iter(scores)
    monkeypatch.setattr(PaperStageOne, "validate", lambda *_, **__: WindowScores(1.0, 0.5, next(left), None, 0.5, 1))
    config = replace(SHORT, steps=9, validate_every=1, patience=2)
    network, reports = run(config)
    assert reports[-1].step == stopped
    assert load_checkpoint(tmp_path / "run" / "best", network, None).step == best_step
    assert run(config)[1] == [], "a run that has stopped stays stopped"


def test_a_loss_that_explodes_is_an_error(run: Run):
    with pytest.raises(ConfigError, match="learning rate"):
        run(weights={"aff": 1e300})


def test_schedule():
    config = TrainingConfig(steps=100, warmup_steps=10)
    rates = [loop._schedule(step, config) for step in range(1, 101)]
    assert rates[:10] == pytest.approx([s / 10 for s in range(1, 11)])
    assert all(a >= b for a, b in itertools.pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(0.05)


def test_validation_is_the_same_at_every_call(sampler: WindowSampler):
    stage = PaperStageOne(make_paper())
    one, two = (stage.validate(sampler, batches=2, device=torch.device("cpu")) for _ in range(2))
    assert one == two
    assert one.answers > 0
    assert 0 <= one.mean_distance <= 1
    halves = [d for d in (one.moved_distance, one.still_distance) if d is not None]
    assert min(halves) <= one.mean_distance <= max(halves)
    assert one.score == pytest.approx(sum(halves) / len(halves))
    assert 0 <= one.right <= 1
