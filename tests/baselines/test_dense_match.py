"""The rival that matches every frame to the query's own."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest
import torch

from quest.baselines import dense_match
from quest.baselines.dense_match import DenseMatch, best_match, token_features
from quest.errors import ConfigError
from quest.types import Camera, Clip, Query, State
from tests.tiny import make_finder

SHIFT_PX = np.array([[0, 0], [5, 3], [16, -8], [-21, 13]])
"""Of the whole picture against the first one; no small steps, and none that repeats."""


@pytest.fixture(scope="module")
def tracker() -> DenseMatch:
    return DenseMatch.by_xfeat()


@pytest.fixture
def clip() -> Clip:
    """A wall at 2 m with blobs of several sizes."""
    rng = np.random.default_rng(0)
    blobs = [cv2.resize(rng.uniform(0, 64, (400 // s, 400 // s, 3)), (400, 400)) for s in (4, 8, 16, 32)]
    image = np.sum(blobs, axis=0).clip(0, 255).astype(np.uint8)
    rgb = np.stack([image[60 - y : 252 - y, 60 - x : 316 - x] for x, y in SHIFT_PX])
    depth_m = np.full((len(rgb), 192, 256), 2.0, np.float32)
    poses = np.tile(np.eye(4), (len(rgb), 1, 1))
    camera = Camera(100.0, 100.0, 128.0, 96.0, 256, 192)
    return Clip("shift", camera, rgb, depth_m, np.arange(len(rgb)) / 30, poses)


def test_a_moved_picture_is_followed_from_any_frame(tracker: DenseMatch, clip: Clip) -> None:
    queries = [Query.point(0, 100.5, 90.25), Query.point(2, 150.0, 70.0)]
    tracks = tracker.track(clip, queries)
    assert tracker.track(clip, []).uv_px.shape == (4, 0, 2)
    with pytest.raises(ConfigError, match="xfeat"):
        tracker.track(clip, [Query.semantic("handle")])
    for k, query in enumerate(queries):
        asked, shift = slice(query.frame, None), SHIFT_PX[query.frame :] - SHIFT_PX[query.frame]
        off_px = np.linalg.norm(tracks.uv_px[asked, k] - (query.uv_px + shift), axis=-1)
        assert off_px[0] == 0
        assert off_px.max() < 4
        assert tracks.visible[asked, k].all()
        assert not tracks.visible[: query.frame, k].any()
        assert np.isnan(tracks.uv_px[: query.frame, k]).all()
        expected = (tracks.uv_px[asked, k] - (128, 96)) / 100 * 2
        np.testing.assert_allclose(tracks.point_world[asked, k, :2], expected, atol=1e-5)


def test_what_nothing_resembles_is_not_visible_and_held(
    tracker: DenseMatch, clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dense_match, "LEAST_SIMILARITY", 0.8)  # grey alone has more than 0.6
    clip.rgb[2] = 128
    tracks = tracker.track(clip, [Query.point(0, 100.5, 90.25)])
    assert tracks.visible[:, 0].tolist() == [True, True, False, True]
    assert tracks.state[2, 0] == State.LOST
    assert 0.6 < tracks.confidence[2, 0] < 0.8 < tracks.confidence[1, 0]
    np.testing.assert_array_equal(tracks.point_world[2], tracks.point_world[1])


def test_a_match_lies_between_cells_but_not_beyond_the_border() -> None:
    features = torch.zeros(2, 4, 6)
    features[0, 1, 2:4] = torch.tensor([1.0, 0.5])  # vertex of 0, 1, 0.5: a sixth of a cell further
    features[1, 0, 5] = -1.0
    uv_px, similarity = best_match(features, torch.tensor([[1.0, 0.0], [0.0, -1.0]]), (60, 40))
    np.testing.assert_allclose(uv_px, [[25 + 10 / 6, 15], [55, 5]], atol=1e-4)
    assert similarity.tolist() == [1, 1]


def test_tokens_find_a_patch_that_moved() -> None:
    """By whole tokens, of ten pixels each, since the weights are random."""
    encoder = make_finder().encoder
    tracker = DenseMatch("dino", partial(token_features, encoder), weights_hash="0123")
    places = np.array([[200, 150], [320, 150], [220, 210]], np.float32)
    rgb = np.full((3, 320, 400, 3), 90, np.uint8)
    for image, (x, y) in zip(rgb, places.astype(int), strict=True):
        image[y - 24 : y + 24, x - 24 : x + 24] = (
            np.random.default_rng(1).integers(0, 256, (6, 6, 3)).repeat(8, 0).repeat(8, 1)
        )
    camera = Camera(400.0, 400.0, 200.0, 160.0, 400, 320)
    clip = Clip("blob", camera, rgb, None, np.arange(3) / 30, np.tile(np.eye(4), (3, 1, 1)))
    tracks = tracker.track(clip, [Query.point(0, 200, 150)])
    assert np.linalg.norm(tracks.uv_px[:, 0] - places, axis=-1).max() < 2
    features = token_features(encoder, rgb[0])
    assert features.shape == (24, 4 * 32, 4 * 40)
    np.testing.assert_allclose(features.norm(dim=0), 1, atol=1e-5)
