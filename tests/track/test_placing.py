"""Whether a query is seen where the network sees it, once its link was seen turning."""

from __future__ import annotations

import numpy as np
import pytest

from quest.track import TrackerConfig
from quest.track.following import Following
from quest.track.placing import Placer
from tests.track.test_grounded import BLIND, COVERED, Sight
from tests.track.test_surface import DOOR_ORIGIN, ground_of_a_door

FAR = DOOR_ORIGIN + np.array([0.0, 0.5, -0.6])


def handle_on_a_door() -> Following:
    """Followed while the door opened by 0.8 radians."""
    ground, point = ground_of_a_door()
    return Following(0, "handle", None, None, ground, place=point)


def seen_at(query: Following, place: np.ndarray, frame: Sight, *, right: float = 0.6) -> float:
    placer = object.__new__(Placer)
    vars(placer).update(_following=[query], _evidence=[frame], _config=TrackerConfig(), _elapsed=1.0, _now=40.0)
    placer._seen, placer._right = np.array([0.9]), np.array([right])
    return placer._seen_at(0, place, query.ground.residual(place))


def test_what_the_hinge_cannot_bring_somewhere_is_not_seen_there_unless_the_network_insists():
    query = handle_on_a_door()
    assert query.place is not None
    assert seen_at(query, query.place, BLIND) == pytest.approx(0.9)
    said = [seen_at(query, FAR, BLIND) for _ in range(31)]
    assert max(said[:30]) <= 0.2
    assert said[30] == pytest.approx(0.9)
    assert not query.buried


def test_what_the_network_is_sure_of_is_seen_off_the_turn_too():
    query = handle_on_a_door()
    assert seen_at(query, FAR, BLIND, right=0.85) == pytest.approx(0.9)


def test_where_the_front_is_not_in_sight_less_is_enough():
    query = handle_on_a_door()
    query.ground.face(None, elapsed=1.0)
    assert seen_at(query, FAR, BLIND) == pytest.approx(0.9)
    assert seen_at(query, FAR, BLIND, right=0.4) <= 0.2


def test_what_comes_before_the_places_of_a_hinge_buries_the_query():
    """So that it moves on as it moved, instead of being held as hidden by its own link."""
    query = handle_on_a_door()
    assert seen_at(query, FAR, COVERED) <= 0.2
    assert query.buried
