"""Libraries of Sweet Home 3D: what comes out of small ones, and what is said about bad ones."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from quest.data.split import object_split, part_of_object
from quest.errors import ObjectError
from quest.sim.objects import SimObject, find_objects, load_object
from quest.sim.plan import imported_objects
from quest.sim.sweethome import Imported, import_library, joints
from quest.sim.sweethome.folder import CREDITS, THINGS
from quest.sim.sweethome.joints import LinkNote, Note, Pick
from quest.sim.sweethome.wavefront import read_materials, read_wavefront
from tests.sim.small_library import BODY, CHEST, CUPBOARD, LOOKS, PROPERTIES, SIZES, picture, wavefront, write_library


def run(path: Path, out: Path) -> list[Imported]:
    return list(import_library(path, out))


Import = Callable[..., tuple[Imported, Path]]


@pytest.fixture
def imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Import:
    """Imports a library of one model, of which something may be noted; also gives its folder."""

    def run_one(model: str, properties: str = PROPERTIES, *, note: Note | None = None) -> tuple[Imported, Path]:
        if note is not None:
            monkeypatch.setattr("quest.sim.sweethome.folder.notes", lambda: {"lib/cupboard/cupboard.obj": note})
        (made,) = run(write_library(tmp_path / "a.sh3f", {"cupboard": model}, properties), tmp_path / "out")
        return made, made.folder or Path("none")

    return run_one


def opened(thing: SimObject, index: int = 0) -> np.ndarray:
    """Where the entity of a joint gets, from closed to open."""
    articulation, entity = thing.articulation, thing.entities[index]
    moved = articulation.rest
    moved[entity.joint] += articulation.joints[entity.joint].opening()
    places = [articulation.poses(q)[entity.body] @ [*entity.point, 1] for q in (articulation.rest, moved)]
    return (places[1] - places[0])[:3]


def test_a_tagged_door_opens_to_the_front(tmp_path: Path, imported: Import) -> None:
    made, folder = imported(CUPBOARD)
    assert (made.opens, made.warnings, folder) == (True, (), tmp_path / "out" / "cupboard")
    cupboard = load_object(folder)
    assert (cupboard.source, cupboard.warnings) == ("own", ())
    np.testing.assert_allclose(cupboard.articulation.extent_m, (0.4, 0.6, 0.8), atol=1e-6)
    assert [e.name for e in cupboard.entities] == ["part_1/handle", "part_1/hinge"]
    joint = cupboard.articulation.joints[0].joint
    assert (joint.kind, joint.upper) == ("revolute", pytest.approx(np.pi / 2, abs=1e-3))
    step = opened(cupboard)
    assert step[0] > 0.4  # the free edge comes out to the front
    assert step[1] < -0.4  # and goes to the left, where the hinge is
    assert "map_Kd picture0.png" in (folder / "meshes" / "materials.mtl").read_text()
    assert (folder / "meshes" / "picture0.png").read_bytes() == picture()
    credits = (tmp_path / "out" / CREDITS).read_text(encoding="utf-8").splitlines()
    assert "| cupboard | A \\| cupboard | Müller | CC-BY | a.sh3f |" in credits  # on one line


def test_a_noted_drawer_slides_and_has_its_knob_and_a_tray(imported: Import) -> None:
    drawer = LinkNote("drawer", "slide", (Pick(box=(0.9, 0, 0, 1, 1, 0.6)),), by=0.25, tray=True)
    note = Note(category="StorageFurniture", links=(drawer,), knobs=(Pick(group="knobs"),))
    chest = load_object(imported(CHEST, note=note)[1])
    assert chest.category == "StorageFurniture"
    assert [e.name for e in chest.entities] == ["drawer/knob"]
    np.testing.assert_allclose(opened(chest), (0.25, 0, 0), atol=1e-6)
    assert sum(part.shape == "box" for part in chest.articulation.parts) == 4


@pytest.mark.parametrize(
    ("opens", "towards"),
    [("left", (0.5, -0.5, 0)), ("right", (0.5, 0.5, 0)), ("bottom", (0.3, 0, -0.3)), ("top", (0.3, 0, 0.3))],
)
def test_doors_turn_on_the_edge_that_is_noted(imported: Import, opens, towards: tuple) -> None:
    door = load_object(imported(CHEST, note=Note(links=(LinkNote("door", opens, (Pick(group="fronts"),)),)))[1])
    assert door.entities[0].label == "rim"
    assert [np.sign(np.round(s, 1)) for s in opened(door)] == [np.sign(t) for t in towards]


def test_a_lid_that_is_modelled_open_is_shut(imported: Import) -> None:
    model = wavefront(("base", (0, 0, 0), (6, 0.2, 4)), ("screen", (0, 0.2, 0), (6, 4.2, 0.2)))
    note = Note("Laptop", links=(LinkNote("lid", "lid", (Pick(group="screen"),), 100, 90, axis=(0, 0.5, 0.09)),))
    laptop = load_object(imported(model, PROPERTIES.replace("height#1=80", "height#1=42"), note=note)[1])
    assert laptop.articulation.extent_m[2] < 0.05
    assert opened(laptop)[2] > 0.35


def test_things_do_not_move_and_stand_below_things(tmp_path: Path, imported: Import) -> None:
    made, folder = imported(wavefront(BODY), PROPERTIES + "modelRotation#1=1 0 0 0 0 1 0 -1 0\n")
    assert (made.opens, folder) == (False, tmp_path / "out" / THINGS / "cupboard")
    assert (folder / "cupboard.urdf").read_text().count("<link") == 1
    read = read_wavefront((folder / "meshes" / "base-body.obj").read_text())
    np.testing.assert_allclose(read.vertices.min(axis=0), (-0.2, -0.3, 0), atol=1e-6)
    np.testing.assert_allclose(read.vertices.max(axis=0), (0.2, 0.3, 0.8), atol=1e-6)
    with pytest.raises(ObjectError):
        find_objects(tmp_path / "out")


def test_finished_folders_are_kept_and_a_changed_library_is_told(tmp_path: Path, imported: Import) -> None:
    _, folder = imported(CUPBOARD)
    (folder / "mine.txt").write_text("kept")
    (tmp_path / "out" / ".partial" / "left-over").mkdir(parents=True)
    again, _ = imported(CUPBOARD)
    assert (again.kept, again.warnings) == (True, ())
    assert (folder / "mine.txt").is_file()
    assert not (tmp_path / "out" / ".partial").exists()
    changed, _ = imported(CHEST)
    assert changed.kept
    assert "the library has changed" in changed.warnings[0]


def test_a_name_that_another_model_has_gets_its_library_in_front(tmp_path: Path, imported: Import) -> None:
    imported(CUPBOARD)
    files = {"Their Lib/cupboard/cupboard.obj": CUPBOARD.encode()}
    other = write_library(tmp_path / "b.sh3f", {}, PROPERTIES.replace("/lib/", "/Their Lib/"), **files)
    (made,) = run(other, tmp_path / "out")
    assert made.folder == tmp_path / "out" / "their-lib-cupboard"
    assert "it.mtl" in made.warnings[0]


@pytest.mark.parametrize("name", ["../../evil.obj", "/../evil.obj", "..\\evil.obj", "lib/../../evil.obj", "evil.exe"])
def test_no_path_leads_out_of_the_library(tmp_path: Path, name: str) -> None:
    properties = PROPERTIES.replace("/lib/cupboard/cupboard.obj", name.replace("\\", "\\\\"))
    (made,) = run(write_library(tmp_path / "a.sh3f", {}, properties, **{name: CUPBOARD.encode()}), tmp_path / "out")
    assert made.folder is None
    assert "expected an .obj file" in made.warnings[0]
    assert not list(tmp_path.rglob("*.urdf"))


def test_no_picture_comes_from_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(picture())
    text = LOOKS.replace("bark oak.png", str(tmp_path / "secret.png"))
    files = {"lib/cupboard/cupboard.obj": CUPBOARD.encode(), "lib/cupboard/it.mtl": text.encode()}
    (made,) = run(write_library(tmp_path / "a.sh3f", {}, PROPERTIES, **files), tmp_path / "out")
    assert "secret.png' is missing" in made.warnings[0]
    assert not list((tmp_path / "out").rglob("*.png"))


def test_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_library(tmp_path / "a.sh3f", {"cupboard": CUPBOARD, "other": "# " + "x" * 100_000})
    monkeypatch.setattr("quest.sim.sweethome.library._MOST_BYTES", 50_000)
    assert run(path, tmp_path / "out")[0].folder is not None  # what is not read does not matter
    monkeypatch.setattr("quest.sim.sweethome.library._MOST_BYTES", 500)
    (made,) = run(path, tmp_path / "out2")
    assert "at most 500" in made.warnings[0]
    for name, most in (("_MOST_BYTES_IN_ALL", 60_000), ("_MOST_MEMBERS", 3)):
        with monkeypatch.context() as patch:
            patch.setattr(f"quest.sim.sweethome.library.{name}", most)
            with pytest.raises(ObjectError, match="expected at most"):
                run(path, tmp_path / "out3")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("height#1=80", "height#1=tall", "cannot be read"),
        ("height#1=80", "height#1=nan", "expected numbers > 0"),
        ("height#1=80", "", "height"),
        ("height#1=80", "height#1=80\nmodelRotation#1=1 2 3", "nine numbers"),
        ("height#1=80", "height#1=80\nmodelRotation#1=9 0 0 0 1 0 0 0 1", "rotation is none"),
        ("cupboard.obj", "nothing.obj", "no such file"),
    ],
)
def test_a_broken_entry_is_left_out_and_the_rest_goes_on(tmp_path: Path, old: str, new: str, said: str) -> None:
    properties = PROPERTIES.replace(old, new) + "model#2=/lib/good/good.obj\n" + SIZES.format(2)
    made = run(write_library(tmp_path / "a.sh3f", {"cupboard": CUPBOARD, "good": CUPBOARD}, properties), tmp_path / "o")
    assert [each.folder is None for each in made] == [True, False]
    assert said in made[0].warnings[0]
    assert "a.sh3f" in made[0].warnings[0]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("v 0 0 0\n", "v nan 0 0\n"),
        ("v 0 0 0\n", "v 0 0\n"),
        ("v 0 0 0\n", "v a b c\n"),
        ("f 1/1 2/1", "f 99/1 2/1"),
        ("f 1/1 2/1", "f x 2/1"),
        ("\nf ", "\n# "),
        ("sweethome3d_hinge_1\n", "sweethome3d_hinge_7\n"),
    ],
)
def test_a_broken_model_is_left_out_by_name(tmp_path: Path, imported: Import, old: str, new: str) -> None:
    assert old in CUPBOARD
    made, _ = imported(CUPBOARD.replace(old, new))
    assert made.folder is None
    assert "lib/cupboard/cupboard.obj" in made.warnings[0]
    assert not [p for p in (tmp_path / "out").iterdir() if p.name != CREDITS]


def test_what_is_no_library_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.sh3f"
    path.write_bytes(b"PK\x03\x04 no")
    with pytest.raises(ObjectError, match=r"a\.sh3f"):
        run(path, tmp_path / "out")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("else.txt", "")
    with pytest.raises(ObjectError, match="expected a library of Sweet Home 3D"):
        run(path, tmp_path / "out")
    with pytest.raises(ObjectError, match="no such file"):
        run(tmp_path / "none.sh3f", tmp_path / "out")


def test_pieces_of_a_group_are_what_hangs_together() -> None:
    shape = read_wavefront(
        wavefront(("a", (0, 0, 0), (1, 1, 1)), ("a", (5, 0, 0), (6, 1, 1)), ("b", (0, 0, 0), (1, 1, 1)))
    )
    piece, bounds = shape.pieces
    assert len(bounds) == 3
    assert np.bincount(piece).tolist() == [6, 6, 6]
    upper = Pick(group="a", box=(0.5, 0, 0, 1, 1, 1)).faces(shape)
    assert upper.sum() == 6
    again = read_wavefront(shape.text(upper, "it.mtl", ["", "wood"]))
    np.testing.assert_array_equal(np.unique(again.vertices[:, 0]), (5, 6))
    assert again.materials == ("", "wood")


def test_indices_may_count_from_the_end_and_materials_are_words() -> None:
    shape = read_wavefront("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf -3//-1 -2//1 -1//1\nl 1 2\n")
    assert shape.corners.tolist() == [[0, -1, 0], [1, -1, 0], [2, -1, 0]]
    assert read_materials("newmtl a b\nKd 1 0 0 \n")["a b"] == {"Kd": "1 0 0"}


def test_notes_say_how_the_libraries_of_debian_open() -> None:
    noted = joints.notes()
    assert sum(bool(note.links) for note in noted.values()) >= 40
    for path, note in noted.items():
        assert path.endswith(".obj"), path
        assert bool(note.category) != bool(note.thing or note.skip), path
        assert len({link.name for link in note.links}) == len(note.links), path
        for pick in (*note.handles, *note.knobs, *(pick for link in note.links for pick in link.pick)):
            assert all(a < b for a, b in zip(pick.box[:3], pick.box[3:], strict=True)), path
            assert pick != Pick(), path
        assert all(link.pick for link in note.links), path


def test_damaged_notes_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "notes.json").write_text(json.dumps({"a.obj": {"colour": 1}}))
    monkeypatch.setattr(joints, "NOTES", tmp_path / "notes.json")
    with pytest.raises(ObjectError, match="unknown colour"):
        joints.notes.__wrapped__()


def test_the_split_knows_imported_objects_by_name_and_model(imported: Import) -> None:
    _, folder = imported(CUPBOARD)
    credit = folder / "credit.json"
    part = object_split().sweethome3d["validation"]
    named = json.loads(credit.read_text())
    assert named["model"] != part["cupboard"]  # that of another library
    assert load_object(folder).source == "own"
    credit.write_text(json.dumps(named | {"model": part["cupboard"]}))
    cupboard = load_object(folder)
    assert cupboard.source == "sweethome3d"
    assert part_of_object(cupboard.source, cupboard.object_id) == "validation"
    np.testing.assert_allclose(cupboard.articulation.extent_m, (0.4, 0.6, 0.8), atol=1e-6)  # metres, as its file says


def test_a_part_of_the_split_wants_all_its_imported_objects(tmp_path: Path) -> None:
    named = object_split().sweethome3d["test"]
    for name in named:
        (tmp_path / name).mkdir()
        (tmp_path / name / "credit.json").write_text("{}")
    assert imported_objects(tmp_path, "test") == [("own", str(tmp_path / name)) for name in named]
    (tmp_path / "fridge" / "credit.json").unlink()
    with pytest.raises(ObjectError, match="no fridge"):
        imported_objects(tmp_path, "test")
