"""Signals that tell of other queries."""

from __future__ import annotations

import numpy as np
import pytest

from quest.track.measuring import _rivals

HERE, NOWHERE = np.array([0.0, 0.0, 1.0]), np.full(3, np.nan)


def test_who_comes_to_where_another_is_closes_in_on_it():
    home = np.array([[0.0, 0, 1], [0.4, 0, 1], [0.0, 0.4, 1]])
    place = np.array([[0.4, 0, 1], [0.4, 0, 1], [0.0, 0.4, 1]])
    closing, lead = _rivals(place, home, np.array([-1.0, 2.0, 5.0]))
    assert closing[:2] == pytest.approx(np.log(0.02 / 0.42))
    assert closing[2] == pytest.approx(0.0), "farther than it was from the first, as far as it was from the second"
    assert lead[:2].tolist() == [-3.0, 3.0]


def test_entities_that_move_together_do_not_close():
    home = np.array([[0.0, 0, 1], [0.05, 0, 1]])
    closing, _ = _rivals(home + np.array([0.5, 0.2, -0.1]), home, np.zeros(2))
    assert closing == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize(
    ("place", "home"),
    [
        ([HERE], [HERE]),
        ([HERE, NOWHERE], [HERE, HERE]),
        ([HERE, HERE], [HERE, NOWHERE]),
    ],
    ids=["alone", "the other is nowhere", "the other has just been bound"],
)
def test_without_another_nothing_is_known(place: list, home: list):
    closing, lead = _rivals(np.array(place), np.array(home), np.zeros(len(place)))
    assert np.isnan(closing[0])
    assert np.isnan(lead[0])
