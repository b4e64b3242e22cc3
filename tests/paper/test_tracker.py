"""Tracking with the published network: which slots are taken, and what is said where a pixel cannot be lifted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import quest
from quest.data.cut import cut_clip
from quest.errors import InputError, WeightsError
from quest.model.frames import FrameBatch
from quest.paper.network import Decoded, SlotAnswers
from quest.paper.tracker import PaperTracker
from quest.track import load as load_ours
from quest.types import LABELS, Clip, Query, State
from tests.paper.tiny import make_paper
from tests.track.clips import make_clip, without_depth

POINTS = (Query.point(0, 20, 30, name="a"), Query.point(0, 40.5, 22.25, name="b", label="knob"))


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip()


def make(*, confidence: list[float] | None = None, found_above: float = 0.0, prompt_above: float = 0.0) -> PaperTracker:
    """A tracker whose slots answer inside the image; with ``confidence``, the logit of every slot."""
    network = make_paper()
    final = network.head[-1]
    assert isinstance(final, torch.nn.Linear)
    with torch.no_grad():
        final.weight.mul_(0.2)
        final.bias.mul_(0.2)
    if confidence is not None:
        answer, logit = network.answer, torch.tensor(confidence)

        def confident(decoded: list[Decoded], frames: FrameBatch) -> SlotAnswers:
            answers = answer(decoded, frames)
            return replace(answers, logit=logit.expand_as(answers.logit))

        network.answer = confident  # type: ignore[method-assign]
    return PaperTracker(network, device=torch.device("cpu"), found_above=found_above, prompt_above=prompt_above)


def order_of(at: np.ndarray, uv_px: np.ndarray) -> list[int]:
    """Which slots gave some answers, by where all of them are."""
    return np.linalg.norm(uv_px[:, None] - at[None], axis=-1).argmin(axis=1).tolist()


def first_answers(clip: Clip) -> np.ndarray:
    """Where the five slots are in the first frame, in order."""
    return make(confidence=[5.0, 4.0, 3.0, 2.0, 1.0]).track(clip).uv_px[0]


def test_answers(clip: Clip):
    tracks = make().track(clip, POINTS)
    assert (tracks.names, tracks.labels) == (("a", "b"), (None, "knob"))
    assert tracks.uv_px.shape == (6, 2, 2)
    assert np.isfinite(tracks.uv_px).all()
    assert ((tracks.confidence > 0) & (tracks.confidence < 1)).all()
    assert set(tracks.state.flat) <= {s.value for s in State}
    assert (tracks.lost_p, tracks.alarm, tracks.joints, tracks.frame_flags) == (None, None, None, ())


def test_the_future_is_not_used(clip: Clip):
    for queries in (POINTS, None):
        whole, start = make().track(clip, queries), make().track(cut_clip(clip, slice(0, 3)), queries)
        np.testing.assert_allclose(whole.uv_px[:3], start.uv_px, atol=1e-4)
        np.testing.assert_allclose(whole.point_world[:3], start.point_world, atol=1e-4)


def test_a_window_is_decoded_as_it_was_trained(clip: Clip):
    """Fewer frames at the start, never more than T, and the answer is that of the newest."""
    tracker, seen = make(), []
    embed = tracker.network.embed

    def watched(features: Tensor) -> list[Decoded]:
        seen.extend([features.shape[1]] * len(features))
        return embed(features)

    tracker.network.embed = watched  # type: ignore[method-assign]
    tracker.track(clip)
    assert seen == [1, 2, 3, 4, 4, 4]


@pytest.mark.parametrize("at_a_time", [1, 2, 5])
def test_how_many_frames_are_decoded_together_changes_nothing(
    clip: Clip, at_a_time: int, monkeypatch: pytest.MonkeyPatch
):
    whole = make().track(clip)
    monkeypatch.setattr("quest.paper.tracker._AT_A_TIME", at_a_time)
    parts = make().track(clip)
    np.testing.assert_allclose(parts.uv_px, whole.uv_px, atol=1e-3)
    np.testing.assert_allclose(parts.point_world, whole.point_world, atol=1e-4)


def test_only_confident_slots_are_reported(clip: Clip):
    confidence = [-1.0, 2.0, -0.1, 0.1, -9.0]
    tracks = make(confidence=confidence, found_above=0.5).track(clip)
    assert (tracks.confidence > 0.5).all()
    assert order_of(first_answers(clip), tracks.uv_px[0]) == [1, 3]
    assert len(set(tracks.names)) == 2
    assert set(tracks.labels) <= set(LABELS)
    assert make(confidence=[-1.0] * 5, found_above=0.5).track(clip).uv_px.shape == (6, 0, 2)


def test_prompts_take_the_most_confident_slot_of_their_label_and_wait(clip: Clip):
    asked = [Query.slot(), Query.slot()]
    tracks = make(confidence=[1.0, 3.0, 2.0, 0.0, 0.0]).track(clip, asked)
    assert order_of(first_answers(clip), tracks.uv_px[0]) == [1, 2]
    tracks = make(confidence=[1.0, -3.0, -2.0, -1.0, -1.0], prompt_above=0.5).track(clip, asked)
    assert np.isfinite(tracks.uv_px[:, 0]).all()
    assert np.isnan(tracks.uv_px[:, 1]).all()
    assert (tracks.state[:, 1] == State.LOST).all()
    assert "found no entity" in tracks.frame_flags[0]
    label = make().track(clip).labels[0]
    assert label is not None
    named = make().track(clip, [Query.semantic(label, "mine")])
    assert (named.names, named.labels) == (("mine",), (label,))


def test_points_of_one_frame_never_share_a_slot(clip: Clip):
    at = first_answers(clip)
    same = make(confidence=[0.0] * 5).track(clip, [Query.point(0, *at[0].tolist()) for _ in range(5)])
    assert sorted(order_of(at, same.uv_px[0])) == [0, 1, 2, 3, 4]
    order = [3, 0, 4, 2, 1]
    each = make(confidence=[0.0] * 5).track(clip, [Query.point(0, *at[k].tolist()) for k in order])
    assert order_of(at, each.uv_px[0]) == order
    more = make(confidence=[0.0] * 5).track(clip, [Query.point(0, *at[k % 5].tolist()) for k in range(7)])
    assert set(order_of(at, more.uv_px[0])) == {0, 1, 2, 3, 4}, "where there are more points, some share"


def test_later_points_take_slots_that_are_free(clip: Clip):
    at = first_answers(clip)
    queries = [Query.point(0, *at[2].tolist()), Query.point(1, *at[2].tolist())]
    tracks = make(confidence=[0.0] * 5).track(clip, queries)
    assert order_of(at, tracks.uv_px[0, :1]) == [2]
    assert np.isnan(tracks.uv_px[0, 1]).all()
    assert np.linalg.norm(tracks.uv_px[1, 0] - tracks.uv_px[1, 1]) > 0


def test_a_slot_that_holds_nothing_is_not_taken_for_a_point_near_it(clip: Clip):
    at = first_answers(clip)
    gap = np.linalg.norm(at - at[0], axis=-1)
    gap[0] = np.inf
    neighbour = int(gap.argmin())
    confidence = [-9.0] * 5
    confidence[neighbour] = 9.0
    # Near enough to matter: the whole width of the image costs five times as much as a probability.
    assert 5 * gap[neighbour] / 64 < 0.9
    tracks = make(confidence=confidence).track(clip, [Query.point(0, *at[0].tolist())])
    assert order_of(at, tracks.uv_px[0]) == [neighbour]


def test_lifted_points_are_where_the_cameras_say(clip: Clip):
    """What is answered for a pixel with depth is that pixel's world point, in every pose of the camera."""
    assert clip.depth_m is not None
    poses = []
    for t in range(len(clip)):
        motion = np.eye(4)
        c, s = np.cos(0.03 * t), np.sin(0.03 * t)
        motion[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        motion[0, 3] = 0.02 * t
        poses.append(motion @ clip.cam_from_world[t])
    moving = replace(clip, cam_from_world=np.stack(poses))
    tracks, checked = make().track(moving), 0
    for t, k in np.ndindex(*tracks.confidence.shape):
        x, y = tracks.uv_px[t, k]
        z = clip.depth_m[t, int(y), int(x)]
        if z > 0:
            camera = clip.camera
            seen = np.array([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z, 1.0])
            expected = (np.linalg.inv(moving.cam_from_world[t]) @ seen)[:3]
            np.testing.assert_allclose(tracks.point_world[t, k], expected, atol=1e-4)
            checked += 1
    assert checked > 10


def test_a_pixel_without_depth_is_held(clip: Clip):
    assert clip.depth_m is not None
    whole = make(confidence=[3.0] * 5).track(clip)
    depth = clip.depth_m.copy()
    x, y = whole.uv_px[3, 0].astype(int)
    depth[3, y, x] = 0
    tracks = make(confidence=[3.0] * 5).track(replace(clip, depth_m=depth))
    np.testing.assert_allclose(tracks.point_world[3, 0], whole.point_world[2, 0], atol=1e-5)
    assert tracks.state[3, 0] == State.HELD
    assert not tracks.visible[3, 0]
    np.testing.assert_allclose(tracks.uv_px[3, 0], whole.uv_px[3, 0], atol=1e-4)
    assert (tracks.state[[2, 4], 0] == State.TRACKING).all()
    np.testing.assert_allclose(tracks.point_world[4], whole.point_world[4], atol=1e-5)


def test_frames_without_depth_hold_nothing(clip: Clip):
    tracks = make(confidence=[3.0] * 5).track(without_depth(clip, slice(2, 4)))
    assert np.isnan(tracks.point_world[2:4]).all()
    assert (tracks.state == State.TRACKING).all()
    assert "depth missing" in tracks.frame_flags[0]
    dark = make().track(replace(clip, depth_m=None), POINTS)
    assert np.isnan(dark.point_world).all()
    assert np.isfinite(dark.uv_px).all()


def test_bad_queries_are_refused(clip: Clip):
    for queries, match in (
        ([Query.semantic("rim", intent="lift")], "intent"),
        ([Query.point(0, 99, 9)], "within 64 x 64"),
        ([Query.point(9, 9, 9)], "6 frames"),
        ([Query.slot("a"), Query.slot("a")], "names"),
        ([Query.text("left door")], "finds no doors"),
    ):
        with pytest.raises(InputError, match=match):
            make().track(clip, queries)


def test_weights_are_loaded_by_the_one_door(clip: Clip, tmp_path: Path):
    path = tmp_path / "weights.safetensors"
    make_paper().save(path, about="a test")
    tracker = quest.load(path, device="cpu")
    assert isinstance(tracker, PaperTracker)
    assert tracker.track(clip, POINTS).uv_px.shape == (6, 2, 2)
    with pytest.raises(WeightsError, match="preset paper"):
        load_ours(path)
