"""``quest find``: what it prints and writes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import quest
from quest.cli.find import coco, listed
from quest.cli.main import main
from quest.model.finder import OPENINGS
from quest.model.found import LABELS_FOUND, Found, Panels
from quest.track import Tracker, TrackerConfig
from tests.tiny import make_finder


def made_up() -> Found:
    """A handle on a cabinet door that turns about its left edge, a rim to lift by, and something unlikely."""
    label_p = np.zeros((3, len(LABELS_FOUND)))
    label_p[[0, 1, 2], [0, 2, 1]] = 1
    opening = np.eye(len(OPENINGS))[[1]] * 0.9 + 0.02
    return Found(
        uv_px=np.array([[50.0, 30], [20, 70], [5, 5]]),
        logit=np.array([3.0, 1, -2]),
        label_p=label_p,
        lift_p=np.array([0.1, 0.9, 0.0]),
        box_px=np.array([[45.0, 20, 55, 40], [np.nan] * 4, [1, 1, 9, 9]]),
        panel=np.array([0, -1, -1]),
        panels=Panels(np.array([[10.0, 10, 60, 60]]), np.array([0]), np.array([2.0]), opening),
    )


def test_things_are_listed_with_what_they_are_on() -> None:
    handle, rim = listed(made_up(), least=0.5)
    assert (handle["label"], handle["p"], handle["box_px"]) == ("handle", 0.953, [45, 20, 55, 40])
    assert handle["on"]["kind"] == "cabinet"
    assert max(handle["on"]["opening"], key=handle["on"]["opening"].get) == "left"
    assert (rim["label"], rim["intent"], "box_px" in rim, "on" in rim) == ("rim", "lift", False, False)


def test_coco_has_boxes_points_and_scores() -> None:
    raw = coco(listed(made_up(), least=0.5), "kitchen.jpg", (80, 100, 3))
    assert raw["images"] == [{"id": 1, "file_name": "kitchen.jpg", "width": 100, "height": 80}]
    assert [mark["bbox"] for mark in raw["annotations"]] == [[45, 20, 10, 20], [20, 70, 0, 0]]
    names = {category["id"]: category["name"] for category in raw["categories"]}
    assert [names[mark["category_id"]] for mark in raw["annotations"]] == ["handle", "rim"]


@pytest.fixture
def picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A picture in which that is found."""
    tracker = Tracker(make_finder(), TrackerConfig(size_px=64, follow_px=64), device=torch.device("cpu"))
    monkeypatch.setattr(Tracker, "find", lambda *_: made_up())
    monkeypatch.setattr(quest, "load", lambda *_, **__: tracker, raising=False)
    path = tmp_path / "kitchen.png"
    Image.fromarray(np.zeros((80, 100, 3), np.uint8)).save(path)
    return path


def test_a_picture_is_enough(picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["find", str(picture), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "handle  0.95  (50, 30)  on a cabinet door that turns about its left edge (92%)" in printed
    assert "2 found" in printed
    with Image.open(tmp_path / "out" / "found.png") as drawn:
        assert drawn.size == (100, 80)
        assert np.asarray(drawn).any()
    assert len(json.loads((tmp_path / "out" / "found.json").read_text())["annotations"]) == 2
    assert main(["find", str(picture), "--json", "--threshold", "0.99"]) == 0
    assert json.loads(capsys.readouterr().out) == []
    assert main(["find", str(tmp_path / "none.png")]) == 2
    assert main(["find", str(picture), "--threshold", "2"]) == 2


def test_a_text_chooses(picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def find(*arguments: str) -> tuple[int, str, str]:
        code, (out, err) = main(["find", str(picture), *arguments]), capsys.readouterr()
        return code, out, err

    code, printed, _ = find("--text", "lever of the left cupboard door", "--out", str(tmp_path / "out"))
    assert code == 0
    assert printed.startswith("understood: handle, on the leftmost cabinet door\nhandle  0.95  (50, 30)")
    assert "1 found\n" in printed
    assert len(json.loads((tmp_path / "out" / "found.json").read_text())["annotations"]) == 1
    with Image.open(tmp_path / "out" / "found.png") as drawn:
        assert not np.asarray(drawn)[65:, :40].any()  # the rim is not drawn
    assert (
        "understood: second handle from the left\nfound 1 handle from the left, no second"
        in find("--text", "second handle from the left")[1]
    )
    code, printed, said = find("--text", "rims to lift", "--json")
    assert [thing["label"] for thing in json.loads(printed)] == ["rim"]
    assert said == "understood: all rims, to lift\n"
    assert find("--text", "knob")[1].endswith("no knob was found\n")
    assert "1 found" in find("--text", "knob", "--threshold", "0.1")[1]
    code, _, said = find("--text", "the yellow handle")
    assert code == 2
    assert "does not understand 'yellow'" in said
