"""``quest objects`` through the program: tables of objects, and pictures of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quest.cli.main import main
from quest.sim.objects import SimObject, load_object
from tests.sim.small_library import BODY, CUPBOARD, PROPERTIES, SIZES, wavefront, write_library
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


def test_import_says_what_came_out_and_list_finds_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = PROPERTIES + "model#2=/lib/table/table.obj\n" + SIZES.format(2) + "model#3=/lib/\\u001b[31m.obj\n"
    models = {"cupboard": CUPBOARD, "table": wavefront(BODY)}
    library = write_library(tmp_path / "a.sh3f", models, text + SIZES.format(3))
    out = tmp_path / "mine"
    assert main(["objects", "import", str(library), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "a.sh3f: 1 object that opens, 1 thing, 1 left out; 0 were there" in said.out
    assert "\\x1b[31m" in said.err
    assert "\x1b" not in said.err
    assert main(["objects", "import", str(library), "--out", str(out)]) == 0
    assert "2 were there" in capsys.readouterr().out
    assert main(["objects", "list", "--objects-root", str(out)]) == 0
    assert "1 handle" in capsys.readouterr().out
    assert main(["objects", "import", str(tmp_path / "none.sh3f"), "--out", str(out)]) == 2
