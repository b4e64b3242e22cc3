"""Whether what the network says it sees is believed: an entity that stands still, and what comes before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from quest.model.decoder import Prediction
from quest.track.following import Following
from quest.track.grounded import BeliefRow, Ground
from quest.track.placing import Placed, Placer
from quest.track.settings import TrackerConfig
from tests.tiny import DEFAULT, make_frames

WALL_M, DRAWER_M = 1.5, 1.46
HOME, SLID = (32.0, WALL_M), (35.0, DRAWER_M)
CONFIG = TrackerConfig(point_sigma=0.02)
ROW = BeliefRow(0.0, np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.4, 0.0, 0.0]), np.full(3, 0.2))


def frame(depth_m: float):
    """A frame in which everything is equally far."""
    frames = make_frames(batch=1, frames=1)
    return replace(frames, depth_m=torch.full_like(frames.depth_m, depth_m))


def at(x_px: float, depth_m: float) -> np.ndarray:
    """A point under a pixel of the middle row, in the reference frame."""
    uv_px = torch.tensor([[[[x_px, DEFAULT.encoder.image_size / 2]]]])
    return frame(WALL_M).to_reference(uv_px, torch.tensor([[[depth_m]]]))[0, 0, 0].double().numpy()


def standing() -> Following:
    """A query that has been seen at one place of the wall, and was carried a little way at last."""
    ground, home = Ground(CONFIG), at(*HOME)
    for _ in range(20):
        ground.see(home, ROW)
    return Following(0, "a", None, None, ground, place=at(34.0, WALL_M), home=home)


def placed(query: Following, candidate: np.ndarray, *, depth_m: float, seen: float, right: float) -> Placed:
    """The query in a frame, where the network answers with a candidate."""
    cells = DEFAULT.cells**2
    prediction = Prediction(
        embedding=torch.zeros(1, 1, 1, 1),
        logits=torch.zeros(1, 1, 1, cells),
        peak=torch.zeros(1, 1, 1, dtype=torch.long),
        uv=torch.full((1, 1, 1, 2), 0.5),
        point=torch.from_numpy(candidate).float()[None, None, None],
        visible_logit=torch.full((1, 1, 1), float(np.log(seen / (1 - seen)))),
        right_logit=torch.full((1, 1, 1), float(np.log(right / (1 - right)))),
    )
    placer = Placer([query], prediction, frame(depth_m), network=DEFAULT, config=CONFIG, elapsed=1.0)
    return placer.place(candidate[None], [ROW])


@pytest.mark.parametrize(("seen", "right"), [(0.55, 0.9), (0.9, 0.55)])
def test_what_opens_before_a_still_entity_does_not_carry_it_away(seen: float, right: float):
    """The answer slides over the drawer in small steps; the entity is held where it stood, not where it slid to."""
    query, slid = standing(), at(*SLID)
    assert np.linalg.norm(slid - query.place) < 0.12  # a small step
    found = placed(query, slid, depth_m=DRAWER_M, seen=seen, right=right)
    assert found.held.all()
    assert query.buried
    np.testing.assert_allclose(found.point[0], at(*HOME), atol=0.02)


def test_what_is_seen_plainly_is_followed():
    """A still entity that begins to move towards the camera also has something before where it stood: itself."""
    query, moved = standing(), at(*SLID)
    found = placed(query, moved, depth_m=DRAWER_M, seen=0.9, right=0.9)
    assert not found.held.any()
    np.testing.assert_allclose(found.point[0], moved, atol=0.05)


def test_nothing_before_it_nothing_held():
    query = standing()
    found = placed(query, at(36.0, WALL_M), depth_m=WALL_M, seen=0.55, right=0.55)
    assert not found.held.any()
    assert not query.buried
