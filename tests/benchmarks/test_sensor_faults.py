"""Faults of a camera, and what is counted of them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.endurance import LASTS, PERIOD, faulty
from benchmarks.sensor_faults import AFTER, BEGIN, BLIND, DEGRADED, DEPTH, WITHIN, Player
from quest.types import Query
from tests.track.clips import make_clip, make_tracker

CLIP = make_clip(frames=BEGIN + LASTS + AFTER, size=(64, 48))


@pytest.mark.parametrize("name", [*BLIND, *DEGRADED, *DEPTH])
def test_faults_change_pictures_or_depth_and_keep_their_form(name: str) -> None:
    frame, last = CLIP.frame(9), CLIP.frame(2)
    rgb, depth_m = (BLIND | DEGRADED | DEPTH)[name](frame.rgb, frame.depth_m, last, np.random.default_rng(0))
    assert rgb.shape == frame.rgb.shape
    assert rgb.dtype == np.uint8
    if frame.depth_m is not None:
        assert depth_m is not None
        assert depth_m.shape == frame.depth_m.shape
        assert name in DEGRADED or name == "frozen" or (rgb != frame.rgb).any() or (depth_m != frame.depth_m).any()
    assert (BLIND | DEGRADED | DEPTH)[name](frame.rgb, None, last, np.random.default_rng(0))[1] is None


def test_a_covered_camera_is_flagged_and_nothing_is_tracked() -> None:
    player = Player("made up", "depth", CLIP, [Query.point(0, 20.0, 20.0)], make_tracker())
    found = player.play("covered, black", BLIND["covered, black"])
    assert found.flagged
    assert found.tracking == 0
    assert found.found <= found.queries <= 1
    assert player.frames == BEGIN - 2 + LASTS + AFTER
    assert WITHIN < LASTS


def test_a_long_run_fails_now_and_then() -> None:
    frame, last = CLIP.frame(9), CLIP.frame(8)
    assert faulty(frame, last, 3) is frame
    assert (faulty(frame, last, PERIOD - 1).rgb != frame.rgb).any()
