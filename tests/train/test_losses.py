"""Every loss against a plain loop, with two batch elements, masks and NaN."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from quest.errors import ConfigError
from quest.train import losses
from tests.tolerances import LOSS, approx

B, T, K = 2, 4, 3


@pytest.fixture(autouse=True)
def _seed():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def some_mask() -> Tensor:
    mask = torch.rand(B, T, K) < 0.6
    mask[0, :, 1] = False
    mask[:, 1, 0] = True
    return mask


def track() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Predicted and true points, units and mask; some of both are missing."""
    point, target = 0.3 * torch.randn(B, T, K, 3), 0.3 * torch.randn(B, T, K, 3)
    point[0, 2, 0] = math.nan
    target[1, 1, 2, 1] = math.nan
    return point.requires_grad_(), target, torch.tensor([0.5, 2.0]), some_mask()


def mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def huber(x: float, delta: float) -> float:
    return 0.5 * x * x if abs(x) <= delta else delta * (abs(x) - 0.5 * delta)


def lives(loss: Tensor, *inputs: Tensor) -> None:
    """The gradient flows, and NaN does not leak into it."""
    loss.backward()
    for tensor in inputs:
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
        assert tensor.grad.abs().sum() > 0


def test_masked_mean():
    value = torch.tensor([1.0, math.nan, 3.0, 5.0])
    assert losses.masked_mean(value, torch.tensor([True, False, True, False])) == 2.0
    assert losses.masked_mean(value, torch.tensor([1.0, 0.0, 0.5, 0.5])) == pytest.approx((1 + 1.5 + 2.5) / 2)
    assert losses.masked_mean(value, torch.zeros(4)) == 0.0
    assert losses.masked_mean(torch.zeros(0), torch.zeros(0)) == 0.0


def test_coordinate_loss():
    uv, target, mask = torch.rand(B, T, K, 2, requires_grad=True), torch.rand(B, T, K, 2), some_mask()
    target[~mask] = math.nan
    expected = [
        sum(huber(float((uv[i][c] - target[i][c]).detach()), 0.01) / 0.01 for c in range(2))
        for i in mask.nonzero().split(1)
        for i in [tuple(i[0].tolist())]
    ]
    loss = losses.coordinate_loss(uv, target, mask)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    lives(loss, uv)
    assert uv.grad is not None
    assert (uv.grad[~mask] == 0).all()
    assert losses.coordinate_loss(target, target, mask) == 0


@pytest.mark.parametrize("order", [1, 2])
def test_difference_loss(order: int):
    point, target, unit, mask = track()
    expected = []
    for b in range(B):
        for k in range(K):
            for t in range(order, T):
                frames = range(t - order, t + 1)
                error = [((point - target)[b, f, k] / unit[b]).detach() for f in frames]
                if not all(
                    bool(mask[b, f, k]) and bool(e.isfinite().all()) for f, e in zip(frames, error, strict=True)
                ):
                    continue
                d = error[1] - error[0] if order == 1 else error[2] - 2 * error[1] + error[0]
                expected.append(sum(min(abs(x), 0.5) for x in d.tolist()))
    loss = losses.difference_loss(point, target, unit, mask, order=order)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    still = (target + torch.tensor([0.1, -0.2, 0.3])).nan_to_num()
    assert losses.difference_loss(still, target, unit, mask, order=order) == approx(0, LOSS)
    small = (target.nan_to_num() + 0.01 * torch.randn_like(target)).requires_grad_()
    lives(losses.difference_loss(small, target, unit, torch.ones_like(mask), order=order), small)


def test_a_window_too_short_for_differences_has_none():
    point, target, unit, mask = track()
    assert losses.difference_loss(point[:, :1], target[:, :1], unit, mask[:, :1], order=1) == 0
    assert losses.difference_loss(point[:, :2], target[:, :2], unit, mask[:, :2], order=2) == 0


def test_confidence_loss():
    logit, target, mask = torch.randn(B, T, K, requires_grad=True), torch.rand(B, T, K) < 0.5, some_mask()
    expected = [
        -math.log(1 / (1 + math.exp(-float(logit[i].detach()) * (1 if target[i] else -1))))
        for i in map(tuple, mask.nonzero().tolist())
    ]
    loss = losses.confidence_loss(logit, target, mask)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    lives(loss, logit)
    sure = torch.where(target, 50.0, -50.0)
    assert losses.confidence_loss(sure, target, mask) == approx(0, LOSS)


def test_bound_loss():
    uv, mask = 3 * torch.rand(B, T, K, 2) - 1, some_mask()
    uv.requires_grad_()
    expected = [
        sum(max(0.0, -x) + max(0.0, x - 1) for x in uv[b, t, k].tolist()) for b, t, k in mask.nonzero().tolist()
    ]
    loss = losses.bound_loss(uv, mask)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    lives(loss, uv)
    assert losses.bound_loss(torch.rand(B, T, K, 2), mask) == 0


def test_feature_loss():
    embedding = torch.randn(B, T, K, 5, requires_grad=True)
    mask = torch.tensor([[True, False, True], [False, True, True]])
    expected = []
    for b, k in mask.nonzero().tolist():
        for t in range(1, T):
            x, y = embedding[b, t, k].detach(), embedding[b, t - 1, k].detach()
            expected.append(1 - float(x @ y / x.norm() / y.norm()))
    loss = losses.feature_loss(embedding, mask)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    lives(loss, embedding)
    same = embedding.detach()[:, :1].expand(-1, T, -1, -1)
    assert losses.feature_loss(same, mask) == approx(0, LOSS)


def screws() -> tuple[Tensor, Tensor, Tensor]:
    """Rest points, axes and whether they turn: all kinds in both batch elements."""
    direction = torch.nn.functional.normalize(torch.randn(B, K, 3), dim=-1)
    revolute = torch.tensor([[True, False, True], [False, True, False]])
    return torch.randn(B, K, 3), torch.cat((torch.randn(B, K, 3), direction), -1), revolute


def moved(rest: Tensor, axis: Tensor, amount: float, turns: bool) -> Tensor:
    origin, direction = axis[:3], axis[3:]
    if not turns:
        return rest + amount * direction
    arm = rest - origin
    along = (arm @ direction) * direction
    side = torch.linalg.cross(direction, arm)
    return origin + along + (arm - along) * math.cos(amount) + side * math.sin(amount)


def on_their_way(rest: Tensor, axis: Tensor, revolute: Tensor) -> Tensor:
    point = torch.zeros(B, T, K, 3)
    for b in range(B):
        for t in range(T):
            for k in range(K):
                point[b, t, k] = moved(rest[b, k], axis[b, k], 0.4 * t - 0.3, bool(revolute[b, k]))
    return point


def test_manifold_loss_is_zero_on_the_circle_and_on_the_line():
    rest, axis, revolute = screws()
    point, unit = on_their_way(rest, axis, revolute), torch.tensor([0.5, 2.0])
    mask = torch.ones(B, T, K, dtype=torch.bool)
    assert losses.manifold_loss(point, rest, axis, revolute, unit, mask) < 1e-3
    assert losses.manifold_loss(point, rest, axis, ~revolute, unit, mask) > 0.05


def test_manifold_loss():
    rest, axis, revolute = screws()
    point, unit, mask = (
        on_their_way(rest, axis, revolute) + 0.05 * torch.randn(B, T, K, 3),
        torch.tensor([0.5, 2.0]),
        some_mask(),
    )
    point[1, 0, 0] = math.nan
    expected = []
    for b, t, k in mask.nonzero().tolist():
        p, r, o, d = point[b, t, k], rest[b, k], axis[b, k, :3], axis[b, k, 3:]
        if p.isnan().any():
            continue
        if revolute[b, k]:
            radius = [(q - o - ((q - o) @ d) * d).norm() for q in (p, r)]
            gap = ((((p - r) @ d) ** 2) + (radius[0] - radius[1]) ** 2).sqrt()
        else:
            gap = (p - r - ((p - r) @ d) * d).norm()
        expected.append(min(float(gap / unit[b]), 0.5))
    point.requires_grad_()
    loss = losses.manifold_loss(point, rest, axis, revolute, unit, mask)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    lives(loss, point)


def test_manifold_of_what_is_fixed_is_its_place():
    rest, ones = torch.tensor([[[0.1, 0.2, 0.3]]]), torch.ones(1, 1, 1) > 0
    point = rest[:, None] + torch.tensor([0.3, 0.0, 0.4])
    loss = losses.manifold_loss(point, rest, torch.zeros(1, 1, 6), ~ones[0], torch.tensor([2.0]), ones)
    assert float(loss) == pytest.approx(0.25)


def test_weights_come_from_the_table():
    table = {"near": losses.Loss(2.0, lambda _: torch.zeros(())), "far": losses.Loss(0.5, lambda _: torch.zeros(()))}
    assert losses.weights_of(table, {}) == {"near": 2.0, "far": 0.5}
    assert losses.weights_of(table, {"far": 0}) == {"near": 2.0, "far": 0.0}
    with pytest.raises(ConfigError, match="no 'fra'; expected some of near, far"):
        losses.weights_of(table, {"fra": 1.0})
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="far to be at least 0"):
            losses.weights_of(table, {"far": wrong})
