"""Where entities are: on the outer surface, at the far edge, on the outward face, on the axis."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from quest.sim.articulation import apply
from quest.sim.entities import SimEntity, part_label
from quest.sim.objects import SimObject, load_object
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, HANDLE, TRAY, Box, Link, in_world, write_object


def entity(thing: SimObject, name: str) -> SimEntity:
    return next(e for e in thing.entities if e.name == name)


def bounds(thing: SimObject, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Of a part in the world, at rest."""
    found = next(p for p in thing.articulation.parts if p.name == part)
    points = apply(thing.articulation.poses(thing.articulation.rest)[found.body], np.asarray(found.surface.vertices))
    return points.min(axis=0), points.max(axis=0)


def test_one_entity_per_handle_and_hinges_last(cabinet: SimObject) -> None:
    assert [(e.name, e.label, e.joint) for e in cabinet.entities] == [
        ("drawer/handle", "handle", 0),
        ("door/rim", "rim", 1),
        ("door/hinge", "hinge", 1),
    ]


def test_handle_point_is_on_the_side_of_the_handle_that_looks_out(cabinet: SimObject) -> None:
    handle = entity(cabinet, "drawer/handle")
    (part,) = handle.parts
    surface = cabinet.articulation.parts[part].surface
    (distance,) = trimesh.proximity.closest_point(surface, handle.point[None])[1]
    assert distance < 1e-9
    low, high = bounds(cabinet, "handle-8")
    point = in_world(cabinet, handle)
    middle, size = (low + high) / 2, high - low
    assert point[0] > middle[0]  # not the side that faces the drawer
    assert (np.abs(point - middle)[1:] < 0.3 * size[1:] + 0.5 * size[2]).all()


def test_rim_is_the_middle_of_the_edge_farthest_from_the_axis(cabinet: SimObject) -> None:
    rim = entity(cabinet, "door/rim")
    low, high = bounds(cabinet, "door_panel-9")
    point, unit = in_world(cabinet, rim), cabinet.half_diagonal_m
    assert point[1] == pytest.approx(high[1], abs=0.06 * unit)  # the hinge is at the other side
    assert point[2] == pytest.approx((low[2] + high[2]) / 2, abs=0.06 * unit)
    assert low[0] - 1e-9 <= point[0] <= high[0] + 1e-9


def test_front_is_on_the_face_that_a_drawer_moves_towards(tmp_path: Path) -> None:
    plain = load_object(write_object(tmp_path / "cabinet", CARCASS, replace(DRAWER, boxes=DRAWER.boxes[:1])))
    (front,) = plain.entities
    assert front.name == "drawer/front"
    low, high = bounds(plain, "drawer_box-7")
    point = in_world(plain, front)
    assert point[0] == pytest.approx(high[0], abs=1e-6)
    np.testing.assert_allclose(point[1:], ((low + high) / 2)[1:], atol=0.06 * plain.half_diagonal_m)


def test_hinge_is_on_the_axis_in_the_middle_of_the_door(cabinet: SimObject) -> None:
    hinge = entity(cabinet, "door/hinge")
    poses = cabinet.articulation.poses(cabinet.articulation.rest)
    line = cabinet.articulation.axes(poses)[hinge.joint]
    point = in_world(cabinet, hinge)
    assert np.linalg.norm(np.cross(point - line[:3], line[3:])) < 1e-9
    low, high = bounds(cabinet, "door_panel-9")
    assert point[2] == pytest.approx((low[2] + high[2]) / 2)
    assert hinge.travel_m == pytest.approx(0, abs=1e-9)


def test_travel_is_how_far_the_point_gets(cabinet: SimObject) -> None:
    assert entity(cabinet, "drawer/handle").travel_m == pytest.approx(0.35 * 0.8)
    rim = entity(cabinet, "door/rim")
    radius = np.linalg.norm(rim.point[:2])
    assert rim.travel_m == pytest.approx(2 * radius * np.sin(1.5 / 2))


def test_pieces_of_one_handle_are_one_entity_and_two_handles_are_two(tmp_path: Path) -> None:
    mount = Box("handle-9", (0.02, 0.02, 0.02), (0.235, 0.08, 0))
    far = Box("handle-10", (0.04, 0.05, 0.04), (0.26, 0.22, 0))
    one = load_object(write_object(tmp_path / "one", CARCASS, replace(DRAWER, boxes=(*DRAWER.boxes, mount))))
    two = load_object(write_object(tmp_path / "two", CARCASS, replace(DRAWER, boxes=(*DRAWER.boxes, mount, far))))
    assert [len(e.parts) for e in one.entities] == [2]
    assert [(e.name, len(e.parts)) for e in two.entities] == [("drawer/handle", 2), ("drawer/handle_2", 1)]


def test_handles_on_what_never_moves_are_none(tmp_path: Path) -> None:
    fixed = replace(CARCASS, boxes=(*CARCASS.boxes, HANDLE))
    thing = load_object(write_object(tmp_path / "cabinet", fixed, DOOR))
    assert [e.label for e in thing.entities] == ["rim", "hinge"]


def test_what_hardly_moves_is_followed_only_if_there_is_nothing_else(tmp_path: Path) -> None:
    button = Link(
        "button", (Box("button-30", (0.02, 0.04, 0.04)),), kind="prismatic", origin=(0.26, 0.2, 0.6), limits=(0, 0.01)
    )
    alone = load_object(write_object(tmp_path / "alone", CARCASS, button))
    assert [e.name for e in alone.entities] == ["button/front"]
    assert alone.movable == ()
    beside = load_object(write_object(tmp_path / "beside", CARCASS, button, DRAWER))
    assert [e.name for e in beside.entities] == ["drawer/handle"]


def test_entity_behind_a_closed_door_is_inside(tmp_path: Path) -> None:
    cabinet = load_object(write_object(tmp_path / "cabinet", CARCASS, DRAWER, DOOR, TRAY))
    assert {e.name: e.inside for e in cabinet.entities if e.label != "hinge"} == {
        "drawer/handle": False,
        "door/rim": False,
        "tray/handle": True,
    }


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("handle-14", "handle"),
        ("door_handle", "handle"),
        ("Knob-3", "knob"),
        ("DoorHandle", "handle"),
        ("left_doorknob", "knob"),
        ("panhandler", None),
        ("door-1", None),
        ("", None),
    ],
)
def test_part_names(name: str, label: str | None) -> None:
    assert part_label(name) == label


# A laptop that looks along -x, as PartNet-Mobility's do.
LID = Link(
    "lid",
    (Box("screen_frame-1", (0.22, 0.34, 0.006), (-0.11, 0, 0.004)),),
    kind="revolute",
    origin=(0.11, 0, 0.02),
    axis=(0, 1, 0),
    limits=(0, 2.0),
)
BASE = Link("base_body", (Box("base_frame-2", (0.22, 0.34, 0.02), (0, 0, 0.01)),))


def test_laptop_has_a_rim_to_open_and_one_to_lift(tmp_path: Path) -> None:
    laptop = load_object(write_object(tmp_path / "laptop", BASE, LID, category="Laptop"))
    assert [(e.name, e.joint, e.body) for e in laptop.entities] == [
        ("lid/rim", 0, 1), ("base/rim", -1, 0), ("lid/hinge", 0, 1)
    ]  # fmt: skip
    lid, base = (in_world(laptop, entity(laptop, name)) for name in ("lid/rim", "base/rim"))
    low, high = bounds(laptop, "base_frame-2")
    assert base[0] == pytest.approx(high[0], abs=1e-3)  # the free edge, opposite the hinge
    assert base[1] == pytest.approx((low[1] + high[1]) / 2, abs=0.01)
    assert low[2] <= base[2] <= high[2]
    assert lid[2] > base[2]
    assert laptop.movable == (0,)
    assert entity(laptop, "base/rim").travel_m == 0


@pytest.mark.parametrize(("category", "fixed"), [("Kettle", ["base/handle"]), ("StorageFurniture", [])])
def test_handle_of_the_base_counts_where_one_lifts_by_it(tmp_path: Path, category: str, fixed: list[str]) -> None:
    lid = Link(
        "lid", (Box("lid-1", (0.2, 0.2, 0.02)),), kind="prismatic", origin=(0, 0, 0.2), axis=(0, 0, 1), limits=(0, 0.1)
    )
    body = Link(
        "pot", (Box("base_body-2", (0.2, 0.2, 0.2), (0, 0, 0.1)), Box("handle-3", (0.05, 0.02, 0.1), (0, 0.13, 0.1)))
    )
    thing = load_object(write_object(tmp_path / "pot", body, lid, category=category))
    assert [e.name for e in thing.entities if e.fixed] == fixed
    assert thing.entities[0].label == ("knob" if category == "Kettle" else "front")
    assert thing.movable == (0,)
