"""Tracking by detection with QueST's finder: what it finds, links and refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from quest.baselines.redetect import Detections, Redetect, link
from quest.data.cut import cut_clip
from quest.errors import ConfigError, InputError
from quest.types import LABELS, Clip, Query, State, Take
from tests.synthetic import make_take
from tests.track.clips import EAGER, make_tracker


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=16, views=2, entities=2, size=(64, 48))


class Scripted(Redetect):
    """Sees what it is told to see, by frame; nothing elsewhere."""

    def __init__(self, seen: dict[int, list[tuple[float, float]]]) -> None:
        super().__init__("redetect", make_tracker())
        self.seen = seen
        self.asked: list[int] = []

    def detect(self, clip: Clip, t: int) -> Detections:
        self.asked.append(t)
        uv_px = np.array(self.seen.get(t, []), np.float32).reshape(-1, 2)
        point = np.concatenate([uv_px / 100, np.full((len(uv_px), 1), 2.0)], axis=1).astype(np.float32)
        return Detections(uv_px, point, ("handle",) * len(uv_px), np.full(len(uv_px), 0.9, np.float32))


def test_detections_lie_in_the_image_and_above_the_threshold(take: Take) -> None:
    clip = take.views[0].clip
    found = Redetect("redetect", make_tracker(config=dataclasses.replace(EAGER, threshold=0.6), seed=1)).detect(clip, 0)
    everything = Redetect("redetect", make_tracker(seed=1)).detect(clip, 0)
    assert 0 < len(found.label) < len(everything.label)
    assert set(everything.label) <= set(LABELS)
    assert (found.confidence > 0.6).all()
    assert (everything.confidence.min() < 0.6) & (everything.confidence.max() == found.confidence.max())
    assert ((everything.uv_px >= 0) & (everything.uv_px <= (64, 48))).all()
    nothing = Redetect("redetect", make_tracker(config=dataclasses.replace(EAGER, bias=-100.0, threshold=0.5)))
    assert nothing.detect(clip, 0).uv_px.shape == (0, 2)


def test_link_makes_most_pairs_then_the_least_distance() -> None:
    gap = np.array([[0.1, 0.2, 9.0], [0.05, 9.0, 9.0], [9.0, 9.0, np.nan]])
    rows, columns = link(gap, 0.25)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 1), (1, 0)]
    for empty in (np.zeros((0, 3)), np.zeros((2, 0))):
        assert len(link(empty, 0.25)[0]) == 0


def test_redetect_follows_the_nearest_detection_and_holds_between(take: Take) -> None:
    clip = take.views[0].clip
    tracker = Scripted({0: [(20, 20), (40, 20)], 4: [(41, 20), (22, 20)], 8: [(24, 20)]})
    tracks = tracker.track(clip, [Query.point(0, 21, 20), Query.point(0, 39, 20)])
    np.testing.assert_allclose(tracks.uv_px[4, :, 0], [22, 41])
    np.testing.assert_allclose(tracks.point_world[:4, :, 0], np.tile([0.2, 0.4], (4, 1)), atol=1e-6)
    assert tracks.visible[:8].all()
    np.testing.assert_allclose(tracks.point_world[[4, 8], 0, 0], [0.22, 0.24], atol=1e-6)
    np.testing.assert_allclose(tracks.point_world[4:, 1, 0], 0.41, atol=1e-6)
    assert (tracks.state[8:, 1] == State.HELD).all()
    assert (tracks.state[:12, 0] == State.TRACKING).all()
    assert tracker.asked == [0, 4, 8, 12]


def test_redetect_binds_at_the_querys_frame_or_stays_at_its_pixel(take: Take) -> None:
    clip = take.views[0].clip
    tracker = Scripted({2: [(20, 20)], 4: [(21, 20)]})
    tracks = tracker.track(clip, [Query.point(2, 22, 20), Query.point(2, 60, 40)])
    assert np.isnan(tracks.uv_px[:2]).all()
    assert (tracks.state[:2] == State.LOST).all()
    np.testing.assert_allclose(tracks.uv_px[2], [[20, 20], [60, 40]])
    assert list(tracks.visible[2]) == [True, False]
    assert tracks.visible[4, 0]
    assert 2 in tracker.asked


def test_redetect_discovers_what_the_first_frame_shows(take: Take) -> None:
    clip = take.views[0].clip
    tracks = Scripted({0: [(20, 20), (40, 20)], 4: [(21, 20), (40, 21)]}).track(clip)
    assert tracks.labels == ("handle", "handle")
    assert (tracks.confidence[7] > 0.5).all()
    none = Scripted({}).track(clip)
    assert none.uv_px.shape == (16, 0, 2)
    assert any("nothing was detected" in flag for flag in none.frame_flags)


def test_redetect_on_a_network_is_repeatable_and_causal(take: Take) -> None:
    clip = take.views[1].clip
    tracker = Redetect("redetect", make_tracker())
    queries = [Query.point(0, 30, 20), Query.point(3, 10, 30)]
    whole, again = tracker.track(clip, queries), tracker.track(clip, queries)
    np.testing.assert_array_equal(whole.point_world, again.point_world)
    np.testing.assert_array_equal(tracker.track(cut_clip(clip, slice(10)), queries).point_world, whole.point_world[:10])


def test_what_it_refuses_and_tells(take: Take) -> None:
    clip = take.views[0].clip
    tracker = Redetect("redetect", make_tracker())
    assert tracker.name == "redetect"
    with pytest.raises(ConfigError, match="point"):
        tracker.track(clip, [Query.semantic("knob")])
    with pytest.raises(InputError, match="expected a"):
        tracker.track(clip, [Query.point(16, 5.0, 5.0)])
    blind = dataclasses.replace(clip, depth_m=None)
    tracks = tracker.track(blind, [Query.point(0, 20.0, 20.0)])
    assert np.isnan(tracks.point_world).all()
    assert np.isfinite(tracks.uv_px).all()
    assert any("without depth" in flag for flag in tracks.frame_flags)
    assert tracker.track(clip, []).uv_px.shape == (16, 0, 2)
