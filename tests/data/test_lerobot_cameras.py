"""LeRobot v3: the intrinsics of every episode."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from quest.data.frame_source import Parts
from quest.data.lerobot_export import Episode, export_lerobot
from quest.data.recording import open_recording
from quest.types import Take
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def takes() -> list[Take]:
    return [make_take(frames=12 + k, views=2, entities=3 - k, size=(64, 48), seed=k) for k in range(2)]


def test_every_episode_has_its_own_intrinsics(takes: list[Take], tmp_path: Path):
    first, second = (Episode({"front": take.views[0].clip, "side": take.views[1].clip}, "look") for take in takes)
    clip = second.views["front"]
    other = replace(clip, camera=replace(clip.camera, fx=1.5 * clip.camera.fx, fy=1.5 * clip.camera.fy))
    export_lerobot([first, replace(second, views=second.views | {"front": other})], tmp_path / "set")
    for index, episode in enumerate((first.views["front"], other)):
        parts = Parts(episode=index, camera_key="front")
        assert open_recording(tmp_path / "set", parts=parts).camera == episode.camera
    features = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["features"]
    assert "quest.camera" not in features["observation.images.front"]["info"], "it would hold for one episode only"
    assert "quest.camera" in features["observation.images.side"]["info"]


def test_datasets_with_intrinsics_in_the_feature_alone(takes: list[Take], tmp_path: Path):
    """As they were written before there was a column for them."""
    folder = tmp_path / "set"
    export_lerobot([Episode.of_take(take) for take in takes], folder)
    path = next(folder.glob("meta/episodes/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.drop_columns([name for name in table.column_names if name.startswith("quest/camera")]), path)
    assert open_recording(folder).camera == takes[0].views[0].clip.camera
