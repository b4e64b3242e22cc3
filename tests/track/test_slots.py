"""Tracking with learned queries: which slots are taken, and what is said where a pixel cannot be lifted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from quest.errors import InputError
from quest.model.decoder import RegressionHead
from quest.model.observation import Observation
from quest.track import Tracker, TrackerConfig
from quest.track.tracker import NOTHING_FOUND_FLAG
from quest.types import LABELS, Clip, Query, State
from tests.tiny import PAPER
from tests.tolerances import PIXEL, PIXEL_MOVED, POINT
from tests.track.clips import EAGER, make_clip, make_tracker, without_depth


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def make(config: TrackerConfig = EAGER, *, confidence: list[float] | None = None) -> Tracker:
    """A tracker whose slots answer inside the image; with ``confidence``, the logit of every slot."""
    tracker = make_tracker(PAPER, config)
    head = tracker.network.head
    assert isinstance(head, RegressionHead)
    final = head.mlp[-1]
    assert isinstance(final, torch.nn.Linear)
    with torch.no_grad():
        final.weight.mul_(0.2)
        final.bias.mul_(0.2)
        if confidence is not None:
            final.weight[2] = 0
    if confidence is not None:
        logit, forward = torch.tensor(confidence), head.forward

        def confident(x: torch.Tensor):
            p = forward(x)
            return replace(
                p, visible_logit=logit.expand_as(p.visible_logit), right_logit=logit.expand_as(p.right_logit)
            )

        head.forward = confident  # type: ignore[method-assign]
    return tracker


def slots_of(tracker: Tracker, clip: Clip, queries: list[Query] | None) -> list[int | None]:
    stream, frame = tracker.stream(clip.camera, queries), clip.frame(0)
    stream.step(frame.rgb, frame.depth_m, 0.0, frame.cam_from_world)
    return [f.slot for f in sorted(stream.memory.following, key=lambda f: f.query)]


def first_answers(clip: Clip) -> np.ndarray:
    """Where the five slots are in the first frame, in order."""
    tracks = make(confidence=[5.0, 4.0, 3.0, 2.0, 1.0]).track(clip)
    return tracks.uv_px[0]


def test_only_confident_slots_are_reported(clip: Clip):
    settings = TrackerConfig()
    tracks = make(settings, confidence=[-1.0, 2.0, -0.1, 0.1, -9.0]).track(clip)
    assert tracks.confidence.shape == (6, 2)
    assert (tracks.confidence > 0.5).all()
    assert slots_of(make(settings, confidence=[-1.0, 2.0, -0.1, 0.1, -9.0]), clip, None) == [1, 3]
    lenient = replace(settings, slot_bias=0.5)
    assert slots_of(make(lenient, confidence=[-1.0, 2.0, -0.1, 0.1, -9.0]), clip, None) == [1, 3, 2]
    nothing = make(settings, confidence=[-1.0] * 5).track(clip)
    assert nothing.frame_flags == (NOTHING_FOUND_FLAG,)


def test_labels_are_decided_when_slots_are_taken(clip: Clip):
    tracker = make()
    stream, told = tracker.stream(clip.camera), []
    for t in range(len(clip)):
        frame = clip.frame(t)
        state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        told.append(state.labels)
        if t == 0:
            with torch.inference_mode():
                network, window = tracker.network, Observation.stack(list(stream.memory.ring))
                head = network.head
                assert isinstance(head, RegressionHead)
                expected = head.labels(network.embed(network.slots(1), window))[0, 0].argmax(-1).tolist()
            assert state.labels == tuple(LABELS[expected[f.slot]] for f in stream.memory.following)  # type: ignore[index]
    assert len(set(told)) == 1


def test_prompts_take_the_most_confident_slot_of_their_label_and_wait(clip: Clip):
    asked = [Query.slot(), Query.slot()]
    assert slots_of(make(confidence=[1.0, 3.0, 2.0, 0.0, 0.0]), clip, asked) == [1, 2]
    choosy = replace(EAGER, prompt_threshold=0.5)
    tracks = make(choosy, confidence=[1.0, -3.0, -2.0, -1.0, -1.0]).track(clip, asked)
    assert np.isfinite(tracks.uv_px[:, 0]).all()
    assert (tracks.state[:, 1] == State.LOST).all()
    assert "found no entity" in tracks.frame_flags[0]


def test_points_of_one_frame_never_share_a_slot(clip: Clip):
    at = first_answers(clip)
    same = [Query.point(0, *at[0].tolist()) for _ in range(5)]
    assert sorted(slots_of(make(confidence=[0.0] * 5), clip, same)) == [0, 1, 2, 3, 4]  # type: ignore[type-var]
    order = [3, 0, 4, 2, 1]
    each = [Query.point(0, *at[k].tolist()) for k in order]
    assert slots_of(make(confidence=[0.0] * 5), clip, each) == order


def test_more_points_than_slots_share(clip: Clip):
    at = first_answers(clip)
    found = slots_of(make(confidence=[0.0] * 5), clip, [Query.point(0, *at[k % 5].tolist()) for k in range(7)])
    assert set(found) == {0, 1, 2, 3, 4}
    assert len(found) == 7


def test_later_points_take_slots_that_are_free(clip: Clip):
    at = first_answers(clip)
    tracker = make(confidence=[0.0] * 5)
    stream = tracker.stream(clip.camera, [Query.point(0, *at[2].tolist()), Query.point(1, *at[2].tolist())])
    for t in range(2):
        frame = clip.frame(t)
        stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
    first, second = (f.slot for f in stream.memory.following)
    assert first == 2 != second


def test_a_slot_that_holds_nothing_is_not_taken_for_a_point_near_it(clip: Clip):
    at = first_answers(clip)
    gap = np.linalg.norm(at - at[0], axis=-1)
    gap[0] = np.inf
    neighbour = int(gap.argmin())
    confidence = [-9.0] * 5
    confidence[neighbour] = 9.0
    # Near enough to matter: the whole width of the image costs five times as much as a probability.
    assert 5 * gap[neighbour] / 64 < 0.9
    assert slots_of(make(confidence=confidence), clip, [Query.point(0, *at[0].tolist())]) == [neighbour]


def test_a_pixel_without_depth_is_held(clip: Clip):
    assert clip.depth_m is not None
    tracker = make(confidence=[3.0] * 5)
    whole = tracker.track(clip)
    depth = clip.depth_m.copy()
    x, y = whole.uv_px[3, 0].astype(int)
    depth[3, y, x] = 0
    tracks = make(confidence=[3.0] * 5).track(replace(clip, depth_m=depth))
    np.testing.assert_allclose(tracks.point_world[3, 0], whole.point_world[2, 0], **POINT)
    assert tracks.state[3, 0] == State.HELD
    assert not tracks.visible[3, 0]
    np.testing.assert_allclose(tracks.uv_px[3, 0], whole.uv_px[3, 0], **PIXEL)
    assert (tracks.state[[2, 4], 0] == State.TRACKING).all()
    np.testing.assert_allclose(tracks.point_world[4], whole.point_world[4], **POINT)


def test_before_there_was_any_point_nothing_is_held(clip: Clip):
    assert clip.depth_m is not None
    tracker = make(confidence=[3.0] * 5)
    x, y = tracker.track(clip).uv_px[0, 0].astype(int)
    depth = clip.depth_m.copy()
    depth[0, y, x] = 0
    tracks = tracker.track(replace(clip, depth_m=depth))
    assert np.isnan(tracks.point_world[0, 0]).all()
    assert np.isfinite(tracks.point_world[1, 0]).all()


def test_frames_without_depth_hold_nothing(clip: Clip):
    tracks = make(confidence=[3.0] * 5).track(without_depth(clip, slice(2, 4)))
    assert np.isnan(tracks.point_world[2:4]).all()
    assert (tracks.state == State.TRACKING).all()


def test_a_window_is_decoded_as_it_was_trained(clip: Clip):
    """Fewer frames at the start, never more than T, and the answer is that of the newest."""
    tracker = make()
    network = tracker.network
    stream = tracker.stream(clip.camera)
    for t in range(len(clip)):
        frame = clip.frame(t)
        state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        assert len(stream.memory.ring) == min(t + 1, PAPER.window)
        with torch.inference_mode():
            x = network.embed(network.slots(1), Observation.stack(list(stream.memory.ring)))
            uv = network.head(x).uv[0, -1]  # type: ignore[call-arg]
        slots = [f.slot for f in stream.memory.following]
        np.testing.assert_allclose(state.uv_px, 64 * uv[slots].numpy(), **PIXEL_MOVED)


def test_saved_streams_go_on(clip: Clip):
    tracker = make()
    stream = tracker.stream(clip.camera, [Query.point(0, 20, 30), Query.point(3, 40, 20)])
    for t in range(2):
        frame = clip.frame(t)
        stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
    again = tracker.restore(tracker.save(stream))
    for t in range(2, 6):
        frame = clip.frame(t)
        one, two = (s.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world) for s in (stream, again))
        np.testing.assert_array_equal(one.uv_px, two.uv_px)
        np.testing.assert_array_equal(one.point_world, two.point_world)
        assert one.query == two.query


def test_learned_slots_know_no_intents(clip: Clip):
    tracker = make_tracker(replace(PAPER, intents=True))
    with pytest.raises(InputError, match="intent"):
        tracker.stream(clip.camera, [Query.semantic("rim", intent="lift")])
