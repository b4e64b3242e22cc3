"""What a place looks like: here or elsewhere, seen or occluded, and found again."""

from __future__ import annotations

import numpy as np
import pytest

from quest.filter.appearance import PATCH_PX, Likeness
from quest.filter.noise import Noise
from quest.filter.picture import Picture
from quest.model.xfeat import XFeat
from quest.track.describing import described
from quest.types import Query
from tests.filter.scenes import SIZE, Board, follow, scene, shifted, texture

NOISE = Noise()
WIDE = texture(3 * SIZE[0], 3 * SIZE[1], seed=1)
AT = np.array([[50.0, 60.0], [110.0, 50.0]])


@pytest.fixture(scope="module")
def features() -> XFeat:
    return XFeat.from_package()


def likeness(anchors: Picture, now: Picture) -> Likeness:
    descriptor, patch = anchors.describe(AT), anchors.patches(AT, PATCH_PX)
    return Likeness.of(now, descriptor[:, None], patch[:, None])


def test_an_entity_is_likest_where_it_is(features: XFeat) -> None:
    one, other = (described(features, shifted(WIDE, *at)) for at in ((100, 100), (107, 103)))
    like = likeness(one, other)
    right = AT - [7.0, 3.0]
    places = like.at(np.stack([right, right[::-1]], axis=1), NOISE)
    assert (places.log_odds[:, 0] > 3).all()
    assert (places.log_odds[:, 1] < 0).all()
    np.testing.assert_allclose(places.uv_px[:, 0], right, atol=1)


def test_it_is_found_anywhere_in_the_frame_but_where_it_is_followed(features: XFeat) -> None:
    one, other = (described(features, shifted(WIDE, *at)) for at in ((100, 100), (130, 90)))
    like = likeness(one, other)
    right = AT - [30.0, -10.0]
    found = like.elsewhere(AT + np.array([20.0, 40.0]), 3, NOISE)
    first = found.log_odds.argmax(axis=1)
    np.testing.assert_allclose(found.uv_px[np.arange(2), first], right, atol=2)
    apart = np.linalg.norm(like.elsewhere(right, 3, NOISE).uv_px - right[:, None], axis=-1)
    assert apart.min() > 16


def test_what_is_covered_is_not_seen_and_is_found_where_it_comes_out() -> None:
    """A board comes and stays; behind it the camera's own motion is not to be told, for it covers all but a margin."""
    frames = 40
    way = np.tile([[-80.0, 20.0]], (frames, 1))
    way[8:] = [30.0, 20.0]
    covered = scene(np.zeros(frames), Board(way, (90, 80), 1.7, seed=9), depth=False)
    tracks = follow(covered, [Query.point(0, 75.0, 60.0)])
    assert tracks.visible[1:8, 0].all()
    assert (tracks.confidence[1:8, 0] > 0.9).all()
    assert not tracks.visible[10:, 0].any()
    assert (tracks.confidence[10:, 0] < 0.5).all()


def test_a_query_that_was_left_behind_is_found_again() -> None:
    """A board jumps farther than local motion reaches, twice as far as the patches are wide."""
    frames = 40
    way = np.tile([[20.0, 30.0]], (frames, 1))
    way[5:] = [85.0, 45.0]
    clip = scene(np.zeros(frames), Board(way, (60, 50), 1.7, seed=9), depth=False)
    tracks = follow(clip, [Query.point(0, 50.0, 55.0), Query.point(0, 145.0, 20.0)])
    np.testing.assert_allclose(tracks.uv_px[-1, 0], [115.0, 70.0], atol=2)
    np.testing.assert_allclose(tracks.uv_px[-1, 1], [145.0, 20.0], atol=1)
    assert tracks.confidence[-1, 0] > 0.9


@pytest.mark.parametrize("depth", [True, False])
def test_what_is_out_of_view_is_neither_visible_nor_elsewhere(depth: bool) -> None:
    camera_m = np.concatenate([np.linspace(0, 1.4, 24), np.full(6, 1.4), np.linspace(1.4, 0, 24)])
    tracks = follow(scene(camera_m, depth=depth), [Query.point(0, 70.0, 60.0)])
    out = 70.0 - 150.0 * camera_m / 2.0 < -2
    assert out.sum() > 15
    assert not tracks.visible[out, 0].any()
    if depth:
        assert np.median(tracks.confidence[out, 0]) > 0.5
        assert tracks.visible[-3:, 0].all()
        np.testing.assert_allclose(tracks.uv_px[-1, 0], [70.0, 60.0], atol=1.5)
