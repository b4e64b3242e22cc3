"""A user's own URDF: found in a folder, described in a few lines, refused with a remedy where that is wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from quest.data.split import split_of
from quest.errors import ObjectError
from quest.sim.description import read_description
from quest.sim.objects import SimObject, find_objects, find_urdf, load_object
from quest.types import Joint, TakeInfo
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, Box, Link, edit, in_world, write_cabinet, write_object

NAMELESS = replace(DRAWER, boxes=(DRAWER.boxes[0], replace(DRAWER.boxes[1], name="grip_a")))


DOOR_GRIP = Box("grip", (0.04, 0.04, 0.2), (0.04, 0.55, 0))


def described(folder: Path, *links: Link, **description: Any) -> Path:
    """An object folder with an ``entities.json``."""
    write_object(folder, *(links or (CARCASS, NAMELESS, DOOR)), category=None)
    (folder / "entities.json").write_text(json.dumps(description))
    return folder


def entities(thing: SimObject) -> list[tuple[str, str]]:
    return [(e.name, e.label) for e in thing.entities if e.label != "hinge"]


def renamed(folder: Path, name: str) -> Path:
    """The folder's URDF under another name."""
    return (folder / "mobility.urdf").rename(folder / name)


def test_urdf_of_any_name_is_the_users_own_and_in_metres(tmp_path: Path) -> None:
    folder = write_object(tmp_path / "cabinet", CARCASS, DRAWER, DOOR, category=None)
    urdf = renamed(folder, "kitchen_unit.urdf")
    by_folder, by_file = load_object(folder), load_object(urdf)
    assert by_folder.source == by_file.source == "own"
    assert (by_folder.object_id, by_file.object_id) == ("cabinet", "kitchen_unit")
    assert by_folder.articulation.extent_m[2] == pytest.approx(1.0)
    assert by_folder.warnings == ()
    assert find_objects(tmp_path) == [folder]


def test_folder_with_several_urdfs_asks_for_one(tmp_path: Path) -> None:
    folder = write_cabinet(tmp_path / "cabinet")
    urdf = renamed(folder, "a.urdf")
    (folder / "b.urdf").write_text(urdf.read_text())
    with pytest.raises(ObjectError, match=r"a\.urdf, b\.urdf; name one"):
        load_object(folder)
    assert load_object(urdf).movable == (0, 1)


def test_xacro_is_refused_with_the_command_that_helps(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf.xacro").write_text("<robot/>")
    with pytest.raises(ObjectError, match=r"run: xacro arm\.urdf\.xacro > arm\.urdf"):
        find_urdf(tmp_path)
    hidden = tmp_path / "arm.urdf"
    hidden.write_text('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="a" value="1"/></robot>')
    with pytest.raises(ObjectError, match="xacro"):
        load_object(hidden)


def test_implausible_size_is_flagged(tmp_path: Path) -> None:
    links = [replace(link, boxes=tuple(replace(b, size=(90, 60, 40)) for b in link.boxes)) for link in (CARCASS, DOOR)]
    folder = write_object(tmp_path / "in_millimetres", *links, category=None)
    renamed(folder, "it.urdf")
    assert any("size_m" in warning for warning in load_object(folder).warnings)


def test_description_names_size_front_and_visuals(tmp_path: Path) -> None:
    grips = [{"visual": "grip*", "label": "handle"}]
    said = described(tmp_path / "mine", category="Sideboard", height_m=0.6, front="+y", entities=grips)
    thing = load_object(said)
    assert (thing.source, thing.category) == ("own", "Sideboard")
    assert thing.articulation.extent_m[2] == pytest.approx(0.6)
    assert thing.articulation.extent_m[0] == pytest.approx(0.6 * 0.6)  # what looked along +y looks along +x
    assert entities(thing) == [("drawer/handle", "handle"), ("door/rim", "rim")]  # the door keeps what it had
    assert thing.entities[0].parts
    assert load_object(described(tmp_path / "long", size_m=2.0)).scale == pytest.approx(2.0)


def test_descriptions_of_parts_on_a_link_called_handle_and_of_links_alone(tmp_path: Path) -> None:
    door = replace(DOOR, name="door_with_handle", boxes=(replace(DOOR.boxes[0], name="panel"), DOOR_GRIP))
    mount = Box("grip_b", (0.02, 0.02, 0.02), (0.24, 0.05, 0))
    drawer = replace(NAMELESS, boxes=(*NAMELESS.boxes, mount))  # two boxes near each other are one handle
    wanted = [{"visual": "grip*", "label": "handle"}]
    thing = load_object(described(tmp_path / "a", CARCASS, drawer, door, entities=wanted))
    assert [len(e.parts) for e in thing.entities if e.label == "handle"] == [2, 1]
    wanted = [{"link": "drawer", "label": "front"}, {"link": "door", "label": "rim"}]
    thing = load_object(described(tmp_path / "b", entities=wanted))
    assert entities(thing) == [("drawer/front", "front"), ("door/rim", "rim")]


def test_lid_tells_where_the_front_is(tmp_path: Path) -> None:
    lid = Link(
        "lid", (Box("cover-1", (0.4, 0.3, 0.02), (0, -0.15, 0)),), kind="revolute", origin=(0, 0.15, 0.2),
        axis=(-1, 0, 0), limits=(0, 1.7),
    )  # fmt: skip
    case = Link("case", (Box("case-2", (0.4, 0.3, 0.2), (0, 0, 0.1)),))
    thing = load_object(described(tmp_path / "mine", case, lid))
    (rim,) = (e for e in thing.entities if e.label == "rim")
    assert in_world(thing, rim)[0] == pytest.approx(0.15, abs=0.01)


def test_point_lies_on_the_surface_of_its_link_and_scales(tmp_path: Path) -> None:
    entry = {"link": "door", "label": "knob", "point": [0.025, 0.5, 0.1]}
    thing = load_object(described(tmp_path / "mine", height_m=2.0, entities=[entry]))
    knob = next(e for e in thing.entities if e.label == "knob")
    assert knob.body == 2
    np.testing.assert_allclose(knob.point, np.array([0.02, 0.5, 0.1]) * 2, atol=0.03)
    found = thing.articulation.parts[thing.articulation.body_parts(2)[0]].surface
    assert trimesh.proximity.closest_point(found, knob.point[None])[1][0] < 1e-9
    assert not any(e.label == "rim" for e in thing.entities)


def test_entity_fixed_in_the_base_is_for_lifting(tmp_path: Path) -> None:
    entry = {"link": "body", "label": "rim", "point": [0.25, 0.0, 0.99]}
    thing = load_object(described(tmp_path / "mine", entities=[entry]))
    rim = next(e for e in thing.entities if e.fixed)
    assert (rim.name, rim.joint, rim.body, rim.travel_m) == ("base/rim", -1, 0, 0.0)
    assert thing.movable == (0, 1)
    labels = [e.label for e in thing.entities]
    assert labels == ["front", "rim", "rim", "hinge"]  # moving ones, then what is fixed, then hinges
    assert in_world(thing, rim)[2] == pytest.approx(0.99, abs=0.02)


@pytest.mark.parametrize(
    ("description", "named"),
    [
        ("[]", "expected an object in braces, got list"),
        ("{", "cannot be read"),
        ('{"colour": "red"}', "unknown field 'colour'"),
        ('{"size_m": 0}', "size_m is 0, expected metres > 0"),
        ('{"size_m": 1, "height_m": 1}', "leave one out"),
        ('{"front": "left"}', r"expected one of \+x"),
        ('{"category": 3}', "category is 3"),
        ('{"entities": {}}', "entities is dict"),
        ('{"entities": [{"label": "handle"}]}', r"entities\[0\]: expected a link or a visual"),
        ('{"entities": [{"link": "door", "label": "grip"}]}', "label is 'grip'"),
        ('{"entities": [{"link": "door", "label": "handle"}]}', "needs a visual or a point"),
        ('{"entities": [{"link": "door", "label": "knob", "point": [1, 2]}]}', "give three numbers"),
        ('{"entities": [{"visual": "a", "label": "knob", "point": [1, 2, 3]}]}', "leave one out"),
        ('{"entities": [{"link": "lid", "label": "rim"}]}', "no link 'lid'; expected one of base, body, drawer"),
        ('{"entities": [{"visual": "lid*", "label": "rim"}]}', r"no visual is called 'lid\*'"),
        ('{"entities": [{"link": "drawer", "label": "rim"}]}', "its joint is prismatic and not revolute; give a point"),
        ('{"entities": [{"link": "body", "label": "front"}]}', "its joint is fixed"),
        ('{"entities": [{"link": "door", "label": "knob", "point": [9, 9, 9]}]}', "m away from what can be seen"),
    ],
)
def test_bad_descriptions_are_told_with_entry_and_remedy(tmp_path: Path, description: str, named: str) -> None:
    folder = write_object(tmp_path / "mine", CARCASS, NAMELESS, DOOR)
    (folder / "entities.json").write_text(description)
    with pytest.raises(ObjectError, match=named) as error:
        load_object(folder)
    assert "entities.json" in str(error.value)


def test_mimic_joints_move_on_their_own_and_say_so(tmp_path: Path) -> None:
    folder = write_cabinet(tmp_path / "cabinet")
    urdf = folder / "mobility.urdf"
    text = urdf.read_text()
    cut = text.rindex("</joint>")
    urdf.write_text(f'{text[:cut]}<mimic joint="joint_drawer" multiplier="2"/>{text[cut:]}')
    thing = load_object(folder)
    assert thing.warnings == ("joint joint_door mimics joint_drawer: here it moves on its own",)
    assert thing.movable == (0, 1)


def test_package_paths_are_found_beside_and_above(tmp_path: Path) -> None:
    folder = write_cabinet(tmp_path / "my_cabinet" / "urdf")
    (folder / "textured_objs").rename(tmp_path / "my_cabinet" / "meshes")
    edit(folder, 'filename="textured_objs/', 'filename="package://my_cabinet/meshes/')
    assert load_object(folder).warnings == ()
    edit(folder, "package://my_cabinet", "package://other_name")
    assert load_object(folder).warnings == ()


def test_own_objects_are_in_no_part_of_the_split() -> None:
    info = TakeInfo("t", "own", "fridge-100003", "x", 1, 0, 1.0, 30.0, (), (Joint("j", "revolute", 0, 1),), (0,))
    with pytest.raises(ObjectError, match="in no part of the split"):
        split_of(info)


def test_example_in_the_documentation_is_a_valid_description(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "objects.md").read_text(encoding="utf-8")
    blocks = [block.split("```")[0] for block in text.split("```json\n")[1:]]
    assert blocks
    for number, block in enumerate(blocks):
        path = tmp_path / f"{number}.json"
        path.write_text(block)
        assert read_description(path).entities
