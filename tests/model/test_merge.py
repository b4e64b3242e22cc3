"""Parts that were trained apart, put together, and what does not fit refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from quest.cli.main import main
from quest.errors import WeightsError
from quest.model.config import NetworkConfig
from quest.model.merge import merge
from quest.model.weights import LoadedNetwork, load_network, save_network
from tests.tiny import DEFAULT, make_network


def write(path: Path, config: NetworkConfig = DEFAULT, *, add: float = 0.0, to: str = "affordance") -> LoadedNetwork:
    """The same network in every file, but for what is added to one part of it."""
    torch.manual_seed(0)
    network = make_network(config)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if name.startswith(to):
                parameter += add
    save_network(path, network, settings="{}", about=path.stem)
    return load_network(path)


@pytest.mark.slow
def test_the_map_is_the_mean_and_the_rest_stays(tmp_path: Path):
    base, low, high = (write(tmp_path / f"{add}.safetensors", add=add) for add in (0.0, 1.0, 4.0))
    merged = merge(base, maps=[low, low, high])
    for name, tensor in merged.network.state_dict().items():
        before = base.network.state_dict()[name]
        torch.testing.assert_close(
            tensor, before + 2 if name.startswith("affordance") else before, atol=2e-3, rtol=2e-3
        )
    assert merged.settings == base.settings
    assert low.name in merged.about
    bound, free = (replace(part, licence=name) for part, name in ((low, "research only"), (base, "Apache-2.0")))
    joined = merge(replace(free, version="1.0"), maps=[bound, free])
    assert (joined.licence, joined.version) == ("Apache-2.0; research only", "")
    assert merge(base, maps=[low]).licence == ""
    assert merge(base, maps=[free]).licence == "not said for a part of it; Apache-2.0"


def test_a_flow_head_comes_along_by_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    base = write(tmp_path / "base.safetensors")
    flow = make_network(replace(DEFAULT, flow=True))
    flow.load_state_dict({**flow.state_dict(), **base.network.state_dict()})
    save_network(tmp_path / "flow.safetensors", flow, settings="{}", about="flow")
    files = [str(tmp_path / name) for name in ("base.safetensors", "merged.safetensors", "flow.safetensors")]
    assert main(["weights", "merge", *files[:2], "--flow", files[2]]) == 0
    assert "merged.safetensors" in capsys.readouterr().out
    merged, head = load_network(files[1]).network, load_network(files[2]).network.flow
    assert merged.flow is not None
    assert head is not None
    for name, tensor in head.state_dict().items():
        assert torch.equal(merged.flow.state_dict()[name], tensor)


def test_what_ranks_pieces_goes_with_one_map_and_not_with_a_mean(tmp_path: Path):
    base = write(tmp_path / "base.safetensors")
    ranking = write(tmp_path / "pieces.safetensors", replace(DEFAULT, pieces=True), add=1.0)
    one, mean = merge(base, maps=[ranking]).network, merge(ranking, maps=[ranking, base]).network
    assert one.affordance_pieces is not None
    assert ranking.network.affordance_pieces is not None
    assert torch.equal(one.affordance_pieces.gain, ranking.network.affordance_pieces.gain)
    assert mean.affordance_pieces is None
    assert merge(ranking).network.affordance_pieces is not None
    assert merge(ranking, maps=[base]).network.affordance_pieces is None


def test_what_does_not_fit_is_refused(tmp_path: Path):
    base = write(tmp_path / "base.safetensors")
    moved = write(tmp_path / "moved.safetensors", add=1.0, to="observer.")
    merge(base, maps=[moved])  # a map with a trunk of its own does not rest on it
    with pytest.raises(WeightsError, match="no"):
        merge(base, flow=base)
    with pytest.raises(WeightsError, match=r"flow head was trained behind another observer\."):
        merge(base, flow=write(tmp_path / "f.safetensors", replace(DEFAULT, flow=True), add=1.0, to="observer."))
    with pytest.raises(WeightsError, match=r"map was trained behind another encoder\."):
        merge(base, maps=[write(tmp_path / "e.safetensors", add=1.0, to="encoder.")])
    with pytest.raises(WeightsError, match="another shape"):
        merge(base, maps=[write(tmp_path / "wide.safetensors", replace(DEFAULT, width=64))])
    old = write(tmp_path / "old.safetensors", replace(DEFAULT, map_layers=0))
    with pytest.raises(WeightsError, match="no trunk of its own"):
        merge(old, maps=[old])
