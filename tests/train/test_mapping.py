"""Stage map: the affordance map learns from single frames, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.cli.main import main
from quest.model.network import QuestNetwork
from quest.model.weights import load_network, save_network
from quest.train.feature_cache import FeatureCache
from quest.train.loop import StepReport, fit
from quest.train.mapping import MapScores, StageMap, with_own_map
from quest.train.settings import TrainingConfig, WindowConfig
from quest.train.windows import WindowSampler
from quest.types import LABELS
from tests.tiny import DEFAULT, make_frames, make_network
from tests.train.prepared import CPU, make_store

pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

OLD = replace(DEFAULT, intents=False, map_layers=0)
"""A network that reads its map off what its queries look at."""


def anchors(root: Path, network: QuestNetwork) -> WindowSampler:
    store = make_store(root / "takes", (0, 1))
    cache = FeatureCache(root / "cache", network.config, network.encoder)
    list(cache.build(store, store.names(), device=CPU, enlarged=True))
    return WindowSampler(cache.views(store.names()), network.config, WindowConfig(batch=4), anchors_only=True)


def test_windows_are_anchor_frames_with_enlarged_images(tmp_path: Path):
    network = make_network()
    sampler = anchors(tmp_path, network)
    frames, truth = sampler.draw(np.random.default_rng(0))
    assert frames.features.shape[:2] == truth.uv.shape[:2] == (4, 1)
    assert frames.enlarged is not None
    assert frames.enlarged.shape == (4, 1, DEFAULT.cells**2, DEFAULT.encoder.width)
    part = frames.of(slice(1, 3)).during(slice(0, 1)).to(CPU)
    assert part.enlarged is not None
    assert torch.equal(part.enlarged, frames.enlarged[1:3])


def test_what_is_known_of_enlarged_images_is_what_the_network_would_find():
    network, frames = make_network(), make_frames(batch=2, frames=2)
    observed = network.observe(frames)
    enlarged = network.enlarge(frames.rgb.flatten(0, 1)).unflatten(0, (2, 2))
    expected = network.afford(frames, observed)
    got = network.afford(replace(frames, enlarged=enlarged), observed)
    torch.testing.assert_close(got.logits, expected.logits)
    other = network.afford(replace(frames, enlarged=enlarged.flip(2)), observed)
    assert not torch.allclose(other.logits, expected.logits)


@pytest.mark.slow
def test_only_the_map_learns_and_it_does(tmp_path: Path):
    network = with_own_map(make_network(OLD))
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    sampler, reports = anchors(tmp_path, network), list[StepReport]()
    config = TrainingConfig(
        steps=120,
        warmup_steps=1,
        learning_rate=3e-3,
        validate_every=60,
        validation_batches=2,
        precision="32-true",
    )
    stage = StageMap(network)
    fit(stage, sampler, sampler, config, out=tmp_path / "run", report=reports.append)
    changed = {name for name, tensor in network.state_dict().items() if not torch.equal(tensor, before[name])}
    assert changed
    assert all(name.startswith("affordance") for name in changed)
    assert reports[-1].loss < 0.5 * reports[0].loss
    scores = reports[-1].scores
    assert isinstance(scores, MapScores)
    assert 0 < scores.precision <= scores.recall <= 1
    assert scores.score == 1 - scores.precision
    assert "average precision" in str(scores)


def test_every_trained_parameter_gets_a_gradient(tmp_path: Path):
    network = make_network()
    stage = StageMap(network)
    stage.losses(*anchors(tmp_path, network).draw(np.random.default_rng(0)))["map"].backward()
    assert all(p.grad is not None for p in stage.trained())


def test_an_own_map_begins_with_what_the_network_knows():
    network = make_network(OLD)
    grown = with_own_map(network)
    assert with_own_map(grown) is grown
    assert grown.config == replace(OLD, map_layers=grown.config.map_layers, intents=True)
    old, new = network.state_dict(), grown.state_dict()
    for name, tensor in old.items():
        if not name.startswith("affordance.mlp.2"):
            assert torch.equal(new[name], tensor), name
    assert torch.equal(new["affordance_trunk.observer.project.weight"], old["observer.project.weight"])
    scores, offsets = new["affordance.mlp.2.bias"].split([2 * len(LABELS), 4])
    for purpose in range(2):
        torch.testing.assert_close(scores[purpose::2], old["affordance.mlp.2.bias"][: len(LABELS)])
        torch.testing.assert_close(offsets.reshape(2, 2)[purpose], old["affordance.mlp.2.bias"][len(LABELS) :])


@pytest.mark.slow
def test_stage_map_by_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A file that discovers otherwise and tracks the same."""
    save_network(tmp_path / "one.safetensors", make_network(OLD), settings="{}", about="one")
    make_store(tmp_path / "takes", (0, 1))
    make_store(tmp_path / "choose", (100_002,))
    stores = ("--data", str(tmp_path / "takes"), "--validation", str(tmp_path / "choose"))
    sizes = ("--training.steps", "2", "--training.validation-batches", "1", "--windows.batch", "2")
    out = ("--out", str(tmp_path / "map"))
    assert main(["train", "--stage", "map", *stores, *out, *sizes, "--weights", str(tmp_path / "one.safetensors")]) == 0
    one, two = load_network(tmp_path / "one.safetensors"), load_network(tmp_path / "map" / "weights.safetensors")
    assert two.network.config.intents
    assert two.network.affordance_trunk is not None
    new = two.network.state_dict()
    for name, tensor in one.network.state_dict().items():
        if not name.startswith("affordance"):
            assert torch.equal(new[name], tensor), name
    assert main(["train", "--stage", "map", *stores, "--out", str(tmp_path / "none")]) != 0
    assert "--weights" in capsys.readouterr().err
