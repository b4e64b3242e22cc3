"""``quest objects`` through the program: tables of objects, and pictures of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quest.cli.main import main
from quest.sim.objects import SimObject, load_object
from tests.sim.small_objects import CARCASS, DRAWER, write_cabinet, write_object


def test_list_names_objects_entities_and_what_is_broken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cabinet(tmp_path / "cabinet")
    write_object(tmp_path / "drawer", CARCASS, DRAWER, category=None)
    assert main(["objects", "list", "--objects-root", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "StorageFurniture" in out
    assert "1 handle, 1 rim" in out
    assert "drawer: category unknown" in out
    (tmp_path / "drawer" / "mobility.urdf").write_text("<robot>")
    assert main(["objects", "list", "--objects-root", str(tmp_path)]) == 1
    captured = capsys.readouterr()
    assert "cabinet" in captured.out
    assert "not a readable URDF" in captured.err


def test_list_prints_each_object_as_it_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_cabinet(tmp_path / "a-cabinet")
    write_cabinet(tmp_path / "b-cabinet")
    seen: list[str] = []

    def watched(folder: Path) -> SimObject:
        seen.append(capsys.readouterr().out)
        return load_object(folder)

    monkeypatch.setattr("quest.sim.objects.load_object", watched)
    assert main(["objects", "list", "--objects-root", str(tmp_path)]) == 0
    assert "a-cabinet" in seen[1]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "no object is named"),
        (["procedural:chest-0", "--count", "0"], "--count >= 1"),
        (["procedural:chest-0", "--out", "sheet"], "--out sheet: expected a picture, .png"),
        (["procedural:spaceship-0"], "expected CATEGORY-SEED"),
        (["nowhere/arm.urdf"], "expected an object folder"),
        (["arm.urdf.xacro"], "run: xacro"),
    ],
)
def test_bad_requests_are_told(arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["objects", "show", *arguments]) == 2
    assert named in capsys.readouterr().err


def test_a_list_without_a_terminal_has_whole_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = "kitchen_wall_unit_with_handles[left side]"
    write_cabinet(tmp_path / name)
    assert main(["objects", "list", "--objects-root", str(tmp_path)]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if name in line)
    assert line.rstrip().endswith("1 handle, 1 rim")


@pytest.mark.render
def test_show_draws_own_and_procedural_objects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = write_cabinet(tmp_path / "cabinet")
    out = tmp_path / "sheets" / "sheet.png"
    chosen = [str(own), "procedural:laptop-3", "procedural:bucket", "--count", "2", "--first-seed", "7"]
    assert main(["objects", "show", *chosen, "--out", str(out), "--sides", "1", "--size", "96"]) == 0
    assert "4 objects" in capsys.readouterr().out
    sheet = np.asarray(Image.open(out))
    assert sheet.shape[2] == 3
    assert sheet.std() > 20  # not an empty page
