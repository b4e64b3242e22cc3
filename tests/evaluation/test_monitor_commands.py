"""``quest calibrate`` and ``quest eval-monitor``, end to end on a tiny network and made-up log odds."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from quest.cli.calibrate import Calibrate, EvalMonitor
from quest.data.store import TakeStore
from quest.errors import ConfigError, InputError, WeightsError
from quest.evaluation import stream_record
from quest.evaluation.stream_record import StreamRecord
from quest.model.weights import load_network, save_network
from quest.monitor import Inputs, read_calibrations
from quest.track import Tracker
from quest.types import Take
from tests.monitor.streams import make_stream
from tests.synthetic import make_take
from tests.tiny import make_finder


def made_up(tracker: Tracker, take: Take, view: int, *, part: str, inputs: Inputs) -> StreamRecord:
    """Log odds that do not come from the tracker, whose weights are random: every second stream has a loss."""
    stream = make_stream(take.info.seed, frames=40, part=part, losses=float(take.info.seed % 2), inputs=inputs)
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
    save_network(tmp_path / "w.safetensors", make_finder(), settings="{}", about="a test")
    for name in ("validation", "test"):
        shutil.copytree(stores / name, tmp_path / name)
    return tmp_path


def calibrated(folder: Path, **changes: object) -> int:
    command = Calibrate(
        (str(folder / "validation"),), folder / "records", folder / "monitor.json", str(folder / "w.safetensors")
    )
    return replace(command, **{"inputs": ("depth",), **changes}).run()  # type: ignore[arg-type]


def judged(folder: Path, **changes: object) -> int:
    command = EvalMonitor(
        (str(folder / "test"),),
        folder / "judged",
        folder / "records",
        weights=str(folder / "w.safetensors"),
        monitor=folder / "monitor.json",
        resamples=3,
        out=folder / "drift.json",
    )
    return replace(command, **changes).run()  # type: ignore[arg-type]


@pytest.mark.slow
def test_calibrate_and_judge(folder: Path, capsys: pytest.CaptureFixture):
    with pytest.raises(WeightsError, match="quest calibrate"):
        judged(folder)

    assert calibrated(folder, shard="1/2") == 0
    assert "left to other shards: 10 streams" in capsys.readouterr().out
    assert not (folder / "monitor.json").exists()
    assert calibrated(folder, shard="0/2") == 0
    assert "AUROC" in capsys.readouterr().out

    (calibration,) = read_calibrations(folder / "monitor.json").values()
    assert calibration.block_frames == 40

    assert judged(folder, shard="0/2") == 0
    assert "left to other shards: 2 streams" in capsys.readouterr().err
    assert judged(folder) == 0
    printed = capsys.readouterr().out
    raw = json.loads((folder / "drift.json").read_text())
    assert [row["detector"] for row in raw["rows"]] == ["monitor", "cusum", "page-hinkley", "threshold"]
    assert all(row["detector"] in printed for row in raw["rows"])
    assert raw["run"]["weights_hash"] == load_network(folder / "w.safetensors").sha256
    assert raw["calibration"] == calibration.about
    assert [alarm["alpha"] for alarm in raw["rows"][0]["alarms"]] == [0.01, 0.05, 0.1]

    assert judged(folder, alpha=(0.1,), alpha_frames=40) == 0
    assert "10 in 40" in capsys.readouterr().out
    (alarm,) = json.loads((folder / "drift.json").read_text())["rows"][0]["alarms"]
    assert (alarm["alpha"], alarm["alpha_frames"]) == (0.1, 40)
    with pytest.raises(ConfigError, match="40 frames"):
        judged(folder, alpha_frames=60)

    with pytest.raises(ConfigError, match="no calibration for colours"):
        judged(folder, inputs="colours")
    assert calibrated(folder, inputs=("depth", "colours")) == 0
    assert judged(folder, inputs="colours") == 0
    names = sorted(path.name for path in (folder / "judged").iterdir())
    assert names == [
        f"panels-{n}-view0-{inputs}.npz" for n in range(110_000, 110_004) for inputs in ("colours", "depth")
    ]


def test_objects_of_the_calibration_are_not_judged(folder: Path):
    calibrated(folder)
    with pytest.raises(ConfigError, match="calibrated on them"):
        judged(folder, takes=(str(folder / "validation"),), split=("validation",))
    with pytest.raises(InputError, match="none among 0 files of depth"):
        judged(folder, calibration=folder / "elsewhere")
    with pytest.raises(ConfigError, match="alpha"):
        judged(folder, alpha=(0.0,))
    with pytest.raises(ConfigError, match="seed"):
        judged(folder, seed=-1)
    with pytest.raises(ConfigError, match="block_frames"):
        calibrated(folder, block_frames=0)
    with pytest.raises(ConfigError, match="inputs"):
        calibrated(folder, inputs=())


@pytest.mark.slow
def test_a_monitor_of_takes_is_judged_by_other_takes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    def one_object(tracker: Tracker, take: Take, view: int, *, part: str, inputs: Inputs) -> StreamRecord:
        return replace(made_up(tracker, take, view, part=part, inputs=inputs), object_id="chest")

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
    with pytest.raises(InputError, match="expected the streams that the monitor was calibrated on"):
        judged(folder)
