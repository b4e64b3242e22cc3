"""Files of trained networks."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from quest.errors import WeightsError
from quest.model.weights import DEFAULTS, FORMAT, load_network, save_network, shipped_weights
from tests.tiny import FINDER, make_finder


@cache
def content() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "deep" / "net.safetensors"
        save_network(path, make_finder(), settings='{"jump": 0.1}', about="a test")
        assert list(path.parent.iterdir()) == [path]
        return path.read_bytes()


def saved(folder: Path) -> Path:
    (folder / "net.safetensors").write_bytes(content())
    return folder / "net.safetensors"


def rewritten(path: Path, *, changes: dict | None = None, drop: str = "", **metadata: str) -> Path:
    """The same file with other tensors or metadata."""
    tensors = {k: v for k, v in {**load_file(path), **(changes or {})}.items() if k != drop}
    about = {"format": FORMAT, "config": FINDER.to_json(), "settings": "{}", "about": "", **metadata}
    save_file(tensors, path, metadata=about)
    return path


def test_round_trip(tmp_path: Path):
    path = saved(tmp_path)
    loaded = load_network(path)
    assert loaded.network.config == FINDER
    assert loaded.settings == '{"jump": 0.1}'
    assert not loaded.network.training
    for name, tensor in make_finder().state_dict().items():
        expected = tensor.half().float()
        assert (loaded.network.state_dict()[name] == expected).all(), name
    save_network(path, loaded.network, settings=loaded.settings, about="again")
    again = load_network(path).network.state_dict()
    assert all((again[name] == tensor).all() for name, tensor in loaded.network.state_dict().items())


def test_nothing_is_left_of_what_could_not_be_written(tmp_path: Path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(WeightsError, match="cannot be written"):
        save_network(tmp_path / "folder", make_finder(), settings="{}", about="")
    assert list(tmp_path.iterdir()) == [tmp_path / "folder"]


def test_a_missing_file_names_what_ships(tmp_path: Path):
    for name in ("quest-none", tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(WeightsError, match="no such weights"):
            load_network(name)


@pytest.mark.parametrize("keep", [0, 4, 100, -1])
def test_a_torn_file(tmp_path: Path, keep: int):
    path = saved(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(WeightsError, match="not a whole safetensors file"):
        load_network(path)


def test_a_foreign_file(tmp_path: Path):
    path = tmp_path / "foreign.safetensors"
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(WeightsError, match="quest train"):
        load_network(path)
    path.write_text("not tensors")
    with pytest.raises(WeightsError):
        load_network(path)


@pytest.mark.parametrize("config", ["{", "[]", '{"encoder": {}, "future": 1}'])
def test_a_configuration_of_another_version(tmp_path: Path, config: str):
    with pytest.raises(WeightsError, match="version"):
        load_network(rewritten(saved(tmp_path), config=config))


def test_tensors_of_another_shape(tmp_path: Path):
    wider = replace(FINDER, width=24).to_json()
    with pytest.raises(WeightsError, match="do not fit"):
        load_network(rewritten(saved(tmp_path), config=wider))
    with pytest.raises(WeightsError, match=r"fine\.score\.bias"):
        load_network(rewritten(saved(tmp_path), drop="fine.score.bias"))
    with pytest.raises(WeightsError, match="extra"):
        load_network(rewritten(saved(tmp_path), changes={"extra": torch.zeros(1)}))


def test_shipped_names_are_files():
    shipped = shipped_weights()
    assert set(DEFAULTS) < set(shipped)
    assert all(path.is_file() and path.stem == DEFAULTS.get(name, name) for name, path in shipped.items())


def test_values_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    network = make_finder()
    with torch.no_grad():
        next(network.parameters()).fill_(float("nan"))
    save_network(tmp_path / "net.safetensors", network, settings="{}", about="made up")
    with pytest.raises(WeightsError, match="no numbers"):
        load_network(tmp_path / "net.safetensors")


@pytest.mark.parametrize("change", [{"width": 2**13}, {"depth": 1024}, {"depth": 10**7}, {"heads": "six"}])
def test_impossible_networks_are_refused_before_they_are_made(tmp_path: Path, change: dict[str, object]) -> None:
    config = json.loads(FINDER.to_json())
    config["encoder"] |= change
    path = rewritten(saved(tmp_path), config=json.dumps(config))
    with pytest.raises(WeightsError, match=r"net\.safetensors"):
        load_network(path)
