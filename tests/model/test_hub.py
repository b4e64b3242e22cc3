"""Weights in folders and on the hub, against a stand-in for the hub on this machine."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from huggingface_hub import ModelCard, constants

import quest
from quest.cli.main import main
from quest.errors import WeightsError
from quest.model.hub import FILE, HubId, download, model_card
from quest.model.tensor_file import read_tensors, save_tensors
from quest.model.weights import LoadedNetwork, load_network, save_network
from tests.model.hub_server import COMMIT, FakeHub
from tests.tiny import FINDER, make_finder

ABOUT = "a test | of weights"


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Weights with everything that a file can hold."""
    path = tmp_path_factory.mktemp("made") / "w.safetensors"
    save_network(path, make_finder(), settings='{"bias": 0.1}', about=ABOUT, licence="Apache-2.0", version="1.2")
    return path.read_bytes()


@pytest.fixture
def file(tmp_path: Path, content: bytes) -> Path:
    """The same in a folder of a run."""
    path = tmp_path / "run" / "weights.safetensors"
    path.parent.mkdir()
    path.write_bytes(content)
    return path


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHub]:
    """A hub, an empty cache, and nobody logged in."""
    held = FakeHub()
    with held.serve() as address:
        listen(monkeypatch, address)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
        monkeypatch.delenv("HF_TOKEN", raising=False)
        yield held


def listen(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    """Make the hub's library speak with an address."""
    monkeypatch.setattr(constants, "ENDPOINT", address)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}")


def same(one: LoadedNetwork, other: LoadedNetwork) -> bool:
    """Whether two files hold the same."""
    fields = ("settings", "about", "licence", "version")
    state = other.network.state_dict()
    return (
        all(getattr(one, f) == getattr(other, f) for f in fields)
        and one.network.config == other.network.config
        and all(torch.equal(value, state[key]) for key, value in one.network.state_dict().items())
    )


def test_a_folder_loses_nothing(file: Path, tmp_path: Path):
    loaded = load_network(file)
    loaded.save_pretrained(tmp_path / "saved")
    assert sorted(p.name for p in (tmp_path / "saved").iterdir()) == ["README.md", "config.json", FILE]
    for again in (LoadedNetwork.from_pretrained(tmp_path / "saved"), load_network(tmp_path / "saved")):
        assert same(loaded, again)
        assert not again.network.training
    assert json.loads((tmp_path / "saved" / "config.json").read_text())["network"]["width"] == FINDER.width


def test_a_run_is_a_folder_of_weights(file: Path):
    assert same(load_network(file.parent), load_network(file))
    assert quest.load(str(file.parent), device="cpu").weights_hash == load_network(file).sha256


def test_the_card_says_what_the_file_holds(file: Path, tmp_path: Path):
    load_network(file).save_pretrained(tmp_path / "saved")
    card = ModelCard.load(tmp_path / "saved" / "README.md")
    told = card.data.to_dict()
    assert told["license"] == "apache-2.0"
    assert {"pytorch_model_hub_mixin", "rgb-d"} <= set(told["tags"])
    assert "| training | a test / of weights |" in card.text
    assert 'quest.load("path/to/this/folder")' in card.text


def test_the_card_beside_the_file_is_taken(file: Path, tmp_path: Path):
    file.with_suffix(".md").write_text("# Drawers of my kitchen\n", encoding="utf-8")
    changed = replace(load_network(file), licence="My own licence, research only")
    changed.save_pretrained(tmp_path / "saved")
    text = (tmp_path / "saved" / "README.md").read_text(encoding="utf-8")
    assert "license: other" in text
    assert "license_name: my-own-licence-research-only" in text
    assert "# Drawers of my kitchen" in text
    assert LoadedNetwork.from_pretrained(tmp_path / "saved").licence == "My own licence, research only"


def test_a_card_of_a_file_that_says_little():
    loaded_as = {"config": FINDER, "about": "", "settings": "{}", "licence": "", "version": ""}
    text = str(model_card({}, text=None, load_as="owner/name", **loaded_as))  # type: ignore[arg-type]
    assert "license" not in text.partition("# Weights")[0]
    assert "| licence | not said |" in text


@pytest.mark.slow
def test_loaded_from_the_hub_and_then_from_the_cache(hub: FakeHub, file: Path, monkeypatch: pytest.MonkeyPatch):
    hub.files["owner/name"] = {"main": {FILE: file.read_bytes()}, "v1": {FILE: file.read_bytes()}}
    loaded = load_network("owner/name")
    assert same(loaded, load_network(file))
    assert loaded.name == "owner/name"
    assert quest.load("owner/name@v1", device="cpu").weights_hash == loaded.sha256
    assert same(LoadedNetwork.from_pretrained("owner/name", revision="v1"), loaded)
    assert not [r for r in hub.requests if ".bin" in r or "config.json" in r]
    listen(monkeypatch, "http://127.0.0.1:9")  # nobody is there
    assert same(load_network("owner/name"), loaded)
    assert same(LoadedNetwork.from_pretrained("owner/name", local_files_only=True), loaded)


def test_a_folder_of_this_machine_comes_first(hub: FakeHub, file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(file.parents[1])
    save_network(Path("owner/name") / FILE, make_finder(seed=1), settings="{}", about="here")
    hub.files["owner/name"] = {"main": {FILE: file.read_bytes()}}
    assert load_network("owner/name").about == "here"
    assert not hub.requests


def test_a_misspelt_path_in_a_folder_of_this_machine_is_not_looked_for_on_the_hub(
    hub: FakeHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    with pytest.raises(WeightsError, match=r"no such weights in the folder runs.*runs/mien@main"):
        load_network("runs/mien")
    assert not hub.requests


def test_what_the_hub_refuses(hub: FakeHub, file: Path):
    hub.gated.add("owner/gated")
    hub.files["owner/pickles"] = {"main": {"pytorch_model.bin": b"not looked at", "config.json": b"{}"}}
    hub.files["owner/torn"] = {"main": {FILE: file.read_bytes()[:100]}}
    for name, message in {
        "owner/none": "no such model repository.*hf auth login",
        "owner/gated": "gated; accept the terms on http.*/owner/gated",
        "owner/pickles": "none; other formats",
        "owner/pickles@v9": "no such branch, tag or commit",
        "owner/torn": "not a whole safetensors file",
        "-/..": "not an id of the hub|no such weights",
    }.items():
        with pytest.raises(WeightsError, match=message):
            load_network(name)
        with pytest.raises(WeightsError):
            LoadedNetwork.from_pretrained(name)
    assert not [request for request in hub.requests if "pytorch_model" in request]


def test_a_hub_that_cannot_be_reached(hub: FakeHub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(WeightsError, match=r"cannot be reached, and the cache .* has no copy"):
        load_network("owner/name")
    assert not hub.requests
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    with pytest.raises(WeightsError, match="has no copy"):
        download(HubId("owner/name"), local_files_only=True)


def test_a_hub_that_does_not_answer_is_asked_once(hub: FakeHub, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("time.sleep", lambda seconds: pytest.fail("waited for another try"))
    listen(monkeypatch, "http://127.0.0.1:9")
    with pytest.raises(WeightsError, match=r"127\.0\.0\.1:9 cannot be reached, and the cache .* has no copy"):
        load_network("owner/name")


@pytest.mark.slow
def test_push_and_load(hub: FakeHub, file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    assert main(["weights", "push", str(file), "owner/mine"]) == 2
    assert "hf auth login" in capsys.readouterr().err
    hub.tokens.add("hf_test")
    monkeypatch.setenv("HF_TOKEN", "hf_test")
    assert main(["weights", "push", str(file), "owner/mine", "--version", "2.0"]) == 0
    printed = capsys.readouterr().out
    assert f"/owner/mine/commit/{COMMIT}" in printed
    assert 'quest.load("owner/mine")' in printed
    assert sorted(hub.files["owner/mine"]["main"]) == ["README.md", "config.json", FILE]
    assert b'quest.load("owner/mine")' in hub.files["owner/mine"]["main"]["README.md"]
    assert same(load_network("owner/mine"), replace(load_network(file), version="2.0"))


def test_ids():
    assert HubId.parse("owner/name") == HubId("owner/name")
    assert HubId.parse("owner/na.me-1@v1/rc") == HubId("owner/na.me-1", "v1/rc")
    assert str(HubId("owner/name", "v1")) == "owner/name@v1"
    for path in ("name", "runs/mine/weights", "mine/w.safetensors", "./mine", "/tmp/mine", "a\\b", "owner/name@", ""):
        assert HubId.parse(path) is None, path


def test_show_and_save(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main(["weights", "show", str(file)]) == 0
    printed = capsys.readouterr().out
    for expected in ("Apache-2.0", "1.2", load_network(file).sha256[:16], "bias 0.1", "finder: width 16"):
        assert expected in printed
    assert main(["weights", "save", str(file), str(tmp_path / "saved"), "--licence", "MIT"]) == 0
    assert load_network(tmp_path / "saved").licence == "MIT"
    assert load_network(tmp_path / "saved").version == "1.2"
    assert main(["weights", "show", str(tmp_path / "none.safetensors")]) == 2
    assert "no such weights" in capsys.readouterr().err


def test_what_older_files_say_of_a_monitor_is_left_out(file: Path, tmp_path: Path):
    metadata, tensors = read_tensors(file)
    save_tensors(tensors, tmp_path / "older.safetensors", metadata=metadata | {"monitor": '{"format": 3}'})
    assert same(load_network(tmp_path / "older.safetensors"), load_network(file))
