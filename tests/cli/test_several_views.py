"""Several views and the URDF through the command line, with a tiny network on a synthetic take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quest.cli.main import main
from quest.data.recording import write_recording
from quest.data.store import TakeStore
from quest.model.weights import save_network
from quest.tracks import read_tracks
from tests.synthetic import make_take
from tests.tiny import make_finder
from tests.track.clips import EAGER

FRAMES = 6


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_network(path, make_finder(), settings=EAGER.to_json(), about="a test")
    return path


@pytest.mark.slow
def test_views_of_a_take_and_another_recording(tmp_path: Path, weights: Path, capsys):
    take = make_take(frames=FRAMES, views=3, entities=1, size=(96, 96), seed=3)
    store = TakeStore(tmp_path / "takes")
    store.write(take)
    write_recording(take.views[2].clip, tmp_path / "third", rgb="png")
    x, y = take.views[0].uv_px[0, 0]
    first, out = str(tmp_path / "takes" / f"{take.info.name}.zarr"), tmp_path / "out"
    common = ["--weights", str(weights), "--device", "cpu", "--point", f"0,{x},{y},left"]
    others = ["--also", "1", "--also", str(tmp_path / "third")]
    assert main(["track", first, *others, *common, "--out", str(out), "--urdf", str(out / "joints.urdf")]) == 0
    written = {path.name for path in out.iterdir()}
    assert {"overlay.mp4", "overlay-1.mp4", "overlay-2.mp4", "joints.json", "joints.urdf"} <= written
    tracks = read_tracks(out / "tracks.parquet")
    assert tracks.names == ("left",)
    assert np.linalg.norm(tracks.point_world[:2] - take.point_world[:2], axis=-1).max() < 0.01  # it rests at first
    assert "overlay-2.mp4" in capsys.readouterr().out

    recording = ["track", str(tmp_path / "third"), "--also", "1", *common, "--out", str(tmp_path / "none")]
    assert main(recording) == 2
    assert "a number is a view of a take" in capsys.readouterr().err
