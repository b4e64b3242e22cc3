"""Checkpoints: whole or absent, and only of the same network."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from quest.errors import WeightsError
from quest.model import tensor_file
from quest.paper.network import PaperNetwork
from quest.train.checkpoint import Progress, check_same_run, load_checkpoint, save_checkpoint
from tests.paper.tiny import PAPER, make_paper

PROGRESS = Progress(7, 0.25, 5, 2, "{}", PAPER.to_json())


def trained(seed: int = 0, *, steps: int = 2) -> tuple[PaperNetwork, torch.optim.Optimizer]:
    network = make_paper(seed=seed)
    optimizer = torch.optim.AdamW(network.trainable(), lr=1e-2, betas=(0.8, 0.9))
    for _ in range(steps):
        optimizer.zero_grad()
        torch.stack([p.square().sum() for p in network.trainable()]).sum().backward()
        optimizer.step()
    return network, optimizer


def saved(folder: Path) -> Path:
    save_checkpoint(folder, *trained(), PROGRESS)
    return folder


def test_round_trip(tmp_path: Path):
    network, optimizer = trained()
    save_checkpoint(tmp_path / "last", network, optimizer, PROGRESS)
    other, fresh = trained(seed=1, steps=0)
    other.encoder.load_state_dict(network.encoder.state_dict())
    assert load_checkpoint(tmp_path / "last", other, fresh) == PROGRESS
    for name, tensor in network.state_dict().items():
        assert (other.state_dict()[name] == tensor).all(), name
    one, two = optimizer.state_dict(), fresh.state_dict()
    assert {k: v for k, v in one["param_groups"][0].items() if k != "betas"} == {
        k: v for k, v in two["param_groups"][0].items() if k != "betas"
    }
    assert tuple(two["param_groups"][0]["betas"]) == (0.8, 0.9)
    for i, state in one["state"].items():
        assert all(torch.equal(two["state"][i][key], value) for key, value in state.items())


def test_the_encoder_is_left_out(tmp_path: Path):
    weights = load_file(saved(tmp_path / "last") / "weights.safetensors")
    assert weights
    assert not any(name.startswith("encoder.") for name in weights)
    other = make_paper(seed=1)
    encoder = {name: t.clone() for name, t in other.encoder.state_dict().items()}
    load_checkpoint(tmp_path / "last", other, None)
    assert all((t == encoder[name]).all() for name, t in other.encoder.state_dict().items())


def test_blocks_of_the_encoder_that_learn_are_kept(tmp_path: Path):
    network, optimizer = trained()
    block = network.encoder.blocks[-1].requires_grad_()
    save_checkpoint(tmp_path / "last", network, optimizer, PROGRESS)
    other = make_paper(seed=1)
    other.encoder.blocks[-1].requires_grad_()
    load_checkpoint(tmp_path / "last", other, None)
    for name, tensor in block.state_dict().items():
        assert torch.equal(other.encoder.blocks[-1].state_dict()[name], tensor), name


def test_replacing_leaves_one_checkpoint(tmp_path: Path):
    saved(tmp_path / "last")
    save_checkpoint(tmp_path / "last", *trained(seed=1), replace(PROGRESS, step=8))
    assert [path.name for path in tmp_path.iterdir()] == ["last"]
    assert load_checkpoint(tmp_path / "last", make_paper(), None).step == 8


def test_killed_between_the_renames(tmp_path: Path):
    saved(tmp_path / "last").rename(tmp_path / ".old-last")
    assert load_checkpoint(tmp_path / "last", make_paper(), None).step == 7
    save_checkpoint(tmp_path / "last", *trained(), replace(PROGRESS, step=9))
    assert load_checkpoint(tmp_path / "last", make_paper(), None).step == 9
    assert [path.name for path in tmp_path.iterdir()] == ["last"]


def test_killed_while_writing_keeps_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    saved(tmp_path / "last").rename(tmp_path / ".old-last")
    monkeypatch.setattr(Path, "rename", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path / "last", *trained(), replace(PROGRESS, step=9))
    assert load_checkpoint(tmp_path / "last", make_paper(), None).step == 7


@pytest.mark.parametrize("name", ["weights.safetensors", "optimizer.safetensors", "progress.json"])
@pytest.mark.parametrize("keep", [None, 0, 50])
def test_a_torn_checkpoint(tmp_path: Path, name: str, keep: int | None):
    file = saved(tmp_path / "last") / name
    if keep is None:
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:keep])
    network, optimizer = trained(seed=1)
    with pytest.raises(WeightsError, match="start anew"):
        load_checkpoint(tmp_path / "last", network, optimizer)


def test_a_checkpoint_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_: object, **__: object) -> None:
        raise SafetensorError("No space left on device")

    monkeypatch.setattr(tensor_file, "save_file", full)
    with pytest.raises(WeightsError, match=r"weights\.safetensors: cannot be written \(No space left"):
        saved(tmp_path / "last")


@pytest.mark.parametrize("text", ["[]", "{}", '{"progress": {}}', json.dumps({"progress": {"step": 1}, "groups": []})])
def test_a_foreign_progress_file(tmp_path: Path, text: str):
    (saved(tmp_path / "last") / "progress.json").write_text(text)
    with pytest.raises(WeightsError):
        load_checkpoint(tmp_path / "last", *trained(seed=1))


def test_a_foreign_optimiser_state(tmp_path: Path):
    folder = saved(tmp_path / "last")
    save_file({"colour": torch.zeros(1)}, folder / "optimizer.safetensors")
    with pytest.raises(WeightsError):
        load_checkpoint(folder, *trained(seed=1))


def test_another_run_is_refused(tmp_path: Path):
    folder = saved(tmp_path / "last")
    with pytest.raises(WeightsError, match="do not fit"):
        load_checkpoint(folder, make_paper(width=64), None)
    check_same_run(PROGRESS, PAPER, "stage-1", "abc", folder)
    with pytest.raises(WeightsError, match="another network"):
        check_same_run(PROGRESS, replace(PAPER, slots=7), "stage-1", "abc", folder)
    begun = replace(PROGRESS, begun="abc")  # what a stage does not train would replace that of the new weights
    check_same_run(begun, PAPER, "stage-1", "abc", folder)
    with pytest.raises(WeightsError, match="began with other weights"):
        check_same_run(begun, PAPER, "stage-1", "def", folder)
    with pytest.raises(WeightsError, match="missing"):
        load_checkpoint(tmp_path / "none", make_paper(), None)
