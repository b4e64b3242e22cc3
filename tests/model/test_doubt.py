"""The network that tells a loss from readings, and its file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.errors import WeightsError
from quest.filter.queries import READINGS
from quest.model.doubt import FORMAT, LIMIT, PACKAGED, Doubt, read_doubt, save_doubt
from quest.model.tensor_file import read_tensors, save_tensors

NAMES = ("one", "other")


@pytest.fixture
def doubt() -> Doubt:
    torch.manual_seed(0)
    network = Doubt(2, 3)
    network.mean, network.scale = torch.tensor([1.0, -1.0]), torch.tensor([2.0, 0.5])
    return network.eval().requires_grad_(False)


def test_a_layer_of_standardised_readings(doubt: Doubt) -> None:
    readings = np.random.default_rng(0).normal(size=(5, 2))
    told = (readings - [1.0, -1.0]) / [2.0, 0.5]
    hidden = np.tanh(told @ doubt.hidden.weight.numpy().T + doubt.hidden.bias.numpy())
    np.testing.assert_allclose(
        doubt.log_odds(readings), hidden @ doubt.out.weight.numpy()[0] + doubt.out.bias.item(), rtol=1e-4
    )


def test_readings_beyond_what_was_seen_tell_no_more_and_nan_stays(doubt: Doubt) -> None:
    far = np.array([[1 + 2 * LIMIT, -1.0], [1e9, -1.0], [np.inf, -1.0]])
    assert np.ptp(doubt.log_odds(far)) == 0
    assert np.isnan(doubt.log_odds(np.array([[np.nan, 0.0]]))).all()
    assert doubt.log_odds(np.zeros((0, 2))).shape == (0,)


def test_a_file_gives_the_same_network(doubt: Doubt, tmp_path: Path) -> None:
    save_doubt(doubt, tmp_path / "doubt.safetensors", readings=NAMES, about="of a test")
    again = read_doubt(NAMES, tmp_path / "doubt.safetensors")
    readings = np.ones((1, 2))
    assert again.log_odds(readings) == doubt.log_odds(readings)
    assert not any(p.requires_grad for p in again.parameters())


def test_files_that_do_not_fit_are_refused(doubt: Doubt, tmp_path: Path) -> None:
    path = tmp_path / "doubt.safetensors"
    with pytest.raises(WeightsError, match=re.escape(str(path))):
        read_doubt(NAMES, path)
    save_doubt(doubt, path, readings=NAMES, about="of a test")
    with pytest.raises(WeightsError, match="weighs other readings"):
        read_doubt(("one", "another"), path)
    _, tensors = read_tensors(path)
    save_tensors(tensors, path, metadata={"format": "quest-doubt-0"})
    with pytest.raises(WeightsError, match="quest-doubt-0"):
        read_doubt(NAMES, path)
    save_tensors({"hidden.bias": torch.zeros(3)}, path, metadata={"format": FORMAT, "readings": json.dumps(NAMES)})
    with pytest.raises(WeightsError, match="network"):
        read_doubt(NAMES, path)
    path.write_bytes(b"torn")
    with pytest.raises(WeightsError):
        read_doubt(NAMES, path)


def test_the_network_that_ships_weighs_what_the_filter_gives() -> None:
    """More doubt where nothing looks like the anchor any more, all else as in the mean."""
    network = read_doubt(READINGS)
    like, unlike = (network.mean.numpy().copy() for _ in range(2))
    for name, change in (("anchor cosine", 2.0), ("tile", 2.0), ("anchor correlation", 2.0), ("lost", -2.0)):
        i = READINGS.index(name)
        like[i] += change * network.scale[i].item()
        unlike[i] -= change * network.scale[i].item()
    assert network.log_odds(unlike[None]) > network.log_odds(like[None]) + 2
    assert PACKAGED.stat().st_size < 100_000
