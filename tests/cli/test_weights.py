"""``quest weights tune`` and ``calibrate`` on objects that are in no part of the split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from quest.cli.weights import CalibrateWeights, ShowWeights, TuneWeights
from quest.data.store import TakeStore
from quest.errors import ConfigError, WeightsError
from quest.evaluation import calibrate, stream_record, tuning
from quest.evaluation.calibrate import FitConfig
from quest.evaluation.stream_record import StreamRecord
from quest.evaluation.tuning import Tuned
from quest.model.weights import load_network, save_network
from quest.monitor import Calibration
from quest.track import Tracker, TrackerConfig, load
from quest.types import Take
from tests.monitor.streams import make_stream
from tests.synthetic import make_take
from tests.tiny import make_network

TAKES = 30


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
    """Weights that say more than a tracker needs, and whose monitor is of another version of quest."""
    path = tmp_path / "weights.safetensors"
    of_before = '{"format": 0}'
    save_network(path, make_network(), settings="{}", about="a test", monitor=of_before, licence="MIT", version="3")
    with pytest.raises(WeightsError, match="quest weights calibrate"):
        load(path)
    return path


@pytest.mark.parametrize(("setting", "kept"), [("jump", False), ("slot_bias", True)])
def test_own_objects_choose_the_settings(
    takes: Path, weights: Path, setting: str, kept: bool, monkeypatch: pytest.MonkeyPatch
):
    """Other settings of following make other signals; the monitor then belongs to settings that are no more."""
    chosen = {}

    def tuned(tracker, takes, *, report, discovery_only):
        chosen.update(takes[0][1])
        return Tuned(replace(TrackerConfig(), **{setting: 0.3}), (), 1.0, float(discovery_only))

    monkeypatch.setattr(tuning, "tune", tuned)
    assert TuneWeights(weights, takes=(str(takes),)).run() == 0
    assert chosen == {f"toolbox-{seed}": "validation" for seed in range(TAKES)}
    loaded = load_network(weights)
    assert getattr(TrackerConfig.from_json(loaded.settings), setting) == 0.3
    assert (loaded.monitor is not None) == kept
    assert (loaded.about, loaded.licence, loaded.version) == ("a test", "MIT", "3")


def test_only_files_are_rewritten(takes: Path, tmp_path: Path):
    """Told before anything is tracked."""
    for name in (tmp_path, Path("quest-s16")):
        with pytest.raises(ConfigError, match="quest weights save"):
            TuneWeights(name, takes=(str(takes),)).run()
        with pytest.raises(ConfigError, match="quest weights save"):
            CalibrateWeights(name, (str(takes),), tmp_path / "records").run()


def test_own_takes_calibrate_the_monitor(
    takes: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def made_up(tracker: Tracker, take: Take, view: int, *, part: str) -> StreamRecord:
        stream = make_stream(take.info.seed, frames=40, part=part)
        return replace(stream, take=take.info.name, view=view, object_id=take.info.object_id)

    monkeypatch.setattr(stream_record, "record_stream", made_up)
    monkeypatch.setattr(calibrate, "FitConfig", lambda: FitConfig(folds=2, hidden=(0,), decay=(0.1,), epochs=2))
    command = CalibrateWeights(weights, (str(takes),), weights.parent / "records")
    with pytest.raises(ConfigError, match="objects to fit on"):
        command.run()  # one object says nothing about other objects
    assert replace(command, unit="take").run() == 0
    loaded = load_network(weights)
    assert loaded.monitor is not None
    calibration = Calibration.from_json(loaded.monitor)
    assert calibration.unit == "take"
    assert ShowWeights(str(weights)).run() == 0
    assert "as many other takes of the same objects" in " ".join(capsys.readouterr().out.split())
    outdated = replace(calibration, revision=0).to_json()
    replace(loaded, monitor=outdated).save(weights)
    assert ShowWeights(str(weights)).run() == 0
    assert "of no use" in capsys.readouterr().out
    assert (loaded.licence, loaded.version) == ("MIT", "3")
