"""Several cameras: places are fused by their probability, views follow what others see, and a lost one is put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.errors import ConfigError, InputError
from quest.filter.noise import Noise
from quest.filter.view import View
from quest.track import Tracker
from quest.track.fusion import fuse, place_covariance
from quest.track.views import FusedTracks, ViewsStream, track_views
from quest.types import Clip, Query, State, Take
from tests.synthetic import make_take
from tests.track.clips import make_calibration, make_found, make_tracker, moved_world, without_depth

NOISE = Noise()
SIZE = (96, 96)


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=12, views=3, entities=2, size=SIZE, seed=3)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return make_tracker()


def clips_of(take: Take) -> list[Clip]:
    return [view.clip for view in take.views]


def asked(take: Take, view: int = 0) -> list[Query]:
    pixels = take.views[view].uv_px[0]
    return [Query.point(0, float(x), float(y), name=f"panel {k}") for k, (x, y) in enumerate(pixels)]


def gaussians(*sigma_m: float) -> np.ndarray:
    return np.array([sigma**2 * np.eye(3) for sigma in sigma_m])


def test_two_views_as_bayes_says():
    point, sigma = np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 1.0]]), (0.01, 0.02)
    fused = fuse(point, gaussians(*sigma), np.array([0.1, 0.2]), NOISE)
    variance = 0.01**2 + 0.02**2
    together = np.exp(-(0.02**2) / variance / 2) / (2 * np.pi * variance) ** 1.5 * NOISE.depths_m**3
    weight = {"both": 0.9 * 0.8 * together, "first": 0.9 * 0.2, "second": 0.1 * 0.8, "none": 0.1 * 0.2}
    total = sum(weight.values())
    assert fused.lost_p == pytest.approx(weight["none"] / total, rel=1e-6)
    assert fused.right_p == pytest.approx(
        [(weight["both"] + weight["first"]) / total, (weight["both"] + weight["second"]) / total]
    )
    mean = 0.02 * 0.01**2 / variance
    expected = (weight["both"] * mean + weight["second"] * 0.02) / (total - weight["none"])
    np.testing.assert_allclose(fused.point_world, [expected, 0, 1], atol=1e-9)


def test_a_view_that_disagrees_is_outvoted():
    point = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.005, 0.0, 1.0]])
    fused = fuse(point, gaussians(0.015, 0.015, 0.015), np.array([0.05, 0.01, 0.05]), NOISE)
    np.testing.assert_allclose(fused.point_world, [0.0025, 0, 1], atol=1e-3)
    assert fused.right_p[1] < 0.01
    assert fused.lost_p < 0.01


def test_the_order_of_views_and_views_without_a_point_do_not_matter():
    rng = np.random.default_rng(0)
    point, sigma, lost = 0.02 * rng.normal(size=(5, 3)), rng.uniform(0.01, 0.03, 5), rng.uniform(0, 0.5, 5)
    point[4] = np.nan
    order = rng.permutation(5)
    one, other = (fuse(point[o], gaussians(*sigma[o]), lost[o], NOISE) for o in (np.arange(5), order))
    np.testing.assert_allclose(one.point_world, other.point_world)
    np.testing.assert_allclose(one.right_p[order], other.right_p)
    assert one.right_p[4] == 0
    assert one.lost_p == pytest.approx(other.lost_p)
    nothing = fuse(np.full((2, 3), np.nan), gaussians(0.1, 0.1), np.array([0.5, 0.4]), NOISE)
    assert np.isnan(nothing.point_world).all()
    assert nothing.lost_p == pytest.approx(0.2)


def test_places_are_less_certain_along_the_ray_far_away_and_where_hidden():
    view = View(np.array([[500.0, 0, 240], [0, 500, 240], [0, 0, 1]]), np.eye(4), None)
    point = np.array([[0.0, 0, 1], [0, 0, 4], [0, 0, 4]])
    near, far, hidden = place_covariance(point, np.array([True, True, False]), view, NOISE)
    np.testing.assert_allclose(np.sqrt(np.diag(near)), [0.006, 0.006, 0.015])
    np.testing.assert_allclose(np.sqrt(np.diag(far)), [0.024, 0.024, 0.04])
    assert (np.diag(hidden) > np.diag(far)).all()


@pytest.fixture(scope="module")
def made(take: Take, tracker: Tracker) -> FusedTracks:
    return track_views(tracker, clips_of(take), asked(take))


def test_one_click_is_followed_in_all_views(take: Take, made: FusedTracks):
    error = np.linalg.norm(made.whole.point_world - take.point_world, axis=-1)
    assert made.whole.names == ("panel 0", "panel 1")
    assert np.median(error) < 0.01
    assert made.whole.lost_p is None
    np.testing.assert_allclose(made.whole.uv_px[:8], take.views[0].uv_px[:8], atol=3)
    for own in made.views[1:]:
        assert own.names == made.whole.names
        assert np.isnan(own.point_world[0]).all()
        assert np.isfinite(own.point_world[1:]).all(axis=-1).any()
        assert np.nanmedian(np.linalg.norm(own.point_world - take.point_world, axis=-1)) < 0.02
    assert made.whole.joints is not None
    assert "unknown" not in made.whole.joints.kind


def test_tracks_as_another_view_sees_them(take: Take, made: FusedTracks):
    clips = clips_of(take)
    seen = made.seen_from(2, clips[2])
    np.testing.assert_allclose(seen.uv_px[:8], take.views[2].uv_px[:8], atol=3)
    np.testing.assert_array_equal(seen.point_world, made.whole.point_world)
    assert len(seen) == len(clips[2])


def test_a_lost_view_is_outvoted_and_put_back(take: Take, tracker: Tracker):
    clips = [replace(clip, stamp_s=clip.stamp_s * 3) for clip in clips_of(take)]
    stream = ViewsStream(tracker, [clip.camera for clip in clips], asked(take))
    error, own_error = [], []
    for t in range(8):  # nothing moves yet
        state = stream.step([[clip.frame(t)] for clip in clips])
        number, own = stream.number(0, 2), stream.answers[2][-1]
        error.append(np.linalg.norm(state.point_world[0] - take.point_world[t, 0]))
        if number in own.query:
            own_error.append(np.linalg.norm(own.point_world[own.query.index(number)] - take.point_world[t, 0]))
        if t == 4:
            assert number is not None
            stream.streams[2].place(number, *map(float, take.views[2].uv_px[t, 1]))
    assert max(error) < 0.03
    assert own_error[-3] > 0.2, "it was put to the other panel"
    assert own_error[-1] < 0.03


def test_what_views_discover_is_one_entity_where_it_is_near(take: Take, tracker: Tracker, monkeypatch):
    pixels = [view.uv_px[0] for view in take.views[:2]]
    found = iter(
        [
            make_found(*[("handle", "open", (float(x), float(y))) for x, y in pixels[0]]),
            make_found(("handle", "open", (float(pixels[1][1, 0]), float(pixels[1][1, 1])))),
        ]
    )
    monkeypatch.setattr("quest.track.stream.find", lambda *_, **__: next(found))
    made = track_views(tracker, clips_of(take)[:2])
    assert made.whole.names == ("handle 0", "handle 1")
    assert made.whole.labels == ("handle", "handle")
    error = np.linalg.norm(made.whole.point_world - take.point_world, axis=-1)
    assert np.median(error) < 0.01
    assert np.isfinite(made.views[1].uv_px[0, 1]).all()
    assert np.isnan(made.views[1].uv_px[0, 0]).all(), "this one it follows since it saw the other view's place"
    assert np.isfinite(made.views[1].uv_px[-1, 0]).all()


def test_queries_of_one_name_in_several_views_are_one(take: Take, tracker: Tracker):
    clips = clips_of(take)[:2]
    made = track_views(tracker, clips, [*asked(take), asked(take, 1)[1]], view=[0, 0, 1])
    assert made.whole.names == ("panel 0", "panel 1")
    assert np.isfinite(made.views[1].uv_px[0, 1]).all(), "asked there from the first frame on"
    assert np.isnan(made.views[1].uv_px[0, 0]).all()


def test_frames_are_paired_by_their_stamps(take: Take, tracker: Tracker):
    first, second, _ = clips_of(take)
    every = slice(0, None, 2)
    slow = replace(
        second,
        rgb=second.rgb[every],
        depth_m=None if second.depth_m is None else second.depth_m[every],
        stamp_s=second.stamp_s[every] + 0.004,
        cam_from_world=second.cam_from_world[every],
    )
    made = track_views(tracker, [first, slow], asked(take))
    assert len(made.whole) == len(first)
    assert [len(own) for own in made.views] == [len(first), len(slow)]
    assert np.isfinite(made.views[1].point_world[2:]).all()
    np.testing.assert_array_equal(made.views[1].stamp_s, slow.stamp_s)


def test_alpha_is_split_over_views_and_alarms_need_a_loss(take: Take):
    clips = clips_of(take)[:2]
    calm, alarming = (make_tracker(depth=make_calibration(alarming=each)) for each in (False, True))
    stream = ViewsStream(calm, [clip.camera for clip in clips], asked(take), alpha=0.1)
    assert [one.budget.alpha for one in stream.streams if one.budget is not None] == [0.05, 0.05]
    made = track_views(alarming, clips, asked(take), alpha=0.5)
    alarmed = made.whole.alarm
    assert alarmed is not None
    assert alarmed[-1].all()
    assert (made.whole.state[alarmed] == State.LOST).all()


def test_what_is_refused(take: Take, tracker: Tracker):
    first, second, _ = clips_of(take)
    queries = asked(take)
    late = replace(second, stamp_s=second.stamp_s + 100)
    nowhere = [replace(clip, cam_from_world=np.tile(np.eye(4), (len(clip), 1, 1))) for clip in (first, second)]
    for clips, words in (
        ([first, late], "no frames at the same time"),
        ([first, replace(second, depth_m=None)], "expected depth"),
        (nowhere, "no poses"),
        ([first] * 9, "1 to 8 of them"),
    ):
        with pytest.raises(InputError, match=words):
            track_views(tracker, clips, queries)
    with pytest.raises(InputError, match="a view of 0 to 1"):
        track_views(tracker, [first, second], queries, view=2)
    with pytest.raises(InputError, match="query at frame 12"):
        track_views(tracker, [first, second], [Query.point(12, 5, 5)])
    with pytest.raises(ConfigError, match=r"expected a quest\.Tracker"):
        track_views(object(), [first, second], queries)  # type: ignore[arg-type]


def test_depth_and_world_may_be_anything_alike(take: Take, tracker: Tracker):
    first, second, _ = clips_of(take)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [3, -2, 1]
    clips = [moved_world(first, pose), moved_world(without_depth(second, slice(3, 6)), pose)]
    made = track_views(tracker, clips, asked(take))
    truth = take.point_world[:, :2] @ pose[:3, :3].T + pose[:3, 3]
    assert np.median(np.linalg.norm(made.whole.point_world - truth, axis=-1)) < 0.01
