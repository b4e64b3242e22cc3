"""A camera that fails is said to, and nothing is learned from what it does not see."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from quest.data.recording import open_recording
from quest.track.health import ELSEWHERE, Health, Repeats, digest_of
from quest.track.preprocess import grey_of
from quest.track.state import StreamState
from quest.types import Query, State
from tests.filter.scenes import scene
from tests.track.clips import feed, make_tracker

FRAMES, BAD = 26, slice(14, 20)
AT = (70.0, 60.0)
RNG = np.random.default_rng(0)
REAL = Path(__file__).parents[3] / "shared" / "data" / "real"

BLIND: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "covered": lambda rgb, before: np.zeros_like(rgb),
    "overexposed": lambda rgb, before: np.full_like(rgb, 255),
    "noise": lambda rgb, before: RNG.integers(0, 256, rgb.shape).astype(np.uint8),
    "frozen": lambda rgb, before: before,
    "turned": lambda rgb, before: np.ascontiguousarray(rgb[::-1, ::-1]),
}
CHANGED: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "half of it black": ("black", lambda rgb: np.where(np.arange(rgb.shape[1])[None, :, None] < 80, 0, rgb)),
    "out of focus": ("focus", lambda rgb: cv2.GaussianBlur(rgb, (0, 0), 6.0)),
}


def played(change: Callable[[np.ndarray, np.ndarray], np.ndarray], *, depth: bool) -> list[StreamState]:
    """Answers to a wall that rests while the camera slides, with something wrong with some of its frames."""
    clip = scene(np.linspace(0, 0.2, FRAMES), depth=depth)
    rgb = clip.rgb.copy()
    for t in range(BAD.start, BAD.stop):
        rgb[t] = change(clip.rgb[t], clip.rgb[BAD.start - 1])
    clip = replace(clip, rgb=rgb)
    stream = make_tracker().stream(clip.camera, [Query.point(0, *AT)])
    return feed(stream, clip, range(FRAMES))


@cache
def in_good_health(depth: bool) -> list[StreamState]:
    return played(lambda rgb, before: rgb, depth=depth)


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("what", BLIND)
def test_a_blind_camera_follows_nothing_and_finds_it_again(what: str, depth: bool) -> None:
    states = played(BLIND[what], depth=depth)
    for state in states[BAD]:
        assert any(flag.startswith(("covered", "frozen", "turned")) for flag in state.flags)
        assert state.state[0] != State.TRACKING
    unsure = [1 - float(state.confidence[0]) for state in states[BAD]]
    assert np.all(np.diff(unsure) > 0)
    assert states[-1].state[0] == State.TRACKING
    sound = in_good_health(depth)
    assert not any(state.flags for state in sound[1:] if depth)
    np.testing.assert_allclose(states[-1].uv_px, sound[-1].uv_px, atol=1.0)


@pytest.mark.parametrize("what", CHANGED)
def test_what_no_motion_explains_is_said(what: str) -> None:
    words, change = CHANGED[what]
    states = played(lambda rgb, before: np.ascontiguousarray(change(rgb)).astype(np.uint8), depth=True)
    assert any(words in flag for flag in states[BAD.start].flags)


@pytest.mark.parametrize(
    ("word", "rows", "columns"), [("upside down", -1, -1), ("mirrored", 1, -1), ("flipped", -1, 1)]
)
def test_a_turned_picture_is_said_to_be_so_until_it_is_turned_back(word: str, rows: int, columns: int) -> None:
    """Also one that is much the same when turned."""
    y, x = np.mgrid[:1:60j, :1:80j]
    height = np.exp(-(((y - 0.5) / 0.2) ** 2) - ((x - 0.5) / 0.2) ** 2) + 0.3 * y + 0.2 * x
    rgb = np.repeat((150 * height)[..., None], 3, axis=2).astype(np.uint8)
    turned = np.ascontiguousarray(rgb[::rows, ::columns])
    frames = [rgb, rgb + 1, turned, turned + 1, turned, rgb, rgb + 1]
    health = Health()
    said = [health.of_picture(frame, t) for t, frame in enumerate(frames)]
    wrong = ((f"turned: the picture is {word}",), True)
    assert said == [((), False)] * 2 + [wrong] * 3 + [((), False)] * 2
    health.of_picture(turned, 8)
    other = RNG.integers(0, 256, (3, 4, 3)).astype(np.float32)
    assert health.of_picture(cv2.resize(other, (80, 60)).astype(np.uint8), 9) == ((ELSEWHERE,), False)


def test_exchanged_colours_are_said() -> None:
    health, rgb = Health(), RNG.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    rgb = cv2.GaussianBlur(rgb, (0, 0), 4.0)
    rgb = cv2.normalize(rgb, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
    assert health.of_picture(rgb, 1) == ((), False)
    flags, blind = health.of_picture(np.ascontiguousarray(rgb[..., ::-1]), 2)
    assert "red and blue exchanged at once" in flags
    assert not blind


def blank(depth_m: np.ndarray) -> np.ndarray:
    """Luminance in which nothing is seen, of the depth's size."""
    return np.full(depth_m.shape, 128, np.uint8)


@pytest.mark.parametrize(
    ("name", "by_px"),
    [("sample", (27, 0)), ("sample", (0, -14)), ("sample-alarm", (9, 0)), ("sample-alarm", (-20, 15))],
)
def test_depth_that_shifts_against_the_colours_is_not_used_until_it_lies_on_them_again(
    name: str, by_px: tuple[int, int]
) -> None:
    health = Health()
    for t, frame in enumerate(open_recording(name)):
        bad = 20 <= t < 40
        assert frame.depth_m is not None
        depth_m = np.roll(frame.depth_m, by_px, axis=(1, 0)) if bad else frame.depth_m
        wrong = health.of_depth(depth_m, grey_of(frame.rgb), ())
        assert (wrong is not None) == bad, t
        if wrong is not None:
            off = [int(n) for n in re.findall(r"-?\d+", wrong)]
            np.testing.assert_allclose(off, by_px, atol=2)


def test_depth_that_cannot_be_is_not_used() -> None:
    depth_m = RNG.uniform(1.0, 2.0, (30, 40)).astype(np.float32)
    health = Health()
    assert health.of_depth(depth_m, blank(depth_m), ()) is None
    assert "everywhere" in str(health.of_depth(np.full_like(depth_m, 1.5), blank(depth_m), ()))
    for t in range(9):  # however it changes meanwhile
        moved = np.roll(depth_m, 10 * t, axis=1) if t % 2 else depth_m
        assert "10 times" in str(health.of_depth(10 * moved, blank(depth_m), ()))
    assert health.of_depth(depth_m + np.float32(0.01), blank(depth_m), ()) is None


def test_at_another_place_another_depth_is_no_other_unit() -> None:
    health = Health()
    for far, flags in ((1.0, ()), (4.0, (ELSEWHERE,)), (4.0, ())):
        wall = (far * RNG.uniform(1.0, 1.02, (30, 40))).astype(np.float32)
        assert health.of_depth(wall, blank(wall), flags) is None


def test_a_hand_before_the_lens_is_no_other_unit() -> None:
    depth_m = RNG.uniform(1.0, 2.0, (64, 80)).astype(np.float32)
    near = depth_m.copy()
    near[:, :60] = RNG.uniform(0.1, 0.3, (64, 60))
    health = Health()
    assert [health.of_depth(each, blank(depth_m), ()) for each in (depth_m, near, depth_m)] == [None] * 3


def come_again(frames: np.ndarray) -> list[bool]:
    repeats = Repeats(noiseless=0.9)
    return [repeats.are_faults(frame, digest_of(frame)) for frame in frames]


def test_what_stands_still_is_a_fault_where_there_is_noise_and_none_did_so_far() -> None:
    noisy = RNG.integers(0, 256, (20, 16, 16, 3)).astype(np.uint8)
    assert not any(come_again(noisy))
    assert come_again(np.concatenate([noisy, noisy[-1:]])) == [False] * 20 + [True]
    assert come_again(np.concatenate([noisy[:9], noisy[8:9], noisy[8:9]])) == [False] * 9 + [True] * 2
    assert not any(come_again(noisy.repeat(2, axis=0)))
    often = noisy.repeat(np.where(np.arange(20) % 3, 1, 2), axis=0)  # a third of them twice
    assert come_again(np.concatenate([often, *[noisy[-1:]] * 5]))[-3:] == [True] * 3
    assert not any(come_again(noisy[:1].repeat(20, axis=0)))  # nobody knows whether it has noise
    moved = np.zeros((20, 80, 80, 3), np.uint8)
    moved[np.arange(20), 0, 0] = np.arange(20)[:, None]  # one corner moves, nothing else has noise
    assert not any(come_again(np.concatenate([moved, moved[-1:]])))


@pytest.mark.parametrize("name", ["sample", "sample-alarm"])
def test_still_parts_of_the_packaged_clips_are_no_faults(name: str) -> None:
    health = Health()
    for frame in open_recording(name):
        assert frame.depth_m is not None
        assert health.of_picture(frame.rgb, digest_of(frame.rgb)) == ((), False)
        assert health.of_depth(frame.depth_m, grey_of(frame.rgb), ()) is None


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real recordings of ../shared/data")
def test_cameras_in_good_health_are_told_so() -> None:
    """At most one frame of a thousand; the clip of stills, each of another kitchen, is none of a camera."""
    flagged = frames = 0
    for folder in sorted((*(REAL / "video").iterdir(), *(REAL / "posed").iterdir())):
        if not folder.is_dir() or folder.name == "handles":
            continue
        health = Health()
        for frame in open_recording(folder):
            flags, _ = health.of_picture(frame.rgb, digest_of(frame.rgb))
            grey = grey_of(frame.rgb)
            wrong = None if frame.depth_m is None else health.of_depth(frame.depth_m, grey, flags)
            flagged, frames = flagged + (bool(flags) or wrong is not None), frames + 1
    assert frames > 1500
    assert flagged <= frames / 1000
