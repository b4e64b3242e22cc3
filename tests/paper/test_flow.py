"""The flow head, and stage 2, in which it learns and nothing else does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from quest.cli.main import main
from quest.paper.flow import FlowScores, StageTwo, with_flow_head, without_flow_head
from quest.paper.network import REST, FlowHead, read_paper
from quest.paper.objective import PaperStageOne
from quest.train.loop import StepReport, fit
from quest.train.settings import TrainingConfig
from tests.paper.tiny import PAPER, make_paper
from tests.train.prepared import make_sampler, make_store

pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")


def embeddings(*, frames: int = 4) -> torch.Tensor:
    return torch.randn(2, frames, 3, PAPER.width, generator=torch.Generator().manual_seed(0))


def lively() -> FlowHead:
    """A head whose last layer says something."""
    head = make_paper(flow=True).flow
    assert head is not None
    return head


def test_one_displacement_per_query_and_none_in_the_beginning():
    assert (FlowHead(PAPER.width, window=PAPER.window)(embeddings()) == 0).all()
    flow, order = lively()(embeddings()), torch.tensor([2, 0, 1])
    assert flow.shape == (2, 3, 3)
    assert (flow != 0).any()
    torch.testing.assert_close(lively()(embeddings()[:, :, order]), flow[:, order])


def test_what_hardly_moves_rests():
    """Each query by itself, and not while the head learns."""
    head, embedding = lively(), embeddings()
    length = head.train()(embedding).norm(dim=-1)
    with torch.no_grad():
        final = head.out[-1]
        assert isinstance(final, torch.nn.Linear)
        for part in (final.weight, final.bias):
            part *= REST / length.median()
    raw, settled = head(embedding), head.eval()(embedding)
    still = raw.norm(dim=-1) < REST
    assert still.any()
    assert not still.all()
    assert (settled[still] == 0).all()
    assert (settled[~still] == raw[~still]).all()


def test_before_there_are_enough_frames_the_oldest_stands_for_them():
    for frames in (1, 3):
        embedding, head = embeddings(frames=frames), lively()
        repeated = torch.cat((embedding[:, :1].expand(-1, 4 - frames, -1, -1), embedding), dim=1)
        torch.testing.assert_close(head(embedding), head(repeated))


def test_a_new_head_scores_as_zero_flow_and_only_the_head_learns(tmp_path: Path):
    network, reports = with_flow_head(make_paper()), list[StepReport]()
    sampler = make_sampler(tmp_path, network, batch=4)
    stage = StageTwo(network, PaperStageOne(network).answered)
    scores = stage.validate(sampler, batches=2, device=torch.device("cpu"))
    assert scores.epe == pytest.approx(scores.zero)
    assert scores.epe_moving == pytest.approx(scores.zero_moving)
    assert network.training
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    config = TrainingConfig(
        steps=2, warmup_steps=1, learning_rate=1e-3, validate_every=2, validation_batches=4, precision="32-true"
    )
    fit(stage, sampler, sampler, config, out=tmp_path / "run", report=reports.append)
    changed = {name for name, tensor in network.state_dict().items() if not torch.equal(tensor, before[name])}
    assert changed
    assert all(name.startswith("flow.") for name in changed)
    scores = reports[-1].scores
    assert isinstance(scores, FlowScores)
    assert scores.answers >= scores.moving > 0
    assert scores.score == scores.epe
    assert "EPE3D" in str(scores)


def test_heads_come_and_go():
    network = make_paper()
    assert without_flow_head(network) is network
    grown = with_flow_head(network)
    assert with_flow_head(grown) is grown
    assert grown.config == replace(PAPER, flow=True)
    back = without_flow_head(grown)
    assert back.config == PAPER
    for name, tensor in network.state_dict().items():
        assert torch.equal(back.state_dict()[name], tensor), name


@pytest.mark.slow
def test_stage_two_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A file with a flow head that otherwise is the one it came from; stage 1 drops the head."""
    make_paper().save(tmp_path / "one.safetensors", about="one")
    make_store(tmp_path / "takes", (0, 1))
    make_store(tmp_path / "choose", (100_002,))

    def train(weights: str, out: str, *more: str) -> int:
        stores = ("--data", str(tmp_path / "takes"), "--validation", str(tmp_path / "choose"))
        places = ("--weights", str(tmp_path / weights), "--out", str(tmp_path / out))
        sizes = ("--training.steps", "2", "--training.validation-batches", "1", "--windows.batch", "2")
        return main(["train", *stores, *places, *sizes, *more])

    assert train("one.safetensors", "flow", "--stage", "2") == 0
    one, two = read_paper(tmp_path / "one.safetensors"), read_paper(tmp_path / "flow" / "weights.safetensors")
    assert two.network.config == replace(one.network.config, flow=True)
    for name, tensor in one.network.state_dict().items():
        assert torch.equal(two.network.state_dict()[name], tensor), name
    assert train("flow/weights.safetensors", "again", "--stage", "1") == 0
    assert read_paper(tmp_path / "again" / "weights.safetensors").network.flow is None
    assert train("one.safetensors", "flow", "--stage", "1") != 0, "a folder of stage 2 is not gone on with by stage 1"
    assert main(["train", "--data", "x", "--out", str(tmp_path / "none"), "--stage", "2"]) != 0
    assert "--weights" in capsys.readouterr().err
