"""Files of weights that leave to another file what both have."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from quest.errors import WeightsError
from quest.model import weights
from quest.model.finder import FinderNetwork
from quest.model.tensor_file import SHARED
from quest.model.weights import load_network, save_network
from tests.tiny import make_finder


def another(seed: int = 1) -> FinderNetwork:
    """A network of another training, with the encoder of the first."""
    network = make_finder(seed=seed)
    network.encoder.load_state_dict(make_finder().encoder.state_dict())
    return network


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """A whole file, and one beside it that shares its encoder."""
    whole, shares = tmp_path / "whole.safetensors", tmp_path / "shares.safetensors"
    save_network(whole, make_finder(), settings="{}", about="whole")
    save_network(shares, another(), settings="{}", about="shares", beside=whole)
    return whole, shares


def rewritten(path: Path, **metadata: str) -> None:
    with safe_open(path, framework="pt") as file:
        said = file.metadata()
    save_file(load_file(path), path, metadata={**said, **metadata})


def test_it_is_read_as_if_it_were_whole(pair: tuple[Path, Path], tmp_path: Path):
    whole, shares = pair
    assert not any(name.startswith("encoder.") for name in load_file(shares))
    assert shares.stat().st_size < whole.stat().st_size
    state = load_network(shares).network.state_dict()
    assert all((state[name] == tensor.half().float()).all() for name, tensor in another().state_dict().items())
    load_network(shares).save_pretrained(tmp_path / "folder")
    assert any(name.startswith("encoder.") for name in load_file(tmp_path / "folder" / "model.safetensors"))


def test_the_other_file_is_looked_for_beside_it_then_among_what_ships(
    pair: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole, shares = pair
    (tmp_path / "elsewhere").mkdir()
    moved = Path(shutil.move(shares, tmp_path / "elsewhere"))
    with pytest.raises(WeightsError, match=r"shares encoder, .* with whole\.safetensors"):
        load_network(moved)
    monkeypatch.setattr(weights, "shipped_weights", lambda: {"whole": whole})
    assert load_network(moved).about == "shares"


def test_another_encoder_is_not_taken_for_it(pair: tuple[Path, Path]):
    whole, shares = pair
    save_network(whole, make_finder(seed=2), settings="{}", about="another")
    with pytest.raises(WeightsError, match="another encoder"):
        load_network(shares)
    whole.write_bytes(whole.read_bytes()[:100])
    with pytest.raises(WeightsError, match="not a whole safetensors file"):
        load_network(shares)


@pytest.mark.parametrize("said", ["{", "[]", '{"file": "whole"}', '{"file": "whole", "parts": ["encoder"]}'])
def test_metadata_that_say_it_wrongly(pair: tuple[Path, Path], said: str):
    rewritten(pair[1], **{SHARED: said})
    with pytest.raises(WeightsError, match="torn"):
        load_network(pair[1])


def test_parts_left_out_without_a_word(pair: tuple[Path, Path]):
    rewritten(pair[1], **{SHARED: '{"file": "whole", "parts": {}}'})
    with pytest.raises(WeightsError, match="encoder"):
        load_network(pair[1])


def test_nothing_to_share(pair: tuple[Path, Path], tmp_path: Path):
    whole, shares = pair
    out = tmp_path / "out.safetensors"
    with pytest.raises(WeightsError, match="no part"):
        save_network(out, make_finder(seed=3), settings="{}", about="", beside=whole)
    with pytest.raises(WeightsError, match="shares parts itself"):
        save_network(out, another(), settings="{}", about="", beside=shares)
    with pytest.raises(WeightsError, match="not a whole"):
        save_network(out, another(), settings="{}", about="", beside=tmp_path / "none.safetensors")
    assert not out.exists()


def test_what_was_written_before_stays_when_nothing_can_be_shared(pair: tuple[Path, Path]):
    whole, shares = pair
    before = shares.read_bytes()
    with pytest.raises(WeightsError):
        save_network(shares, make_finder(seed=3), settings="{}", about="", beside=whole)
    assert shares.read_bytes() == before
    read, made = (network.state_dict() for network in (load_network(whole).network, make_finder()))
    assert torch.equal(read["lateral.0.weight"], made["lateral.0.weight"].half().float())


def test_blocks_are_shared_one_by_one(pair: tuple[Path, Path], tmp_path: Path):
    """Of an encoder whose last blocks were trained further the first ones are left out."""
    whole, _ = pair
    refined = another()
    with torch.no_grad():
        next(refined.encoder.blocks[-1].parameters()).add_(1)
    save_network(tmp_path / "refined.safetensors", refined, settings="{}", about="", beside=whole)
    last = f"encoder.blocks.{len(refined.encoder.blocks) - 1}."
    kept = [name for name in load_file(tmp_path / "refined.safetensors") if name.startswith("encoder.")]
    assert kept
    assert all(name.startswith(last) for name in kept)
    state = load_network(tmp_path / "refined.safetensors").network.state_dict()
    assert all((state[name] == tensor.half().float()).all() for name, tensor in refined.state_dict().items())
