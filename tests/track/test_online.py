"""Finding that goes on: what comes into view is found, nothing is found twice, and looks vote."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.model.found import Found
from quest.track import Stream, StreamState, Tracker
from quest.track.finding import FORGOTTEN, PRIOR, Candidates
from quest.types import Clip, Query
from tests.filter.scenes import FOCAL, SIZE, WALL_M, Board, scene
from tests.track.clips import EAGER, feed, make_found, make_tracker

CONFIG = replace(EAGER, threshold=0.5, prompt_threshold=0.2, size_px=640)
THERE_AND_BACK = np.concatenate([np.linspace(0, 1.4, 30), np.linspace(1.39, 0.01, 30)])
"""Metres to the right: 105 pixels, so that what is at the left leaves the view and comes back."""
LEFT, RIGHT = (70.0, 60.0), (230.0, 40.0)
"""Pixels of the wall; the right one comes into view with frame 16."""

Finder = Callable[..., Found]


@pytest.fixture(params=["depth", "colours"], scope="module")
def clip(request: pytest.FixtureRequest) -> Clip:
    return colours_only(scene(THERE_AND_BACK)) if request.param == "colours" else scene(THERE_AND_BACK)


ONCE = pytest.mark.parametrize("clip", ["depth"], indirect=True)
"""Of what does not depend on what frames bring."""


def colours_only(clip: Clip) -> Clip:
    return replace(clip, depth_m=None, cam_from_world=np.tile(np.eye(4), (len(clip), 1, 1)))


def at(wall_px: tuple[float, float], t: int, camera_m: np.ndarray = THERE_AND_BACK) -> tuple[float, float]:
    """Where a place of the wall is in a frame."""
    return wall_px[0] - FOCAL * camera_m[t] / WALL_M, wall_px[1]


def finder(clip: Clip, camera_m: np.ndarray, *things: tuple[tuple[float, float], Callable[[int], float]]) -> Finder:
    """A finder that sees things on the wall with a probability that depends on the frame; not at all with 0."""

    def find(_network: object, rgb: np.ndarray, _depth_m: np.ndarray | None = None, **_looking: float) -> Found:
        t = int(np.flatnonzero((clip.rgb == rgb).all(axis=(1, 2, 3)))[0])
        seen = [(at(wall_px, t, camera_m), p(t)) for wall_px, p in things]
        seen = [(uv, p) for uv, p in seen if p and 2 < uv[0] < SIZE[0] - 2]
        return make_found(*(("handle", "open", uv) for uv, _ in seen), p=tuple(p for _, p in seen))

    return find


def use(monkeypatch: pytest.MonkeyPatch, find: Finder) -> Tracker:
    monkeypatch.setattr("quest.track.stream.find", find)
    return make_tracker(CONFIG)


def test_what_comes_into_view_is_found_and_nothing_twice(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    """The left one leaves the view meanwhile, and comes back."""
    tracker = use(monkeypatch, finder(clip, THERE_AND_BACK, (LEFT, lambda _: 0.9), (RIGHT, lambda _: 0.9)))
    assert tracker.track(clip).names == ("handle 0",)
    tracks = tracker.track(clip, online=True)
    assert tracks.names == ("handle 0", "handle 1")
    first = np.isfinite(tracks.uv_px).all(axis=-1).argmax(axis=0)
    assert first[0] == 0
    assert 16 <= first[1] <= 16 + 8, "at the next look"
    for k, wall_px in enumerate((LEFT, RIGHT)):
        true_px = np.array([at(wall_px, t) for t in range(len(clip))])
        seen = tracks.visible[:, k]
        assert seen.any()
        np.testing.assert_allclose(tracks.uv_px[seen, k], true_px[seen], atol=2)


def test_what_comes_back_displaced_is_the_same(monkeypatch: pytest.MonkeyPatch):
    """By colours alone: it is gone for a second, and is then somewhere else; it looks as it did."""
    out, shift = np.full(15, -60), 60
    corner = np.stack([np.concatenate([np.full(20, 40), out, np.full(25, 40 + shift)]), np.full(60, 40)], axis=1)
    clip = colours_only(scene(np.linspace(0, 1e-3, 60), Board(corner, (30, 30), 1.5, seed=3), depth=False))
    clip = replace(clip, rgb=clip.rgb + np.arange(60, dtype=np.uint8)[:, None, None, None] % 2)

    def find(_network: object, rgb: np.ndarray, *_: object, **__: float) -> Found:
        x = corner[int(abs(clip.rgb.astype(int) - rgb).sum(axis=(1, 2, 3)).argmin()), 0]
        places = [("handle", "open", (x + 15.0, 55.0))] if x > 0 else []
        return make_found(*places, p=(0.9,) * len(places))  # type: ignore[arg-type]

    tracks = use(monkeypatch, find).track(clip, online=0.1)
    assert tracks.names == ("handle 0",)
    np.testing.assert_allclose(tracks.uv_px[-1, 0], [40 + shift + 15, 55], atol=3)


def after_looks(*said: float | None, repeats: float) -> Candidates:
    """A candidate after so many looks at one place: the probability in each, or None where nothing was named."""
    told = Candidates.none()
    for p in said:
        told = replace(told, repeats=np.full(len(told.uv_px), repeats))
        found = make_found(*[("handle", "open", (5, 5))] * (p is not None), p=() if p is None else (p,))
        told = told.after(found, np.ones((len(found), len(told.uv_px)), bool))
    return told


def probability(told: Candidates) -> float:
    return float(1 / (1 + np.exp(-told.log_odds[0])))


def test_one_look_counts_as_in_discovery_and_two_more():
    assert probability(after_looks(0.3, repeats=0.0)) == pytest.approx(0.3)
    assert probability(after_looks(0.3, 0.3, repeats=0.0)) > 0.5
    assert probability(after_looks(0.3, 0.3, repeats=0.9)) < 0.35
    assert probability(after_looks(*[0.3] * 50, repeats=1.0)) == pytest.approx(0.3), (
        "the same picture tells nothing new"
    )


@pytest.mark.parametrize("repeats", [0.0, 0.5, 0.9])
def test_what_flickered_is_doubted(repeats: float):
    told = after_looks(0.3, None, None, repeats=repeats)
    assert told.log_odds[0] < PRIOR
    assert probability(after_looks(0.3, None, None, 0.3, repeats=repeats)) < 0.3
    assert (told.log_odds[0] < FORGOTTEN) == (repeats == 0)
    assert after_looks(0.3, 0.01, repeats=repeats).log_odds[0] >= after_looks(0.3, None, repeats=repeats).log_odds[0]


def test_weak_sightings_under_several_views_are_enough(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    """One candidate, whose place the moving camera carries."""
    tracker = use(monkeypatch, finder(clip, THERE_AND_BACK, (LEFT, lambda _: 0.3)))
    stream, counts = tracker.stream(clip.camera, online=0.2, wait=True), []
    for t in range(20):
        state = feed(stream, clip, range(t, t + 1))[0]
        finding = stream.memory.finding
        assert finding is not None
        counts.append(len(finding.candidates.uv_px) + len(state.names))
    assert counts == [1] * 20
    assert state.names == ("handle 0",)
    np.testing.assert_allclose(state.uv_px[0], at(LEFT, 19), atol=2)


@ONCE
@pytest.mark.parametrize("p", [lambda t: 0.3 * (t % 9 == 0), lambda _: 0.1], ids=["flickers", "is hardly there"])
def test_flicker_is_not_found(p: Callable[[int], float], clip: Clip, monkeypatch: pytest.MonkeyPatch):
    tracker = use(monkeypatch, finder(clip, THERE_AND_BACK, (LEFT, p)))
    assert tracker.track(clip, online=0.2).names == ()


def test_a_still_picture_is_looked_at_once(monkeypatch: pytest.MonkeyPatch):
    clip = scene(np.zeros(60))
    clip = replace(clip, rgb=clip.rgb.copy())
    clip.rgb[:, -1, -1] = np.arange(60)[:, None]
    tracker = use(monkeypatch, finder(clip, np.zeros(60), (LEFT, lambda _: 0.4)))
    assert tracker.track(clip, online=0.2).names == ()


@ONCE
def test_candidates_are_bounded(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    places = [((x, y), lambda _: 0.2) for x in range(20, 150, 16) for y in range(20, 110, 16)]
    tracker = use(monkeypatch, finder(clip, THERE_AND_BACK, *places))
    stream = tracker.stream(clip.camera, online=0.1, wait=True)
    for t in range(6):
        feed(stream, clip, range(t, t + 1))
        finding = stream.memory.finding
        assert finding is not None
        assert 0 < len(finding.candidates.uv_px) <= CONFIG.most


def test_what_moves_by_itself_needs_less(monkeypatch: pytest.MonkeyPatch):
    """A board that moves, and no query on it: what is on it is found above the threshold of prompts."""
    corner = np.stack([np.concatenate([np.full(8, 20), 20 + 2 * np.arange(24)]), np.full(32, 20)], axis=1)
    clip = scene(np.linspace(0, 1e-3, 32), Board(corner, (70, 80), 1.7, seed=5))

    def find(_network: object, rgb: np.ndarray, *_: object, **__: float) -> Found:
        t = int(abs(clip.rgb.astype(int) - rgb).sum(axis=(1, 2, 3)).argmin())
        on_board, on_wall = (corner[t, 0] + 35.0, 60.0), (150.0, 110.0)
        return make_found(("handle", "open", on_board), ("knob", "open", on_wall), p=(0.25, 0.25))

    tracks = use(monkeypatch, find).track(clip, online=True)
    assert tracks.labels == ("handle",)
    assert np.isnan(tracks.uv_px[:9]).all()
    np.testing.assert_allclose(tracks.uv_px[-1, 0], [corner[-1, 0] + 35, 60], atol=2)


class Slow:
    """A finder that sees the left thing when it is let go on."""

    def __init__(self, clip: Clip) -> None:
        self.go_on, self.begun, self.calls = threading.Event(), threading.Event(), 0
        self._find = finder(clip, THERE_AND_BACK, (LEFT, lambda _: 0.9))

    def __call__(self, *args: object, **looking: float) -> Found:
        self.calls += 1
        self.begun.set()
        assert self.go_on.wait(30)
        return self._find(*args, **looking)


def until_found(stream: Stream, clip: Clip, frames: range) -> StreamState:
    for t in frames:
        state = feed(stream, clip, range(t, t + 1))[0]
        if state.names:
            return state
        time.sleep(0.05)
    raise AssertionError("nothing was found")


@ONCE
def test_a_look_in_the_background_keeps_no_frame_waiting(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    slow = Slow(clip)
    stream = use(monkeypatch, slow).stream(clip.camera, online=0.1)
    assert all(state.names == () for state in feed(stream, clip, range(12)))
    assert slow.calls == 1, "the next look begins when this one is done"
    assert stream.looking
    slow.go_on.set()
    state = until_found(stream, clip, range(12, 20))
    np.testing.assert_allclose(state.uv_px[0], at(LEFT, stream.frame - 1), atol=2)
    assert feed(stream, clip, range(stream.frame, 26))[-1].names == ("handle 0",)
    assert slow.calls > 1


@ONCE
def test_the_thread_ends_with_its_stream(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    def there() -> set[threading.Thread]:
        return {thread for thread in threading.enumerate() if thread.name.startswith("quest-looker")}

    others, slow = there(), Slow(clip)
    stream = use(monkeypatch, slow).stream(clip.camera, online=0.1)
    feed(stream, clip, range(2))
    mine = there() - others
    assert len(mine) == 1
    del stream
    slow.go_on.set()
    gc.collect()
    for thread in mine:
        thread.join(10)
        assert not thread.is_alive()


def test_a_saved_stream_goes_on_to_the_bit(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    things = (LEFT, lambda _: 0.3), (RIGHT, lambda _: 0.9)
    tracker = use(monkeypatch, finder(clip, THERE_AND_BACK, *things))
    stream = tracker.stream(clip.camera, online=0.2, wait=True)
    feed(stream, clip, range(7))
    data = tracker.save(stream)
    again = tracker.restore(data)
    assert tracker.save(again) == data
    for got, expected in zip(feed(again, clip, range(7, 22)), feed(stream, clip, range(7, 22)), strict=True):
        assert got.names == expected.names
        np.testing.assert_array_equal(got.uv_px, expected.uv_px)
    assert len(got.names) == 2
    assert tracker.save(again) == tracker.save(stream)


@ONCE
def test_a_look_under_way_is_made_again_where_the_stream_is_restored(clip: Clip, monkeypatch: pytest.MonkeyPatch):
    slow = Slow(clip)
    tracker = use(monkeypatch, slow)
    stream = tracker.stream(clip.camera, online=10)
    feed(stream, clip, range(3))
    assert slow.begun.wait(10)
    again = tracker.restore(tracker.save(stream))
    slow.go_on.set()
    until_found(again, clip, range(3, 20))
    assert slow.calls == 2


@ONCE
@pytest.mark.parametrize("wait", [True, False], ids=["at once", "in the background"])
def test_an_error_in_a_look_is_that_of_the_step(wait: bool, clip: Clip, monkeypatch: pytest.MonkeyPatch):
    works = finder(clip, THERE_AND_BACK, (LEFT, lambda _: 0.9))

    def fails(*_: object, **__: float) -> Found:
        raise RuntimeError("out of memory")

    stream = use(monkeypatch, fails).stream(clip.camera, online=0.1, wait=wait)
    with pytest.raises(RuntimeError, match="out of memory"):
        until_found(stream, clip, range(20))
    monkeypatch.setattr("quest.track.stream.find", works)
    stream.add(Query.point(stream.frame, 100, 80, name="mine"))
    state = feed(stream, clip, range(stream.frame, 26))[-1]
    assert set(state.names) == {"mine", "handle 1"} or not wait


@ONCE
def test_what_cannot_be_meant_is_refused(clip: Clip):
    with pytest.raises(ConfigError, match="no queries"):
        make_tracker().stream(clip.camera, [Query.slot()], online=True)
    for never in (0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="seconds between looks"):
            make_tracker().track(clip, online=never)
