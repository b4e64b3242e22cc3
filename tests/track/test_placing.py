"""Whether a query is seen where the network sees it, once its link was seen turning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from quest.model.decoder import Prediction
from quest.track import TrackerConfig
from quest.track.following import Following
from quest.track.placing import Placer
from tests.tiny import DEFAULT, make_frames
from tests.track.test_surface import DOOR_ORIGIN, ground_of_a_door, seen

FAR = DOOR_ORIGIN + np.array([0.0, 0.5, -0.6])
BLIND_M, COVERED_M = 0.0, 0.1
"""Depth of all pixels: none is known, or something stands in front of every place."""


def handle_on_a_door() -> Following:
    """Followed while the door opened by 0.8 radians."""
    ground, point = ground_of_a_door()
    return Following(0, "handle", None, ground, place=point)


def seen_at(query: Following, place: np.ndarray, depth_m: float, *, right: float = 0.6) -> float:
    """How probably the query is seen at a place where the network sees it with probability 0.9."""
    frames = make_frames(batch=1, frames=1)
    frames = replace(
        frames,
        depth_m=torch.full_like(frames.depth_m, depth_m),
        center=torch.zeros_like(frames.center),
        scale=torch.ones_like(frames.scale),
    )
    point = torch.from_numpy(place)[None, None, None]
    prediction = Prediction(
        embedding=torch.zeros(1, 1, 1, DEFAULT.width),
        logits=torch.zeros(1, 1, 1, DEFAULT.cells**2),  # no cell is likelier than another
        peak=torch.zeros(1, 1, 1, dtype=torch.long),
        uv=torch.full((1, 1, 1, 2), 0.5),
        point=point,
        visible_logit=torch.tensor([[[0.9]]], dtype=torch.float64).logit(),
        right_logit=torch.tensor([[[right]]], dtype=torch.float64).logit(),
    )
    size = float(DEFAULT.encoder.image_size)
    placer = Placer(
        [query],
        prediction,
        frames,
        network=DEFAULT,
        picture_px=(0.0, 0.0, size, size),
        config=TrackerConfig(),
        elapsed=1.0,
        now=40.0,
    )
    return float(placer.place(place[None], [seen(0.8)]).seen[0])


def test_what_the_hinge_cannot_bring_somewhere_is_not_seen_there_unless_the_network_insists():
    query = handle_on_a_door()
    assert query.place is not None
    assert seen_at(query, query.place, BLIND_M) == pytest.approx(0.9)
    said = [seen_at(query, FAR, BLIND_M) for _ in range(31)]
    assert max(said[:30]) <= 0.2
    assert said[30] == pytest.approx(0.9)
    assert not query.buried


def test_what_the_network_is_sure_of_is_seen_off_the_turn_too():
    query = handle_on_a_door()
    assert seen_at(query, FAR, BLIND_M, right=0.85) == pytest.approx(0.9)


def test_where_the_front_is_not_in_sight_less_is_enough():
    query = handle_on_a_door()
    query.ground.face(None, elapsed=1.0)
    assert seen_at(query, FAR, BLIND_M) == pytest.approx(0.9)
    assert seen_at(query, FAR, BLIND_M, right=0.4) <= 0.2


def test_what_comes_before_the_places_of_a_hinge_buries_the_query():
    """So that it moves on as it moved, instead of being held as hidden by its own link."""
    query = handle_on_a_door()
    assert seen_at(query, FAR, COVERED_M) <= 0.2
    assert query.buried
