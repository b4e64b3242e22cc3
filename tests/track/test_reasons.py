"""What is said of a loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quest.filter.picture import Picture
from quest.filter.queries import Queries
from quest.track.reasons import reason

AT = np.array([30.0, 30.0])


def queries(**changes: float) -> Queries:
    picture = Picture(np.zeros((64, 64), np.uint8), np.ones((2, 8, 8), np.float32))
    named = Queries.named(picture, AT[None], np.ones(1), np.zeros((1, 1, 3)), np.zeros((1, 3)))
    return replace(named, **{name: np.array([value]) for name, value in changes.items()}, rival_px=AT[None] + [3, 4])


def test_what_is_covered_is_told_apart_from_what_is_not_there():
    assert reason(queries(seen_log_odds=-4.0), 0, AT) == "behind something or out of view"
    gone = queries(seen_log_odds=-4.0, unseen_s=1.24, rival_log_odds=-1.0)
    assert reason(gone, 0, AT) == "not seen for 1.2 s where it should be; looks more like what is 5 px away"


def test_what_is_hardly_seen_says_so():
    assert reason(queries(seen_log_odds=0.5), 0, AT) == "looks little like its anchor"
