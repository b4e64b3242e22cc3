"""Where a query may be in the very frame in which it is bound."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from quest.model.decoder import HeatmapHead
from quest.model.observation import Observation, cell_centres
from quest.types import Query
from tests.tolerances import NETWORK_DEEP
from tests.track.clips import make_clip, make_tracker

POINTS = (Query.point(0, 20, 30, name="a"), Query.point(0, 40.5, 22.25, name="b", label="knob"))


def test_a_query_that_binds_counts_its_frame_once():
    """At the frame of binding the belief is that frame's heatmap about the pixel, whoever else is bound."""
    tracker, clip = make_tracker(), make_clip()
    stream, frame = tracker.stream(clip.camera, POINTS), clip.frame(0)
    with torch.inference_mode():
        stream.step(frame.rgb, frame.depth_m, 0.0, frame.cam_from_world)
        anchor = stream.memory.binding.anchor
        assert anchor is not None
        window = Observation.stack(list(stream.memory.ring))
        x = tracker.network.embed(anchor, window)[:, -1:]
        assert isinstance(tracker.network.head, HeatmapHead)
        newest = window.during(slice(-1, None))
        logits = tracker.network.head.logits(x, newest)
        seen = tracker.network.head.confidences(x, logits, newest, logits.argmax(dim=-1))[0, 0, :, 0].sigmoid()
        cell_px = cell_centres(tracker.network.config)
        for k, one in enumerate(stream.memory.following):
            assert one.belief is not None
            assert one.belief.probability.sum() == pytest.approx(1, abs=1e-5)
            uv_px = torch.tensor(POINTS[k].uv_px)
            near = (cell_px - uv_px).norm(dim=-1) < 16
            got, scores = one.belief.probability[0, near], logits[0, 0, k, near]
            expected = (seen[k] * scores / tracker.config.temperature).softmax(-1)
            torch.testing.assert_close(got / got.sum(), expected, **NETWORK_DEEP)
            assert one.belief.probability[0, (cell_px - uv_px).norm(dim=-1) < 16 + 3 * 4].sum() > 0.95


def test_what_is_asked_for_is_first_answered_near_its_pixel():
    clip = make_clip(frames=2, size=(224, 224))
    pixels = [(x, y) for x in (20, 110, 200) for y in (24, 112, 190)]
    tracker = make_tracker()
    stream = tracker.stream(clip.camera, [Query.point(0, x, y, name=f"{x} {y}") for x, y in pixels])
    answer = stream.step(**vars(clip.frame(0)))
    # Untrained scores are best anywhere; 16 px are free, another two sigmas and half a cell may come on top.
    scale = clip.camera.width / tracker.network.config.encoder.image_size
    assert np.linalg.norm(answer.uv_px - np.array(pixels), axis=-1).max() < (16 + 8 + 8) * scale
    assert all(query.bound_px is None for query in stream.memory.following)
