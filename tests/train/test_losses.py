"""Every loss against a plain loop, with two batch elements, masks and NaN."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from quest.errors import ConfigError
from quest.model.affordance import AffordanceMap
from quest.model.joint_head import JointBelief
from quest.train import losses
from tests.tolerances import LOSS, approx

B, T, K, C = 2, 4, 3, 8


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


def test_heatmap_loss():
    logits, uv = torch.randn(B, T, K, C * C, requires_grad=True), torch.rand(B, T, K, 2)
    weight = some_mask() * torch.where(torch.rand(B, T, K) < 0.5, 1.0, 0.3)
    uv[weight == 0] = math.nan
    total, norm = 0.0, 0.0
    for b in range(B):
        for t in range(T):
            for k in range(K):
                w = float(weight[b, t, k])
                if w == 0:
                    continue
                x, y = (uv[b, t, k] * C).tolist()
                blob = [
                    math.exp(-0.5 * (((i % C) + 0.5 - x) ** 2 + ((i // C) + 0.5 - y) ** 2) / 0.6**2)
                    for i in range(C * C)
                ]
                log_p = logits[b, t, k].detach().log_softmax(-1).tolist()
                total -= w * sum(p / sum(blob) * q for p, q in zip(blob, log_p, strict=True))
                norm += w
    loss = losses.heatmap_loss(logits, uv, weight, cells=C)
    assert float(loss.detach()) == approx(total / norm, LOSS)
    lives(loss, logits)


def test_heatmap_loss_is_least_at_the_truth():
    uv = torch.tensor([[0.3, 0.7]])
    at = [torch.zeros(1, C * C) for _ in range(2)]
    at[0][0, 5 * C + 2], at[1][0, 2 * C + 5] = 9.0, 9.0
    right, swapped = (losses.heatmap_loss(x, uv, torch.ones(1), cells=C) for x in at)
    assert right < swapped


def test_point_loss():
    point, target, unit, mask = track()
    expected = []
    for b, t, k in mask.nonzero().tolist():
        error = (point[b, t, k] - target[b, t, k]).detach() / unit[b]
        if error.isfinite().all():
            expected.append(sum(huber(e, 0.05) for e in error.tolist()) / 0.05)
    loss = losses.point_loss(point, target, unit, mask)
    assert float(loss.detach()) == approx(mean(expected), LOSS)
    lives(loss, point)
    assert losses.point_loss(target, target, unit, mask) == 0


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


@pytest.mark.parametrize("purposes", [1, 2])
def test_affordance_loss(purposes: int):
    logits = torch.randn(B, C * C, 4, purposes, requires_grad=True)
    offset = torch.randn(B, C * C, purposes, 2, requires_grad=True)
    uv, label = torch.rand(B, K, 2), torch.tensor([[0, 0, 3], [1, 2, 2]])
    visible = torch.tensor([[True, True, False], [True, False, True]])
    intent = torch.tensor([[0, 1, 0], [0, 0, 1]])
    uv[~visible] = math.nan
    total, positives, residuals = 0.0, 0, [[] for _ in range(purposes)]
    p = logits.detach().sigmoid()
    for b in range(B):
        told = intent[b] if purposes == 2 else torch.zeros_like(intent[b])
        for i, n, m in itertools.product(range(C * C), range(4), range(purposes)):
            y = 0.0
            for k in range(K):
                if not visible[b, k] or label[b, k] != n or told[k] != m:
                    continue
                px, py = (uv[b, k] * C).tolist()
                gap = (i % C + 0.5 - px) ** 2 + (i // C + 0.5 - py) ** 2
                y = max(y, 1.0 if i == int(py) * C + int(px) else math.exp(-0.5 * gap / 0.8**2))
            q = float(p[b, i, n, m])
            positives += y == 1.0
            total -= (1 - q) ** 2 * math.log(q) if y == 1.0 else (1 - y) ** 4 * q**2 * math.log(1 - q)
        for i, m in itertools.product(range(C * C), range(purposes)):
            gaps = [
                (uv[b, k] * C - torch.tensor([i % C + 0.5, i // C + 0.5])).tolist()
                for k in range(K)
                if visible[b, k] and told[k] == m
            ]
            gap = min(gaps, key=lambda g: max(map(abs, g)), default=[math.inf, math.inf])
            if max(map(abs, gap)) < 1.5:
                residuals[m].append(sum(abs(o - g) for o, g in zip(offset[b, i, m].tolist(), gap, strict=True)))
    found = AffordanceMap(logits[:, None], offset[:, None])
    loss = losses.affordance_loss(found, uv[:, None], label, intent, visible[:, None])
    assert float(loss.detach()) == approx(total / positives + 0.5 * mean([mean(r) for r in residuals]), LOSS)
    lives(loss, logits, offset)


def test_affordance_loss_of_an_empty_and_of_a_perfect_map():
    uv, label, intent = torch.tensor([[[[0.3, 0.7]]]]), torch.tensor([[2]]), torch.tensor([[1]])
    quiet = AffordanceMap(torch.full((1, 1, C * C, 4, 2), -20.0), torch.zeros(1, 1, C * C, 2, 2))
    perfect = AffordanceMap(quiet.logits.clone(), quiet.offset.clone())
    perfect.logits[0, 0, 5 * C + 2, 2, 1] = 20.0
    for x, y in itertools.product((1, 2, 3), (4, 5, 6)):
        perfect.offset[0, 0, y * C + x, 1] = torch.tensor([2.4 - 0.5 - x, 5.6 - 0.5 - y])
    none, seen = torch.tensor([[[False]]]), torch.tensor([[[True]]])
    assert losses.affordance_loss(quiet, uv, label, intent, none) == approx(0, LOSS)
    assert losses.affordance_loss(perfect, uv, label, intent, seen) == pytest.approx(0, abs=1e-4)
    assert losses.affordance_loss(quiet, uv, label, intent, seen) > 1


def test_every_cell_of_a_rim_or_front_points_to_it():
    uv = torch.tensor([[[[0.3, 0.7], [0.9, 0.1], [0.9, 0.5]]]])
    label, intent, visible = torch.tensor([[2, 3, 0]]), torch.tensor([[0, 1, 0]]), torch.ones(1, 1, 3, dtype=torch.bool)
    found = AffordanceMap(torch.randn(1, 1, C * C, 4, 2), torch.randn(1, 1, C * C, 2, 2))
    owner = torch.full((1, 1, C * C), -1)
    cells = {0: [(2, 2), (3, 4), (7, 7)], 1: [(0, 0), (6, 5)]}
    for k, places in cells.items():
        for x, y in places:
            owner[0, 0, y * C + x] = k
    far = []
    for k, places in cells.items():
        gaps = {(x, y): uv[0, 0, k] * C - torch.tensor([x + 0.5, y + 0.5]) for x, y in places}
        beside = [uv[0, 0, n] * C for n in range(3) if intent[0, n] == intent[0, k]]
        own = [
            float((found.offset[0, 0, y * C + x, k] - gap).abs().sum())
            for (x, y), gap in gaps.items()
            if all((b - torch.tensor([x + 0.5, y + 0.5])).abs().max() >= 1.5 for b in beside)
        ]
        assert len(own) == 2  # one cell of each lies beside an entity, which counts more
        far.append(mean(own))
    plain = losses.affordance_loss(found, uv, label, intent, visible)
    more = losses.affordance_loss(found, uv, label, intent, visible, owner)
    assert float(more - plain) == approx(0.5 * losses.FAR_WEIGHT * mean(far), LOSS)
    # Any cell of a handle may score like its middle; those of rims and fronts may not.
    owner[0, 0, 3 * C + 1] = 2
    found.logits[0, 0, 3 * C + 1, 0, 0] += 9
    assert losses.affordance_loss(found, uv, label, intent, visible) > plain + 1
    assert losses.affordance_loss(found, uv, label, intent, visible, owner) == pytest.approx(float(more), abs=1)
    found.logits[0, 0, 3 * C + 1, 0, 0] -= 9
    owner[0, 0, 3 * C + 1] = -1
    # The middle of what is not seen cannot be told.
    visible[0, 0, 1] = False
    less = losses.affordance_loss(found, uv, label, intent, visible, owner)
    alone = losses.affordance_loss(found, uv, label, intent, visible)
    assert float(less - alone) == approx(0.5 * losses.FAR_WEIGHT * far[0] / 2, LOSS)


def joints() -> tuple[JointBelief, Tensor, Tensor, Tensor, Tensor]:
    """A belief, true points and axes, kinds and a mask."""
    unit = torch.nn.functional.normalize
    belief = JointBelief(
        torch.randn(B, T, K),
        unit(torch.randn(B, T, K, 3), dim=-1),
        unit(torch.randn(B, T, K, 3), dim=-1),
        torch.randn(B, T, K, 3),
        torch.randn(B, T, K, 3),
    )
    axis = torch.cat((torch.randn(B, K, 3), unit(torch.randn(B, K, 3), dim=-1)), dim=-1)
    return belief, torch.randn(B, T, K, 3), axis, torch.rand(B, K) < 0.5, some_mask()


def test_joint_loss_against_a_plain_loop():
    belief, point, axis, revolute, mask = joints()
    expected = []
    for b, t, k in mask.nonzero().tolist():
        origin, direction = axis[b, k, :3], axis[b, k, 3:]
        logit, spread = belief.revolute_logit[b, t, k], belief.log_spread[b, t, k]
        value = math.log1p(math.exp(-logit if revolute[b, k] else logit))
        used = belief.turn_axis if revolute[b, k] else belief.slide_axis
        sine = math.sqrt(max(0.0, 1 - float(used[b, t, k] @ direction) ** 2))
        log = float(spread[1] if revolute[b, k] else spread[0])
        value += sine * math.exp(-log) + 2 * log
        if revolute[b, k]:
            foot = origin + ((point[b, t, k] - origin) @ direction) * direction
            gap = float((belief.foot[b, t, k] - (foot - point[b, t, k])).norm())
            value += gap * math.exp(-float(spread[2])) + 3 * float(spread[2])
        expected.append(value)
    assert float(losses.joint_loss(belief, point, axis, revolute, mask)) == approx(mean(expected), LOSS)


def test_joint_loss_does_not_know_the_sign_of_an_axis():
    belief, point, axis, revolute, mask = joints()
    flipped = replace(belief, slide_axis=-belief.slide_axis, turn_axis=-belief.turn_axis)
    point[~mask] = math.nan
    torch.testing.assert_close(
        losses.joint_loss(belief, point, axis, revolute, mask), losses.joint_loss(flipped, point, axis, revolute, mask)
    )


def test_weights_come_from_the_table():
    table = {"near": losses.Loss(2.0, lambda _: torch.zeros(())), "far": losses.Loss(0.5, lambda _: torch.zeros(()))}
    assert losses.weights_of(table, {}) == {"near": 2.0, "far": 0.5}
    assert losses.weights_of(table, {"far": 0}) == {"near": 2.0, "far": 0.0}
    with pytest.raises(ConfigError, match="no 'fra'; expected some of near, far"):
        losses.weights_of(table, {"fra": 1.0})
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="far to be at least 0"):
            losses.weights_of(table, {"far": wrong})
