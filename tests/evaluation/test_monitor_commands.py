"""``quest weights calibrate`` and ``quest eval-monitor``, end to end on a tiny network and made-up signals."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from quest.cli.evaluate_monitor import EvalMonitor
from quest.cli.main import parse
from quest.cli.weights import CalibrateWeights
from quest.data.store import TakeStore
from quest.errors import ConfigError, InputError
from quest.evaluation import calibrate, stream_record
from quest.evaluation.calibrate import FitConfig
from quest.evaluation.stream_record import StreamRecord, tracker_id
from quest.model.weights import load_network, save_network
from quest.monitor import Calibration
from quest.track import Tracker, load
from quest.types import Take
from tests.monitor.streams import make_stream
from tests.synthetic import make_take
from tests.tiny import make_network


def made_up(tracker: Tracker, take: Take, view: int, *, part: str) -> StreamRecord:
    """Signals that do not come from the tracker, whose weights are random: every second stream has a loss."""
    stream = make_stream(take.info.seed, frames=40, part=part, losses=float(take.info.seed % 2))
    return replace(stream, take=take.info.name, view=view, object_id=take.info.object_id)


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 validation takes and 4 test takes."""
    folder = tmp_path_factory.mktemp("stores")
    base = make_take(frames=2, views=1, entities=1, size=(16, 16))
    for name, first, count in (("validation", 100_000, 20), ("test", 110_000, 4)):
        store = TakeStore(folder / name)
        for seed in range(first, first + count):
            named = replace(base.info, name=f"panels-{seed}", object_id=f"panels-{seed}", seed=seed)
            store.write(replace(base, info=named))
    return folder


@pytest.fixture
def folder(tmp_path: Path, stores: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with weights and the takes."""
    monkeypatch.setattr(stream_record, "record_stream", made_up)
    monkeypatch.setattr(calibrate, "FitConfig", lambda: FitConfig(folds=2, hidden=(0,), decay=(0.1,), epochs=2))
    save_network(tmp_path / "w.safetensors", make_network(), settings="{}", about="a test")
    for name in ("validation", "test"):
        shutil.copytree(stores / name, tmp_path / name)
    return tmp_path


def calibrated(folder: Path, **changes: str | int) -> int:
    command = CalibrateWeights(folder / "w.safetensors", (str(folder / "validation"),), folder / "records")
    return replace(command, **changes).run()  # type: ignore[arg-type]


def judged(folder: Path, **changes: object) -> int:
    command = EvalMonitor(
        (str(folder / "test"),),
        folder / "judged",
        folder / "records",
        weights=str(folder / "w.safetensors"),
        resamples=3,
        out=folder / "drift.json",
    )
    return replace(command, **changes).run()  # type: ignore[arg-type]


@pytest.mark.slow
def test_calibrate_and_judge(folder: Path, capsys: pytest.CaptureFixture):
    before = load_network(folder / "w.safetensors")
    assert before.monitor is None
    made_by = tracker_id(load(folder / "w.safetensors"))
    with pytest.raises(ConfigError, match="quest weights calibrate"):
        judged(folder)

    assert calibrated(folder, shard="1/2") == 0
    assert "left to other shards: 10 streams" in capsys.readouterr().out
    assert load_network(folder / "w.safetensors").monitor is None
    assert calibrated(folder, shard="0/2") == 0
    assert "AUROC" in capsys.readouterr().out

    after = load_network(folder / "w.safetensors")
    assert after.monitor is not None
    assert Calibration.from_json(after.monitor).block_frames == 40
    assert (after.settings, after.about) == (before.settings, before.about)
    assert after.network.state_dict().keys() == before.network.state_dict().keys()
    assert tracker_id(load(folder / "w.safetensors")) == made_by

    assert judged(folder, shard="0/2") == 0
    assert "left to other shards: 2 streams" in capsys.readouterr().err
    assert judged(folder) == 0
    printed = capsys.readouterr().out
    raw = json.loads((folder / "drift.json").read_text())
    assert [row["detector"] for row in raw["rows"]] == ["monitor", "cusum", "page-hinkley", "threshold"]
    assert all(row["detector"] in printed for row in raw["rows"])
    assert raw["run"]["weights_hash"] == after.sha256
    assert raw["calibration"] == Calibration.from_json(after.monitor).about
    assert [alarm["alpha"] for alarm in raw["rows"][0]["alarms"]] == [0.01, 0.05, 0.1]

    assert judged(folder, alpha=(0.1,), alpha_frames=40) == 0
    assert "10 in 40" in capsys.readouterr().out
    (alarm,) = json.loads((folder / "drift.json").read_text())["rows"][0]["alarms"]
    assert (alarm["alpha"], alarm["alpha_frames"]) == (0.1, 40)
    with pytest.raises(ConfigError, match="40 frames"):
        judged(folder, alpha_frames=60)


def test_objects_of_the_calibration_are_not_judged(folder: Path):
    calibrated(folder)
    with pytest.raises(ConfigError, match="calibrated on them"):
        judged(folder, takes=(str(folder / "validation"),), split=("validation",))
    with pytest.raises(InputError, match="none among 0 files"):
        judged(folder, calibration=folder / "elsewhere")
    with pytest.raises(ConfigError, match="alpha"):
        judged(folder, alpha=(0.0,))
    with pytest.raises(ConfigError, match="seed"):
        judged(folder, seed=-1)
    with pytest.raises(ConfigError, match="block_frames"):
        calibrated(folder, block_frames=0)


@pytest.mark.slow
def test_a_monitor_of_takes_is_judged_by_other_takes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    def one_object(tracker: Tracker, take: Take, view: int, *, part: str) -> StreamRecord:
        return replace(made_up(tracker, take, view, part=part), object_id="chest")

    monkeypatch.setattr(stream_record, "record_stream", one_object)
    assert calibrated(folder, unit="take") == 0
    assert judged(folder) == 0
    assert "every take counts as an object" in capsys.readouterr().err
    raw = json.loads((folder / "drift.json").read_text())
    assert [row["objects"] for row in raw["rows"]] == [4] * 4
    assert "as many other takes of the same objects" in raw["calibration"]
    with pytest.raises(ConfigError, match="calibrated on them"):
        judged(folder, takes=(str(folder / "validation"),), split=("validation",))


def test_the_rivals_need_the_streams_of_the_calibration(folder: Path):
    calibrated(folder)
    for left in sorted((folder / "records").iterdir())[:4]:
        left.unlink()
    with pytest.raises(InputError, match="expected the streams that the weights were calibrated on"):
        judged(folder)


def test_a_monitor_outlives_being_saved_again(folder: Path):
    calibrated(folder)
    path = folder / "w.safetensors"
    loaded = load_network(path)
    save_network(path, loaded.network, settings=loaded.settings, about="again", monitor=loaded.monitor)
    assert load_network(path).monitor == loaded.monitor


def test_arguments():
    command = parse(
        [
            "eval-monitor",
            "--takes",
            "a",
            "b",
            "--records",
            "r",
            "--calibration",
            "c",
            "--shard",
            "0/2",
            "--alpha",
            "0.05",
        ]
    )
    assert isinstance(command, EvalMonitor)
    assert (command.takes, command.alpha) == (("a", "b"), (0.05,))
    command = parse(["weights", "calibrate", "w.safetensors", "--takes", "a", "b", "--records", "r"])
    assert command == CalibrateWeights(Path("w.safetensors"), ("a", "b"), Path("r"))
