"""``quest data``: every command through the program, on a small store."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from quest.cli import main as program
from quest.cli.takes import write_picture
from quest.data.store import TakeStore
from quest.data.verify import Check
from quest.errors import ConfigError
from quest.extras import is_installed
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two takes, the second of fewer entities."""
    folder = tmp_path_factory.mktemp("store") / "takes"
    store, take = TakeStore(folder), make_take(frames=12, views=2, size=(64, 48), name="panels")
    store.write(replace(take, info=replace(take.info, category="[i]Panels")))
    store.write(make_take(frames=10, views=2, entities=1, size=(64, 48), seed=1, name="single"))
    return folder


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A whole take, a torn one, and one whose pixels are off."""
    store, take = TakeStore(tmp_path / "broken"), make_take(frames=9, views=1)
    for name in ("whole", "torn"):
        store.write(replace(take, info=replace(take.info, name=name)))
    (store.path("torn") / "zarr.json").unlink()
    view = replace(take.views[0], uv_px=take.views[0].uv_px + np.float32(3))
    store.write(replace(take, views=(view,), info=replace(take.info, name="wrong")))
    return tmp_path / "broken"


def quest(*arguments: object) -> int:
    return program.main(["data", *map(str, arguments)])


def test_ls(whole: Path, broken: Path, capsys: pytest.CaptureFixture[str]):
    assert quest("ls", whole) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in ("panels", "single", "[i]Panels", "standard", "2 takes, 44 frames"))
    assert quest("ls", whole / "single.zarr") == 0
    assert "panels" not in capsys.readouterr().out.replace("Panels", "")
    assert quest("ls", broken) == 1
    captured = capsys.readouterr()
    assert "torn" in captured.err
    assert "torn" not in captured.out


def test_show(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """A take, a store, and the folder that one is in."""
    out, every = tmp_path / "pictures" / "sheet.png", tmp_path / "every.png"
    assert quest("show", whole / "panels.zarr", "--out", out, "--columns", 4) == 0
    assert quest("show", whole / "panels.zarr", "--out", every, "--every", 5) == 0
    assert Image.open(out).width > 900
    assert Image.open(every).height == Image.open(out).height
    assert str(out) in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    assert quest("show", whole) == 0
    two = Image.open(tmp_path / "takes.png")
    monkeypatch.chdir(whole)
    try:
        assert quest("show", ".", "--rows", 1) == 0
        assert Image.open(whole / "takes.png").height < two.height
    finally:
        (whole / "takes.png").unlink(missing_ok=True)


def test_a_picture_is_written_whole_or_not_at_all(tmp_path: Path):
    wide = np.zeros((1, 20_000, 3), np.uint8)
    with pytest.raises(ConfigError, match=r"20000 x 1 px are too many for \.webp"):
        write_picture(wide, tmp_path / "sheet.webp", "a line")
    assert not list(tmp_path.iterdir())
    write_picture(wide, tmp_path / "sheet.png", "a line")
    assert list(tmp_path.iterdir()) == [tmp_path / "sheet.png"]


@pytest.mark.skipif(not is_installed("rerun"), reason="the viz extra is not installed")
def test_show_in_rerun(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rrd = tmp_path / "take.rrd"
    assert quest("show", whole / "single.zarr", "--rrd", rrd) == 0
    assert rrd.stat().st_size > 10_000
    assert sorted(file.name for file in tmp_path.iterdir()) == ["take.rrd"]
    assert str(rrd) in capsys.readouterr().out


def test_stats(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "empty").mkdir()
    assert quest("stats", tmp_path / "empty", "--json", tmp_path / "stats.json") == 0
    assert json.loads((tmp_path / "stats.json").read_text())["visible_share"] is None
    path = tmp_path / "numbers" / "stats.json"
    assert quest("stats", whole, "--json", path) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in ("2 of 2 objects", "[i]Panels (1)", "handle (2)", "visible", "GB"))
    found = json.loads(path.read_text())
    assert (found["takes"], found["frames"], found["labels"]["rim"]) == (2, 44, 1)


def test_verify(whole: Path, broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert quest("verify", whole) == 0
    assert "2 of 2 takes pass, 44 frames" in capsys.readouterr().out
    path = tmp_path / "verify.json"
    assert quest("verify", broken, "--json", path) == 1
    captured = capsys.readouterr()
    assert "1 of 3 takes pass" in captured.out
    message = next(line for line in captured.err.splitlines() if "wrong" in line)
    assert "take 'wrong': reprojection 4.243 px, at most 0.5 px (view 0, frame" in message
    found = json.loads(path.read_text())
    assert (found["passed"], list(found["failed"])) == (False, ["torn", "wrong"])
    assert found["takes"] == {"torn": False, "whole": True, "wrong": False}
    assert found["suites"] == {"standard": 2}
    assert found["worst"]["rigid in link"]["passed"]
    assert found["worst"]["reprojection"]["take"] == "wrong"
    assert found["worst"]["reprojection"]["worst"] == pytest.approx(4.243, abs=1e-3)
    assert quest("verify", broken / "whole.zarr") == 0
    assert quest("verify", broken / "nowhere.zarr") == 1


def test_verify_writes_finite_json(broken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Endless(Check):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            object.__setattr__(self, "worst", math.inf)

    monkeypatch.setattr("quest.data.verify.Check", Endless)
    path = tmp_path / "verify.json"
    assert quest("verify", broken / "whole.zarr", "--json", path) == 0
    found = json.loads(path.read_text(), parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert found["worst"]["reprojection"]["worst"] is None


def test_export(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert quest("export", whole, "--out", tmp_path) == 0
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == ["panels-v0.npz", "panels-v1.npz", "single-v0.npz", "single-v1.npz"]
    assert str(tmp_path / "single-v0.npz") in capsys.readouterr().out
    assert quest("export", whole / "single.zarr", "--out", tmp_path / "one", "--format", "tapvid3d") == 0
    assert len(list((tmp_path / "one").iterdir())) == 2


def test_export_names_what_is_torn(broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert quest("export", broken, "--out", tmp_path / "out") == 1
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["whole-v0.npz", "wrong-v0.npz"]
    assert "omitted: take 'torn'" in capsys.readouterr().err
    rotten = next(path for path in (broken / "whole.zarr" / "view_0" / "rgb" / "c").rglob("*") if path.is_file())
    rotten.write_bytes(rotten.read_bytes()[:40] + b"x" + rotten.read_bytes()[41:])
    assert quest("export", broken, "--out", tmp_path / "again") == 1
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == ["wrong-v0.npz"]


def test_export_to_lerobot(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert quest("export", whole, "--out", tmp_path / "dataset", "--format", "lerobot") == 0
    assert "2 episodes" in capsys.readouterr().out
    assert json.loads((tmp_path / "dataset" / "meta" / "info.json").read_text())["total_episodes"] == 2


@pytest.mark.skipif(not is_installed("mcap_ros2"), reason="the ros extra is not installed")
def test_export_to_mcap(whole: Path, tmp_path: Path):
    assert quest("export", whole / "single.zarr", "--out", tmp_path / "bags", "--format", "mcap") == 0
    assert sorted(path.name for path in (tmp_path / "bags").iterdir()) == ["single-v0.mcap", "single-v1.mcap"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ls", "nowhere"], "no such folder"),
        (["ls", "takes/nowhere.zarr"], "no folder"),
        (["show", "nowhere"], "no such folder"),
        (["show", "takes/nowhere.zarr"], "no folder"),
        (["show", "takes", "--rrd", "x.rrd"], "is a store; name one, such as takes/panels.zarr"),
        (["show", "takes/single.zarr", "--every", "0"], "at least 1"),
        (["show", "takes/single.zarr", "--out", "sheet.txt"], "expected a picture, .png"),
        (["show", "takes", "--out", "sheets"], "expected a picture, .png"),
        (["show", "empty"], "no takes"),
        (["stats", "takes/single.zarr"], "expected a store, and this is one take, single; name its store, "),
        (["verify", "empty"], "no takes"),
        (["export", "empty", "--out", "x"], "no takes"),
    ],
)
def test_mistakes(
    arguments: list[str],
    said: str,
    whole: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(whole.parent)
    (whole.parent / "empty").mkdir(exist_ok=True)
    assert quest(*arguments) == 2
    assert said in capsys.readouterr().err
