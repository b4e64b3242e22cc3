"""Trackers that use QueST's network without its queries: what they find, link, chain and refuse."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from quest.baselines.clip_frames import ClipFrames
from quest.baselines.flow_chain import FlowChain
from quest.baselines.redetect import Detections, Detector, Redetect, link
from quest.data.cut import cut_clip
from quest.errors import ConfigError, InputError, WeightsError
from quest.geometry import project, transform
from quest.types import Clip, Query, State, Take
from tests.synthetic import make_take
from tests.tiny import make_network

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=16, views=2, entities=2, size=(64, 48))


class Scripted(Detector):
    """Sees what it is told to see, by frame; nothing elsewhere."""

    def __init__(self, seen: dict[int, list[tuple[float, float]]]) -> None:
        super().__init__(make_network(), device=CPU)
        self.seen = seen
        self.asked: list[int] = []

    def detect(self, clip: Clip, frames: ClipFrames, t: int) -> Detections:
        self.asked.append(t)
        uv_px = np.array(self.seen.get(t, []), np.float32).reshape(-1, 2)
        point = np.concatenate([uv_px / 100, np.full((len(uv_px), 1), 2.0)], axis=1).astype(np.float32)
        return Detections(uv_px, point, ("handle",) * len(uv_px), np.full(len(uv_px), 0.9, np.float32))


def test_clip_frames_agree_with_the_camera(take: Take) -> None:
    network = make_network()
    view = take.views[0]
    frames = ClipFrames(network, view.clip, device=CPU)
    batch, _ = frames.see(9)
    point = take.point_world[9].astype(np.float64)
    uv_px = batch.from_reference(frames.to_reference(point)[None, None])[0, 0] / frames.letterbox.size
    np.testing.assert_allclose(frames.to_source(uv_px), view.uv_px[9], atol=1e-2)
    np.testing.assert_allclose(frames.to_input(view.uv_px[9]).numpy(), uv_px.numpy(), atol=1e-4)
    step = np.array([[0.01, -0.02, 0.03]])
    moved = frames.to_reference(point[:1] + step) - frames.to_reference(point[:1])
    np.testing.assert_allclose(frames.to_world(moved), step, atol=1e-5)


def test_specks_of_depth_make_no_reference_frame(take: Take) -> None:
    clip = take.views[0].clip
    assert clip.depth_m is not None
    depth_m = clip.depth_m.copy()
    depth_m[0] = 0
    specks = dataclasses.replace(clip, depth_m=depth_m.copy())
    assert specks.depth_m is not None
    specks.depth_m[0, 20, 20] = 2.0
    network = make_network()
    without = ClipFrames(network, dataclasses.replace(clip, depth_m=depth_m), device=CPU)
    assert ClipFrames(network, specks, device=CPU).scale_m == without.scale_m != 1.0


def test_clip_frames_keep_a_window_of_what_was_seen(take: Take) -> None:
    network = make_network()
    frames = ClipFrames(network, take.views[0].clip, device=CPU)
    _, first = frames.see(0)
    window = frames.window()
    assert window.tokens.shape[1] == network.config.window
    torch.testing.assert_close(window.tokens[:, :1], first.tokens)
    for t in range(1, 6):
        _, newest = frames.see(t)
    torch.testing.assert_close(frames.window().tokens[:, -1:], newest.tokens)


def test_detections_lie_in_the_image_and_above_the_threshold(take: Take) -> None:
    clip = take.views[0].clip
    everything = Detector(make_network(), device=CPU, min_logit=-100.0)
    found = everything.detect(clip, everything.frames(clip), 0)
    assert 0 < len(found.label) <= everything.network.config.slots
    assert (found.confidence > 0.5).all()
    nothing = Detector(make_network(), device=CPU, min_logit=100.0)
    assert nothing.detect(clip, nothing.frames(clip), 0).uv_px.shape == (0, 2)


def test_link_makes_most_pairs_then_the_least_distance() -> None:
    gap = np.array([[0.1, 0.2, 9.0], [0.05, 9.0, 9.0], [9.0, 9.0, np.nan]])
    rows, columns = link(gap, 0.25)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 1), (1, 0)]
    for empty in (np.zeros((0, 3)), np.zeros((2, 0))):
        assert len(link(empty, 0.25)[0]) == 0


def test_redetect_follows_the_nearest_detection_and_holds_between(take: Take) -> None:
    clip = take.views[0].clip
    detector = Scripted({0: [(20, 20), (40, 20)], 4: [(41, 20), (22, 20)], 8: [(24, 20)]})
    tracks = Redetect(detector).track(clip, [Query.point(0, 21, 20), Query.point(0, 39, 20)])
    np.testing.assert_allclose(tracks.uv_px[4, :, 0], [22, 41])
    np.testing.assert_allclose(tracks.point_world[:4, :, 0], np.tile([0.2, 0.4], (4, 1)), atol=1e-6)
    assert tracks.visible[:8].all()
    np.testing.assert_allclose(tracks.point_world[[4, 8], 0, 0], [0.22, 0.24], atol=1e-6)
    np.testing.assert_allclose(tracks.point_world[4:, 1, 0], 0.41, atol=1e-6)
    assert (tracks.state[8:, 1] == State.HELD).all()
    assert (tracks.state[:12, 0] == State.TRACKING).all()
    assert detector.asked == [0, 4, 8, 12]


def test_redetect_binds_at_the_querys_frame_or_stays_at_its_pixel(take: Take) -> None:
    clip = take.views[0].clip
    detector = Scripted({2: [(20, 20)], 4: [(21, 20)]})
    tracks = Redetect(detector).track(clip, [Query.point(2, 22, 20), Query.point(2, 60, 40)])
    assert np.isnan(tracks.uv_px[:2]).all()
    assert (tracks.state[:2] == State.LOST).all()
    np.testing.assert_allclose(tracks.uv_px[2], [[20, 20], [60, 40]])
    assert list(tracks.visible[2]) == [True, False]
    assert tracks.visible[4, 0]
    assert 2 in detector.asked


def test_redetect_discovers_what_the_first_frame_shows(take: Take) -> None:
    clip = take.views[0].clip
    tracks = Redetect(Scripted({0: [(20, 20), (40, 20)], 4: [(21, 20), (40, 21)]})).track(clip)
    assert tracks.labels == ("handle", "handle")
    assert (tracks.confidence[7] > 0.5).all()
    none = Redetect(Scripted({})).track(clip)
    assert none.uv_px.shape == (16, 0, 2)
    assert any("nothing was detected" in flag for flag in none.frame_flags)


def test_redetect_on_a_network_is_repeatable_and_causal(take: Take) -> None:
    clip = take.views[1].clip
    tracker = Redetect(Detector(make_network(), device=CPU, min_logit=-100.0))
    queries = [Query.point(0, 30, 20), Query.point(3, 10, 30)]
    whole, again = tracker.track(clip, queries), tracker.track(clip, queries)
    np.testing.assert_array_equal(whole.point_world, again.point_world)
    np.testing.assert_array_equal(tracker.track(cut_clip(clip, slice(10)), queries).point_world, whole.point_world[:10])


def make_flow_chain(**settings: float) -> FlowChain:
    network = make_network(flow=True)
    return FlowChain(Detector(network, device=CPU, min_logit=-100.0), unit_m=lambda clip: 0.5, **settings)  # type: ignore[arg-type]


def test_flow_chain_needs_a_flow_head() -> None:
    with pytest.raises(WeightsError, match="flow head"):
        FlowChain(Detector(make_network(), device=CPU), unit_m=lambda clip: 1.0)
    with pytest.raises(ConfigError, match="noise"):
        make_flow_chain(noise=-0.1)


def test_flow_without_motion_stays_and_noise_wanders_by_its_own_measure(take: Take) -> None:
    view = take.views[0]
    queries = [Query.point(0, *map(float, view.uv_px[0, 0])), Query.point(5, *map(float, view.uv_px[5, 1]))]
    still = make_flow_chain()
    flow = still.detector.network.flow
    assert flow is not None
    with torch.no_grad():
        for parameter in flow.out[-1].parameters():  # type: ignore[union-attr]
            parameter.zero_()
    tracks = still.track(view.clip, queries)
    np.testing.assert_allclose(tracks.point_world[:, 0], np.tile(tracks.point_world[0, 0], (16, 1)), atol=1e-6)
    np.testing.assert_allclose(tracks.point_world[0, 0], take.point_world[0, 0], atol=0.02)
    assert np.isnan(tracks.point_world[:5, 1]).all()
    noisy = FlowChain(still.detector, unit_m=lambda clip: 0.5, noise=0.02, seed=1)
    steps = np.diff(noisy.track(view.clip, queries).point_world[5:], axis=0)
    assert 0.006 < steps.std() < 0.014  # 0.02 of 0.5 m


def test_flow_chain_is_seeded_by_clip(take: Take) -> None:
    first, second = take.views[0].clip, take.views[1].clip
    queries = [Query.point(0, 30.0, 20.0)]
    chain = make_flow_chain(noise=0.05)
    own = chain.track(first, queries).point_world
    chain.track(second, queries)
    np.testing.assert_array_equal(chain.track(first, queries).point_world, own)
    assert not np.array_equal(make_flow_chain(noise=0.05, seed=1).track(first, queries).point_world, own)


def test_flow_moves_by_the_heads_displacement(take: Take) -> None:
    clip = take.views[0].clip
    chain = make_flow_chain()
    network = chain.detector.network
    network.displace = lambda embedding, point: torch.full((1, point.shape[2], 3), 0.01)  # type: ignore[method-assign]
    frames = ClipFrames(network, clip, device=CPU)
    tracks = chain.track(clip, [Query.point(0, 30.0, 20.0)])
    expected = frames.to_world(torch.full((1, 3), 0.01))
    np.testing.assert_allclose(np.diff(tracks.point_world[:, 0], axis=0), np.tile(expected, (15, 1)), atol=1e-5)
    cam_from_world = torch.from_numpy(clip.cam_from_world).double()
    point_cam = transform(cam_from_world, torch.from_numpy(tracks.point_world[:, 0]).double())
    np.testing.assert_allclose(tracks.uv_px[:, 0], project(point_cam, clip.camera).numpy(), atol=1e-2)


@pytest.mark.parametrize("kind", ["redetect", "flow-chain"])
def test_what_both_refuse_and_tell(take: Take, kind: str) -> None:
    clip = take.views[0].clip
    tracker = Redetect(Detector(make_network(), device=CPU)) if kind == "redetect" else make_flow_chain()
    assert tracker.name == kind
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
