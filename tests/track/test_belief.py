"""The recursion that carries where an entity may be from frame to frame."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from quest.errors import ConfigError, WeightsError
from quest.track.belief import Belief, moved, update
from quest.track.settings import TrackerConfig
from tests.tolerances import NETWORK, NETWORK_DEEP

SIDE = 8
CONFIG = TrackerConfig(move_sigma=0.15, jump=0.02, temperature=1.5)


def grid() -> Tensor:
    """Centres of the cells in [-1, 1]^2."""
    side = (torch.arange(SIDE) + 0.5) * 2 / SIDE - 1
    y, x = torch.meshgrid(side, side, indexing="ij")
    return torch.stack((x, y), dim=-1).reshape(-1, 2)


def plane(*, shift: float = 0.0) -> Tensor:
    """Points of the cells on a plane; ``shift`` is how far the camera looks aside."""
    uv = grid()
    return torch.cat((uv + torch.tensor([shift, 0.0]), torch.zeros(len(uv), 1)), dim=-1)


def peaked(*cells: int, height: float = 8.0) -> Tensor:
    logits = torch.zeros(len(cells), SIDE * SIDE)
    logits[range(len(cells)), list(cells)] = height
    return logits


def step(
    belief: Belief | None,
    logits: Tensor,
    *,
    seen: float = 1.0,
    point: Tensor | None = None,
    favour: Tensor | None = None,
) -> Belief:
    where = plane() if point is None else point
    favour = torch.zeros_like(logits) if favour is None else favour
    prior = None if belief is None else moved(belief, where, grid(), CONFIG.move_sigma)
    return Belief(update(prior, logits, torch.full((len(logits),), seen), favour, CONFIG), where)


def best(belief: Belief) -> list[int]:
    return belief.probability.argmax(dim=-1).tolist()


def test_probabilities_sum_to_one():
    torch.manual_seed(0)
    belief = None
    for t in range(5):
        point = plane()
        point[torch.rand(SIDE * SIDE) < 0.3 * t] = torch.nan
        belief = step(belief, 20 * torch.randn(3, SIDE * SIDE), point=point)
        assert belief.probability.isfinite().all()
        assert (belief.probability >= 0).all()
        torch.testing.assert_close(belief.probability.sum(-1), torch.ones(3))


def test_the_first_frame_decides_alone():
    logits = torch.randn(2, SIDE * SIDE)
    torch.testing.assert_close(step(None, logits).probability, (logits / CONFIG.temperature).softmax(-1))


def test_against_a_plain_loop():
    torch.manual_seed(0)
    before, point = step(None, torch.randn(1, SIDE * SIDE)), plane()
    point[3] = torch.nan
    logits, seen = torch.randn(1, SIDE * SIDE), 0.7
    after = step(before, logits, seen=seen, point=point)
    n, uv = SIDE * SIDE, grid()
    prior = torch.full((n,), CONFIG.jump / n)
    for i in range(n):
        gap = torch.stack(
            [(uv[i] - uv[j]).norm() if j == 3 else (before.cell_point[i] - point[j]).norm() for j in range(n)]
        )
        prior += (1 - CONFIG.jump) * before.probability[0, i] * (-0.5 * (gap / CONFIG.move_sigma) ** 2).softmax(-1)
    expected = (seen * (logits[0] / CONFIG.temperature).log_softmax(-1)).exp() * prior
    torch.testing.assert_close(after.probability[0], expected / expected.sum(), **NETWORK_DEEP)


def test_follows_a_peak_that_moves():
    belief = None
    for column in range(6):
        belief = step(belief, peaked(3 * SIDE + column))
        assert best(belief) == [3 * SIDE + column]


def test_a_look_alike_far_away_does_not_win_at_once():
    own, other = 3 * SIDE + 1, 5 * SIDE + 7
    belief = step(None, peaked(own))
    both = peaked(own, height=6.0)
    both[0, other] = 6.5
    for _ in range(3):
        belief = step(belief, both)
        assert best(belief) == [own]
    assert both.argmax() == other


def test_a_wrong_belief_is_left_again():
    belief = step(None, peaked(0, height=30.0))
    far = SIDE * SIDE - 1
    for _ in range(3):
        belief = step(belief, peaked(far, height=12.0))
    assert best(belief) == [far]


def test_a_hidden_entity_stays_where_it_was():
    own, other = 3 * SIDE + 1, 5 * SIDE + 7
    belief = step(step(None, peaked(own)), peaked(other, height=8.0), seen=0.0)
    assert best(belief) == [own]


def test_queries_do_not_meet():
    torch.manual_seed(0)
    first, second = torch.randn(3, SIDE * SIDE), torch.randn(3, SIDE * SIDE)
    together = step(step(None, first), second)
    alone = step(step(None, first[1:2]), second[1:2])
    torch.testing.assert_close(together.probability[1:2], alone.probability, **NETWORK)


def test_a_moving_camera_is_accounted_for():
    """The same place is one cell further left when the camera has turned by one cell: no motion in the world."""
    cell = 2 / SIDE
    belief = step(None, peaked(3 * SIDE + 4, height=30.0))
    nothing = torch.zeros(1, SIDE * SIDE)
    turned = step(belief, nothing, point=plane(shift=cell))
    assert best(turned) == [3 * SIDE + 3]
    blind = torch.full((SIDE * SIDE, 3), torch.nan)
    assert best(step(belief, nothing, point=blind)) == [3 * SIDE + 4], "without depth the image decides"


@pytest.mark.parametrize(
    "changes", [{"move_sigma": 0.0}, {"jump": 0.0}, {"jump": 1.0}, {"temperature": 0.0}, {"point_sigma": 0.0}]
)
def test_settings_out_of_range(changes: dict):
    with pytest.raises(ConfigError):
        TrackerConfig(**changes)


def test_settings_round_trip():
    config = TrackerConfig(jump=0.1, slot_bias=1.5)
    assert TrackerConfig.from_json(config.to_json()) == config
    assert TrackerConfig.from_json("{}") == TrackerConfig()


@pytest.mark.parametrize("text", ["", "[]", "[1]", "3", '{"colour": 1}', '{"jump": 2}', '{"jump": "x"}'])
def test_foreign_settings_are_refused(text: str):
    with pytest.raises(WeightsError):
        TrackerConfig.from_json(text)


def test_longer_gaps_let_things_move_farther():
    logits = peaked(0, height=30.0)
    before = step(None, logits)
    near, far = (moved(before, plane(), grid(), sigma)[0] for sigma in (0.1, 0.5))
    assert far[SIDE * SIDE - 1] > near[SIDE * SIDE - 1]
    torch.testing.assert_close(far.sum(), torch.tensor(1.0))


def test_what_else_is_known_decides_between_equals():
    """Two cells look the same; the joint reaches only one of them."""
    favour = torch.full((1, SIDE * SIDE), -4.0)
    favour[0, 9] = 0.0
    logits = torch.zeros(1, SIDE * SIDE)
    logits[0, [9, 54]] = 8.0
    belief = step(step(None, logits), logits, favour=favour)
    assert best(belief) == [9]
