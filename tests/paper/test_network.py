"""The published network: its shape, what may influence an answer, and its file."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from quest.errors import ConfigError, WeightsError
from quest.model.encoder import EncoderConfig
from quest.model.frames import FrameBatch
from quest.model.weights import load_network
from quest.paper.network import PaperConfig, PaperNetwork, SlotAnswers, is_paper, read_paper
from quest.types import LABELS
from tests.paper.tiny import PAPER, make_paper
from tests.tiny import make_frames
from tests.tolerances import NETWORK_DEEP


@pytest.fixture(autouse=True)
def _no_grad():
    with torch.no_grad():
        yield


def parts(answers: SlotAnswers) -> dict[str, Tensor]:
    return {f.name: getattr(answers, f.name) for f in fields(SlotAnswers)}


def assert_same(got: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for name in expected:
        torch.testing.assert_close(
            got[name], expected[name], **NETWORK_DEEP, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.slow
def test_the_published_shape():
    torch.manual_seed(0)
    config = PaperConfig()
    assert (config.width, config.slots, config.decoder_layers, config.heads, config.window) == (384, 8, 2, 4, 4)
    network, frames = PaperNetwork(config).eval(), make_frames(config.encoder, batch=1, frames=2)
    features = network.encode(torch.randint(0, 256, (2, 224, 224, 3), dtype=torch.uint8))
    assert features.shape == (2, 196, 384)
    assert network.encoder.patch.weight.shape == (384, 3, 16, 16)
    assert network(replace(frames, features=features[None])).uv.shape == (1, 2, 8, 2)


def test_shapes():
    for frames in (1, 4):
        got = make_paper()(make_frames(frames=frames))
        shape = (2, frames, PAPER.slots)
        assert (got.uv.shape, got.point.shape) == ((*shape, 2), (*shape, 3))
        assert (got.logit.shape, got.label_logits.shape) == (shape, (*shape, len(LABELS)))
        assert got.uv.isfinite().all()


def test_batch_elements_are_independent():
    network, frames = make_paper(), make_frames(batch=3)
    whole = parts(network(frames))
    alone = FrameBatch(**{f.name: getattr(frames, f.name)[1:2] for f in fields(FrameBatch)})
    assert_same(parts(network(alone)), {name: value[1:2] for name, value in whole.items()})


def test_permuting_queries_permutes_answers():
    network, frames = make_paper(), make_frames()
    before, order = parts(network(frames)), torch.tensor([3, 0, 4, 1, 2])
    network.queries.copy_(network.queries[order])
    assert_same(parts(network(frames)), {name: value[:, :, order] for name, value in before.items()})


def test_a_clip_begins_as_a_window_begins():
    """The answer for a window's i-th frame is that for i frames: later ones do not change it."""
    network, frames = make_paper(), make_frames()
    whole = parts(network(frames))
    for t in range(1, 4):
        assert_same(parts(network(frames.during(slice(0, t)))), {n: v[:, :t] for n, v in whole.items()})


def test_earlier_frames_do_change_later_answers():
    network, frames = make_paper(), make_frames()
    alone = network(frames.during(slice(3, 4))).embedding
    assert not torch.allclose(network(frames).embedding[:, 3:], alone, atol=1e-4)


def test_slots_do_not_begin_alike():
    """Before any training: what they read from the tokens is the same, so it must not drown what they are."""
    torch.manual_seed(0)
    x = PaperNetwork(PAPER).eval().embed(make_frames(batch=1).features)[-1].embedding[0, -1]
    cosine = torch.nn.functional.cosine_similarity(x[:, None], x[None], dim=-1)
    assert (cosine - torch.eye(PAPER.slots)).max() < 0.7


def test_time_reaches_the_tokens_that_queries_look_at():
    network, features = make_paper(), make_frames().features[:, [2, 2, 2, 2]]
    same = network.embed(features)[-1].embedding
    assert not torch.allclose(same[:, 1:], same[:, :-1], atol=1e-4)
    torch.nn.init.zeros_(network.time)
    still = network.embed(features)[-1].embedding
    torch.testing.assert_close(still[:, 1:], still[:, :-1])


def test_places_off_the_map_are_where_a_query_looked():
    network, frames = make_paper(place_from="map"), make_frames()
    for layer in (network.head[1], network.head[3]):
        assert isinstance(layer, torch.nn.Linear)
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    got, grid = network(frames), PAPER.encoder.grid
    torch.testing.assert_close(got.where.sum(-1), torch.ones(got.where.shape[:3]))
    for k in range(PAPER.slots):
        expected = sum(
            (float(p) * torch.tensor([(n % grid + 0.5) / grid, (n // grid + 0.5) / grid])
             for n, p in enumerate(got.where[0, 1, k])), torch.zeros(2),
        )  # fmt: skip
        torch.testing.assert_close(got.uv[0, 1, k], expected, atol=1e-4, rtol=0)


def test_without_any_depth_pixels_stay_finite():
    got = make_paper()(make_frames(depth=False))
    assert got.uv.isfinite().all()
    assert got.point.isnan().all()


def test_the_network_displaces():
    network, frames = make_paper(flow=True), make_frames()
    got = network(frames)
    assert network.displace(got.embedding).shape == (2, PAPER.slots, 3)
    with pytest.raises(ConfigError, match="stage 2"):
        make_paper().displace(got.embedding)


def test_a_file_of_its_own(tmp_path: Path):
    network, path = make_paper(flow=True), tmp_path / "paper.safetensors"
    network.save(path, about="a test", licence="Apache-2.0")
    assert is_paper(path)
    loaded = read_paper(path)
    assert (loaded.network.config, loaded.about, loaded.licence) == (network.config, "a test", "Apache-2.0")
    assert not loaded.network.training
    for name, tensor in network.state_dict().items():
        assert torch.equal(loaded.network.state_dict()[name], tensor.half().float()), name
    with pytest.raises(WeightsError, match="preset paper"):
        load_network(path)


def test_a_file_that_shares_its_encoder(tmp_path: Path):
    network, whole, shares = make_paper(), tmp_path / "whole.safetensors", tmp_path / "shares.safetensors"
    network.save(whole, about="whole")
    other = make_paper()
    with torch.no_grad():
        other.queries.add_(1)
    other.save(shares, about="shares", beside=whole)
    assert shares.stat().st_size < whole.stat().st_size
    assert torch.equal(read_paper(shares).network.queries, other.queries.half().float())
    whole.unlink()
    with pytest.raises(WeightsError, match="not beside it"):
        read_paper(shares)


def test_configurations_come_back_and_older_ones_have_no_flow_head():
    for config in (PaperConfig(), PAPER):
        assert PaperConfig.from_json(config.to_json()) == config
    values = json.loads(PAPER.to_json())
    assert values.pop("flow") is False
    assert PaperConfig.from_json(json.dumps(values)) == PAPER


FOREIGN = (
    "", "{", "[]", "null", "3", "{}", '{"encoder": {}, "colour": 1}', '{"encoder": {"colour": 1}}', '{"encoder": 3}',
)  # fmt: skip
CONTRADICTIONS: tuple[dict[str, Any], ...] = (
    {"heads": 5}, {"cell_px": 0}, {"cell_px": 10}, {"window": 0}, {"slots": 0}, {"decoder_layers": 0},
    {"encoder": EncoderConfig(image_size=230)}, {"encoder": EncoderConfig(heads=5)}, {"place_from": "moon"},
)  # fmt: skip


def test_configurations_that_cannot_be():
    for text in FOREIGN:
        with pytest.raises(ConfigError):
            PaperConfig.from_json(text)
    for changes in CONTRADICTIONS:
        with pytest.raises(ConfigError, match="network"):
            replace(PaperConfig(), **changes)
