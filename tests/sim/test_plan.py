"""Which takes a run makes, where objects come from, and the command that says so."""

import shlex
from pathlib import Path

import pytest

from quest.cli import main as program
from quest.cli.generate import Generate
from quest.errors import ConfigError, ObjectError
from quest.sim.cameras import CameraStyle
from quest.sim.plan import ObjectShelf, parse_object, plan_takes, procedural_objects
from quest.sim.procedural import CATEGORIES
from quest.sim.settings import TakeSettings
from quest.sim.suites import find_suites
from tests.sim.small_objects import write_cabinet


def test_all_objects_come_once_before_any_comes_again() -> None:
    takes = plan_takes([("partnet", "1"), ("partnet", "2")], levels=(1, 3), takes_per_object=2, first_seed=5)
    assert [t.name for t in takes] == [
        "1-L1-s000005", "2-L1-s000005", "1-L3-s000005", "2-L3-s000005",
        "1-L1-s000006", "2-L1-s000006", "1-L3-s000006", "2-L3-s000006",
    ]  # fmt: skip


def test_takes_of_a_suite_have_names_of_their_own() -> None:
    occlusion, lockers = find_suites("occlusion"), find_suites("lockers")
    alone = occlusion[0].hidden_for(60)
    wanted = ((), [alone], [alone.hidden_for(look_alike=True)], occlusion, lockers, find_suites("shift", ("blur",)))
    planned = [
        take.name
        for suites in wanted
        for take in plan_takes([("partnet", "1")], levels=(1,), takes_per_object=1, suites=suites)
    ]
    assert planned == [
        "1-L1-s000000", "1-L1-occlusion60-s000000", "1-L1-occlusion60alike-s000000", "1-L1-occlusion-s000000",
        "1-L1-lockers30-s000000", "1-L1-shift-blur-s000000",
    ]  # fmt: skip


def test_names_of_objects() -> None:
    assert parse_object("partnet:44817, 23724") == [("partnet", "44817"), ("partnet", "23724")]
    assert parse_object("44817") == [("partnet", "44817")]
    assert parse_object("procedural:chest-12") == [("procedural", "chest-12")]
    for text in ("", "partnet:", "shapenet:1"):
        with pytest.raises(ObjectError, match="partnet:44817"):
            parse_object(text)


def test_a_folder_that_is_here_is_an_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_cabinet(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    assert parse_object("mine") == [("own", "mine")]
    assert parse_object("other") == [("partnet", "other")]


def test_procedural_objects_are_named_by_category_and_seed() -> None:
    named = procedural_objects(20, 100)
    assert [object_id.rpartition("-")[2] for _, object_id in named] == [str(seed) for seed in range(100, 120)]
    assert {object_id.rpartition("-")[0] for _, object_id in named} <= set(CATEGORIES)
    assert named == procedural_objects(20, 100)
    assert procedural_objects(2, 5, "chest") == [("procedural", "chest-5"), ("procedural", "chest-6")]


def test_shelf_keeps_objects_and_failures(tmp_path: Path) -> None:
    write_cabinet(tmp_path / "cabinet")
    write_cabinet(tmp_path / "broken")
    (tmp_path / "broken" / "mobility.urdf").write_text("<robot")
    shelf = ObjectShelf(tmp_path)
    assert shelf.load("partnet", "cabinet") is shelf.load("partnet", "cabinet")
    with pytest.raises(ObjectError, match="not a readable URDF") as first:
        shelf.load("partnet", "broken")
    with pytest.raises(ObjectError) as again:
        shelf.load("partnet", "broken")
    assert first.value is again.value
    with pytest.raises(ObjectError, match="found none of that name"):
        shelf.load("partnet", "99999999")
    for object_id in ("spaceship-1", "chest", "chest-x"):
        with pytest.raises(ObjectError, match="CATEGORY-SEED"):
            shelf.load("procedural", object_id)


@pytest.mark.parametrize(
    "words",
    [
        "--out a --objects partnet:1,2 procedural:chest-12 --level 1 2 --every 5",
        "--out 'with space' --split train --no-partnet --procedural 3 --seeds 4..9 --no-randomize-materials",
        "--out a --split validation --objects-root there --takes-per-object 2 --seed 7 --views 1 --size 64",
        "--out a --suite occlusion --hidden 60 --look-alike --objects partnet:1",
        "--out a --suite lockers --procedural 4 --level 2",
        "--out a --suite noise --variant 5 stereo --procedural 4",
        "--out a --procedural 4 --size 640 480",
        "--out a --suite kitchen --camera walk --procedural 2",
        "--out a --room --objects procedural:chest-1",
        "--out s3://bucket/takes --procedural 2 --camera orbit --motion robot --overlap 0.5 --sensor stereo --physics",
        "--out a --procedural 2 --camera orbit --azimuth -40.0 40.0 --elevation 30.0 80.0",
    ],
)
def test_recorded_command_makes_the_same_run(words: str) -> None:
    command = program.parse(["generate", *shlex.split(words)])
    assert isinstance(command, Generate)
    name, *again = shlex.split(command.command_line())
    assert (name, again[0]) == ("quest", "generate")
    assert program.parse(again) == command
    assert sorted(shlex.split(words)) == sorted(again[1:])


def test_cameras_of_a_suite_move_where_the_arguments_say() -> None:
    command = Generate(out="a", procedural=1, suite="moving", variant=("pan",), elevation=(30.0, 80.0))
    (suite,) = command._suites()
    assert suite.settings.cameras == CameraStyle(motion="pan", elevation_deg=(30.0, 80.0))


def test_a_kitchen_keeps_its_room() -> None:
    (suite,) = Generate(out="a", procedural=1, suite="kitchen", camera="walk")._suites()
    assert suite.settings.room
    assert suite.settings.size == (640, 480)
    assert suite.settings.cameras.motion == "walk"
    assert suite.settings.cameras.azimuth_deg != CameraStyle().azimuth_deg


def test_one_number_is_the_side_of_a_square() -> None:
    given: tuple[tuple[int, ...], ...] = ((), (64,), (64, 64), (64, 48))
    sizes = [Generate(out="a", size=size)._settings(TakeSettings()).size for size in given]
    assert sizes == [224, 64, 64, (64, 48)]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ({}, "no objects"),
        ({"objects": ("partnet:1",), "level": (0,)}, "--level"),
        ({"objects": ("partnet:1",), "takes_per_object": 0}, "--takes-per-object"),
        ({"objects": ("partnet:1",), "seed": -1}, "--seed"),
        ({"objects": ("partnet:1",), "every": 9}, "every"),
        ({"objects": ("partnet:1",), "views": 0}, "view"),
        ({"objects": ("partnet:1",), "elevation": (50.0, 20.0)}, "elevation"),
        ({"objects": ("partnet:1",), "azimuth": (0.0, 200.0)}, "azimuth"),
        ({"seeds": "5..1"}, "A..B"),
        ({"imported": Path("free")}, "--imported goes with --split"),
        ({"seeds": "few"}, "A..B"),
        ({"procedural": 5, "seeds": "1..3"}, "do not fit"),
        ({"objects": ("partnet:1",), "hidden": 60}, "--suite"),
        ({"objects": ("partnet:1",), "look_alike": True}, "--suite"),
        ({"objects": ("partnet:1",), "suite": "occlusion", "hidden": 9}, "10 to 120"),
        ({"objects": ("partnet:1",), "suite": "occlusion", "hidden": 121}, "10 to 120"),
        ({"objects": ("partnet:1",), "suite": "occlusion", "views": 3}, "1 view"),
        ({"objects": ("partnet:1",), "suite": "occlusion", "frames_per_joint": 30}, "--frames-per-joint"),
        ({"procedural": 1, "suite": "lockers", "look_alike": True}, "--look-alike"),
        ({"objects": ("procedural:chest-1",), "suite": "lockers"}, "procedural:locker_bank-SEED, got chest-1"),
        ({"split": "validation", "suite": "lockers"}, "no objects"),
        ({"procedural": 1, "variant": ("blur",)}, "--suite"),
        ({"procedural": 1, "suite": "shift", "variant": ("fog",)}, "light, texture, blur"),
        ({"procedural": 1, "suite": "long", "variant": ("blur",)}, "only one kind"),
        ({"procedural": 1, "suite": "moving", "hidden": 60}, "nothing is hidden"),
        ({"procedural": 1, "suite": "lockers", "camera": "pan"}, "stands still"),
        ({"procedural": 1, "suite": "long", "gripper": True}, "gripper"),
        ({"procedural": 1, "frames": 30}, "more frames"),
        ({"procedural": 1, "size": (640, 480, 3)}, "WIDTH HEIGHT"),
        ({"procedural": 1, "size": (640, 8)}, "got 3 of 640 x 8"),
    ],
)
def test_settings_that_cannot_be(tmp_path: Path, words: dict, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        Generate(out=str(tmp_path / "takes"), **words).run()


def test_missing_folder_of_objects_is_told_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = str(tmp_path / "nowhere")
    code = program.main(
        ["generate", "--out", str(tmp_path / "takes"), "--objects", "partnet:44817", "--objects-root", root]
    )
    assert code == program.EXIT_ERROR
    message = capsys.readouterr().err
    assert root in message
    assert "QUEST_OBJECTS" in message
