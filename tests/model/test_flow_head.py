"""The flow head: shapes, what is missing, and that only weights with one have one."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from quest.errors import ConfigError
from quest.model.config import NetworkConfig
from quest.model.flow_head import REST, FlowHead
from tests.tiny import DEFAULT, make_frames, make_network

FLAT = replace(DEFAULT, points3d=False)
"""As the published network's: embeddings are all there is."""

CONFIGS = pytest.mark.parametrize("config", [DEFAULT, FLAT], ids=lambda c: f"points3d {c.points3d}")


def inputs(config: NetworkConfig, *, frames: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    embedding = torch.randn(2, frames, 3, config.width, generator=generator)
    return embedding, torch.randn(2, frames, 3, 3, generator=generator)


def fresh(config: NetworkConfig) -> FlowHead:
    return FlowHead(config.width, window=config.window, points3d=config.points3d)


def lively(config: NetworkConfig) -> FlowHead:
    """A head whose last layer says something."""
    head = make_network(replace(config, flow=True)).flow
    assert head is not None
    return head


@CONFIGS
def test_it_starts_by_saying_that_nothing_moves(config: NetworkConfig):
    assert (fresh(config)(*inputs(config)) == 0).all()


@CONFIGS
def test_one_displacement_per_query(config: NetworkConfig):
    flow = lively(config)(*inputs(config))
    assert flow.shape == (2, 3, 3)
    assert flow.isfinite().all()
    assert (flow != 0).any()


@CONFIGS
def test_what_hardly_moves_rests(config: NetworkConfig):
    """Each query by itself, and not while the head learns."""
    head, (embedding, point) = lively(config), inputs(config)
    raw = head.train()(embedding, point)
    length = raw.norm(dim=-1)
    with torch.no_grad():
        final = head.out[-1]
        assert isinstance(final, torch.nn.Linear)
        shrink = REST / length.median()
        final.weight *= shrink
        final.bias *= shrink
    raw, settled = head(embedding, point), head.eval()(embedding, point)
    still = raw.norm(dim=-1) < REST
    assert still.any()
    assert not still.all()
    assert (settled[still] == 0).all()
    assert (settled[~still] == raw[~still]).all()


@CONFIGS
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_before_there_are_enough_frames_the_oldest_stands_for_them(config: NetworkConfig, frames: int):
    embedding, point = inputs(config, frames=frames)
    head = lively(config)
    repeated = [torch.cat((x[:, :1].expand(-1, 4 - frames, -1, -1), x), dim=1) for x in (embedding, point)]
    torch.testing.assert_close(head(embedding, point), head(*repeated))


@CONFIGS
def test_points_that_are_not_lifted(config: NetworkConfig):
    embedding, point = inputs(config)
    point[0, 1, 0] = torch.nan
    point[1] = torch.nan
    point.requires_grad_()
    head = lively(config)
    flow = head(embedding, point)
    assert flow.isfinite().all()
    flow.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in head.parameters())


def test_only_steps_count_not_places():
    embedding, point = inputs(DEFAULT)
    head = lively(DEFAULT)
    torch.testing.assert_close(head(embedding, point + 2.5), head(embedding, point), rtol=1e-3, atol=1e-4)


@CONFIGS
def test_queries_do_not_know_of_each_other(config: NetworkConfig):
    embedding, point = inputs(config)
    head, order = lively(config), torch.tensor([2, 0, 1])
    torch.testing.assert_close(head(embedding[:, :, order], point[:, :, order]), head(embedding, point)[:, order])


@CONFIGS
def test_the_network_displaces(config: NetworkConfig):
    network, frames = make_network(replace(config, flow=True)), make_frames(config)
    observed = network.observe(frames)
    uv = torch.full((2, 3, 2), 0.4)
    label = torch.zeros(2, 3, dtype=torch.long)
    anchor = network.bind(observed.during(slice(0, 1)), uv, torch.zeros(2, 3, 3), label, label == 0)
    seen = network.decode(anchor, observed)
    assert network.displace(seen.embedding, seen.point).shape == (2, 3, 3)
    with pytest.raises(ConfigError, match="stage 2"):
        make_network(config).displace(seen.embedding, seen.point)


@pytest.mark.slow
def test_it_learns_to_go_on():
    """Steady motion of any size and direction goes on, rest stays rest; embeddings tell nothing here."""
    torch.manual_seed(0)
    head = fresh(DEFAULT)
    optimizer = torch.optim.AdamW(head.parameters(), lr=3e-3)
    time = torch.arange(5.0)[:, None, None]

    def error() -> tuple[torch.Tensor, torch.Tensor]:
        step = 0.1 * torch.randn(16, 1, 4, 3) * torch.rand(16, 1, 4, 1) * (torch.rand(16, 1, 4, 1) < 0.7)
        point = torch.randn(16, 1, 4, 3) + time * step
        flow = head(torch.randn(16, 4, 4, DEFAULT.width), point[:, :4])
        return (flow - step[:, 0]).abs().sum(-1).mean(), step.abs().sum(-1).mean()

    for _ in range(150):
        optimizer.zero_grad()
        error()[0].backward()
        optimizer.step()
    with torch.no_grad():
        left, zero = error()
    assert left < 0.3 * zero


def test_configurations_from_before_there_was_a_flow_head():
    values = json.loads(DEFAULT.to_json())
    assert values.pop("flow") is False
    assert NetworkConfig.from_json(json.dumps(values)) == DEFAULT
