from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from quest.data.recording import read_recording
from quest.data.sample import SAMPLES, sample_folder
from quest.errors import RecordingError
from quest.geometry import project, transform


@pytest.mark.parametrize("name", SAMPLES)
def test_a_clip_and_its_truth_belong_together(name: str) -> None:
    clip = read_recording(sample_folder(name))
    truth = json.loads((sample_folder(name) / "truth.json").read_text())
    assert sum(path.stat().st_size for path in sample_folder(name).rglob("*") if path.is_file()) < 6_000_000
    assert clip.depth_m is not None
    assert (clip.camera.width, clip.camera.height) == (640, 480)
    moving = [entity for entity in truth["entities"] if entity["moves"]]
    kinds = {"sample": {"revolute", "prismatic"}, "sample-alarm": {"prismatic"}}
    assert {entity["joint"]["kind"] for entity in moving} == kinds[name]
    for entity in truth["entities"]:
        points, uv_px = np.array(entity["point_world_m"]), np.array(entity["uv_px"])
        assert len(points) == len(uv_px) == len(clip)
        in_camera = transform(torch.from_numpy(clip.cam_from_world), torch.from_numpy(points)[:, None])[:, 0]
        np.testing.assert_allclose(project(in_camera, clip.camera).numpy(), uv_px, atol=1.0)
        seen = np.concatenate([np.arange(*span) for span in entity["visible_frames"]])
        x, y = uv_px[seen].astype(int).T
        off_m = np.abs(clip.depth_m[seen, y, x] - in_camera[seen, 2].numpy())
        assert np.median(off_m) < 0.02
    for occluded, first, end in truth["occluded"]:
        (entity,) = (entity for entity in moving if entity["name"] == occluded)
        assert not any(start < end and first < stop for start, stop in entity["visible_frames"])


def test_no_such_clip() -> None:
    with pytest.raises(RecordingError, match="sample-alarm"):
        sample_folder("sampel")
