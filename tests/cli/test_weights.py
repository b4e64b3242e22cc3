"""``quest weights tune`` and ``quest calibrate`` on objects that are in no part of the split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from quest.cli.calibrate import Calibrate
from quest.cli.weights import TuneWeights
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation import stream_record, tuning
from quest.evaluation.stream_record import StreamRecord
from quest.evaluation.tuning import Tuned
from quest.model.weights import load_network, save_network
from quest.monitor import Inputs, read_calibrations
from quest.track import Tracker, TrackerConfig
from quest.types import Take
from tests.monitor.streams import make_stream
from tests.synthetic import make_take
from tests.tiny import make_finder

TAKES = 20


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Takes of one object of the user's own, and one each of a training and a test object."""
    store = TakeStore(tmp_path_factory.mktemp("takes") / "mine")
    base = make_take(frames=2, views=1, entities=1, size=(16, 16))
    for seed in range(TAKES):
        info = replace(base.info, name=f"toolbox-{seed}", object_id="toolbox", source="own", seed=seed)
        store.write(replace(base, info=info))
    for seed in (1, 110_001):
        store.write(replace(base, info=replace(base.info, name=f"panels-{seed}", object_id=f"panels-{seed}")))
    return Path(store.url)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Weights that say more than a tracker needs."""
    path = tmp_path / "weights.safetensors"
    save_network(path, make_finder(), settings="{}", about="a test", licence="MIT", version="3")
    return path


def test_own_objects_choose_the_threshold(takes: Path, weights: Path, monkeypatch: pytest.MonkeyPatch):
    chosen = {}

    def tuned(tracker, pictures, takes):
        chosen.update(takes[0][1])
        assert not pictures
        return Tuned(replace(tracker.config, bias=0.3), ("takes",), (1.0,), (1.0,))

    monkeypatch.setattr(tuning, "tune", tuned)
    assert TuneWeights(weights, takes=(str(takes),), size_px=640).run() == 0
    assert chosen == {f"toolbox-{seed}": "validation" for seed in range(TAKES)}
    loaded = load_network(weights)
    assert TrackerConfig.from_json(loaded.settings) == TrackerConfig(bias=0.3, size_px=640)
    assert (loaded.about, loaded.licence, loaded.version) == ("a test", "MIT", "3")


def test_only_files_are_rewritten(takes: Path, tmp_path: Path):
    """Told before anything is tracked."""
    for name in (tmp_path, Path("quest-s16")):
        with pytest.raises(ConfigError, match="quest weights save"):
            TuneWeights(name, takes=(str(takes),)).run()


def test_own_takes_calibrate_the_monitor(
    takes: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def made_up(tracker: Tracker, take: Take, view: int, *, part: str, inputs: Inputs) -> StreamRecord:
        stream = make_stream(take.info.seed, frames=40, part=part, inputs=inputs)
        return replace(stream, take=take.info.name, view=view, object_id=take.info.object_id)

    monkeypatch.setattr(stream_record, "record_stream", made_up)
    folder = weights.parent
    command = Calibrate((str(takes),), folder / "records", folder / "monitor.json", str(weights))
    with pytest.raises(ConfigError, match="objects to fit on"):
        command.run()  # one object says nothing about other objects
    assert replace(command, unit="take").run() == 0
    assert "as many other takes of the same objects" in " ".join(capsys.readouterr().out.split())
    found = read_calibrations(folder / "monitor.json")
    assert list(found) == ["depth", "colours"]
    assert {calibration.unit for calibration in found.values()} == {"take"}
