"""``quest monitor`` with a tiny network on synthetic takes, with and without a calibration."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from quest.cli.main import main
from quest.data.store import TakeStore
from quest.model.weights import save_network
from quest.monitor import calibration, write_calibrations
from quest.track import Stream, TrackerConfig
from quest.types import Camera
from tests.synthetic import make_take
from tests.tiny import make_finder
from tests.track.clips import make_calibration

FRAMES = 7
POINTS = ["--point", "0,20,30,left", "--point", "2,40,30"]


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> str:
    store = TakeStore(tmp_path_factory.mktemp("monitor") / "takes")
    store.write(make_take(frames=FRAMES, views=1, entities=2, seed=3))
    return str(store.root / "panels-3.zarr")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Untrained weights whose tracker takes every peak, or none; with a calibration that alarms or never does."""
    folder = tmp_path_factory.mktemp("weights")
    network, alarming = make_finder(), make_calibration(alarming=True)
    for name, threshold in (("eager", 0.0), ("blind", 1.0)):
        settings = TrackerConfig(threshold=threshold, prompt_threshold=threshold, size_px=64, follow_px=64).to_json()
        save_network(folder / f"{name}.safetensors", network, settings=settings, about="a test")
    found = {name: ["--weights", str(folder / f"{name}.safetensors")] for name in ("eager", "blind")}
    for name, made in (
        ("calm", make_calibration(alarming=False)),
        ("alarming", alarming),
        ("few", replace(alarming, maxima=np.arange(20.0))),
    ):
        write_calibrations(folder / f"{name}.json", {"depth": made})
        found[name] = [*found["eager"], "--monitor", str(folder / f"{name}.json")]
    return found


@pytest.fixture(autouse=True)
def nothing_ships(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """There is no calibration but those of these tests."""
    monkeypatch.setattr(calibration, "resources", SimpleNamespace(files=lambda package: tmp_path))


def objects(text: str) -> list[dict[str, Any]]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


def test_without_a_calibration(take: str, weights: dict[str, list[str]], tmp_path: Path, capsys):
    path = tmp_path / "new" / "frames.jsonl"
    assert main(["monitor", take, *weights["eager"], *POINTS, "--jsonl", str(path)]) == 0
    out = capsys.readouterr().out
    assert "no calibration of the monitor" in out
    assert "now following left" in out
    assert f"{FRAMES} of {FRAMES} frames" in out
    lines = objects(path.read_text())
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert [len(line["queries"]) for line in lines] == [1, 1, 2, 2, 2, 2, 2]
    left = lines[-1]["queries"][0]
    assert (left["query"], left["name"], left["label"]) == (0, "left", None)
    assert left["lost_p"] is None
    assert left["alarm"] is None


def test_no_alarm(take: str, weights: dict[str, list[str]], capsys):
    """Where the calibration cannot give any, nothing may look as if it were watched."""
    assert main(["monitor", take, *weights["few"], *POINTS]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "no alarm at all at alpha 0.05: calibrated on 20 loss-free streams of" in out
    assert main(["monitor", take, *weights["calm"], *POINTS]) == 0
    out = capsys.readouterr().out
    assert "calibration" not in out
    assert "ALARM" not in out
    assert "0 raised, 0 cleared, 0 left open" in out


def test_an_open_alarm(take: str, weights: dict[str, list[str]], capsys):
    assert main(["monitor", take, *weights["alarming"], *POINTS, "--jsonl", "-"]) == 3
    captured = capsys.readouterr()
    last = objects(captured.out)[-1]
    assert len(captured.out.splitlines()) == FRAMES, "nothing else goes to standard output"
    alarm = last["queries"][0]["alarm"]
    assert alarm["name"] == "left"
    assert alarm["frame"] < FRAMES
    assert last["queries"][0]["state"] == "lost"
    assert last["queries"][0]["lost_p"] == pytest.approx(0.953, abs=1e-3)
    assert "left  ALARM: " in captured.err
    assert "2 left open" in captured.err


def test_alpha(take: str, weights: dict[str, list[str]], capsys):
    """A smaller one needs more evidence; blocks have 60 frames: 180 are in three of them, which share alpha alike."""
    found = []
    for words in ([], ["--alpha", "1e-9"], ["--alpha-frames", "180"]):
        assert main(["monitor", take, *weights["alarming"], *POINTS, *words, "--jsonl", "-"]) == 3
        found.append(objects(capsys.readouterr().out)[-1]["queries"][0]["alarm"])
    assert found[0]["frame"] < found[1]["frame"]
    assert [found[0]["alpha"], found[2]["alpha"]] == pytest.approx([0.8 * 0.05, 0.05 / 3])


@pytest.mark.parametrize("how", [[], ["--online"]], ids=["first frame", "online"])
def test_discovery(take: str, weights: dict[str, list[str]], how: list[str], capsys):
    assert main(["monitor", take, *weights["calm"], *how]) == 0
    assert "now following" in capsys.readouterr().out


def test_own_pace(take: str, weights: dict[str, list[str]], monkeypatch, capsys):
    waited: list[float] = []
    monkeypatch.setattr("quest.cli.monitor.time.sleep", waited.append)
    assert main(["monitor", take, *weights["calm"], *POINTS, "--realtime"]) == 0
    assert len(waited) == FRAMES
    assert all(wait >= 0 for wait in waited)


@pytest.mark.parametrize("asked", [[], ["--label", "knob"]])
def test_nothing_is_found(take: str, weights: dict[str, list[str]], asked: list[str], capsys):
    assert main(["monitor", take, *weights["blind"], *asked]) == 2
    error = capsys.readouterr().err
    assert "--point FRAME,X,Y" in error
    assert "--label" in error


def test_one_of_two_is_found(take: str, weights: dict[str, list[str]], capsys):
    asked = ["--label", "knob", "--point", "0,20,30"]
    assert main(["monitor", take, *weights["blind"], *asked]) == 0
    assert "knob: found no entity" in capsys.readouterr().out


def test_interrupted(take: str, weights: dict[str, list[str]], monkeypatch, capsys):
    step = Stream.step

    def interrupt(stream: Stream, *arguments: Any) -> Any:
        if stream.frame == 3:
            raise KeyboardInterrupt
        return step(stream, *arguments)

    monkeypatch.setattr(Stream, "step", interrupt)
    assert main(["monitor", take, *weights["eager"], *POINTS]) == 130
    captured = capsys.readouterr()
    assert f"3 of {FRAMES} frames" in captured.out
    assert "interrupted" in captured.err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--alpha", "0"], "--alpha"),
        (["--alpha-frames", "0"], "--alpha-frames"),
        (["--monitor", "{folder}/none.json"], "quest calibrate"),
        (["--point", "7,3,3"], "0 to 6"),
        (["--point", "0,here"], "FRAME,X,Y"),
        (["--jsonl", "{folder}"], "cannot be written"),
        (["--jsonl", "/dev/full"], "frame 0 cannot be written"),
    ],
)
def test_bad_arguments(
    take: str, weights: dict[str, list[str]], tmp_path: Path, capsys, arguments: list[str], named: str
):
    if "/dev/full" in arguments and not Path("/dev/full").exists():
        pytest.skip("this system has no full disk to write to")
    arguments = [argument.format(folder=tmp_path) for argument in arguments]
    assert main(["monitor", take, *weights["eager"], *POINTS, *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert named in error


def test_sample_is_a_source(weights: dict[str, list[str]], monkeypatch, capsys):
    """The word, not a folder of that name; the clip itself is not stepped through."""
    seen: list[Camera] = []

    def stop(tracker: Any, camera: Camera, queries: Any, **settings: Any) -> Stream:
        seen.append(camera)
        raise KeyboardInterrupt

    monkeypatch.setattr("quest.track.Tracker.stream", stop)
    assert main(["monitor", "sample", *weights["eager"]]) == 130
    assert seen
