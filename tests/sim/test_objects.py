"""Object folders: what is read from them, and what is said about bad ones."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from quest.errors import ObjectError
from quest.sim.articulation import MAX_TURN_RAD
from quest.sim.objects import find_objects, load_object
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, HANDLE, Box, Link, edit, write_cabinet, write_object


def test_cabinet(tmp_path: Path) -> None:
    cabinet = load_object(write_cabinet(tmp_path / "cabinet"))
    assert (cabinet.source, cabinet.object_id, cabinet.category) == ("partnet-mobility", "cabinet", "StorageFurniture")
    assert cabinet.scale == pytest.approx(0.8)  # one unit high, and a cabinet is 0.8 m
    assert cabinet.warnings == ()
    points = cabinet.articulation.world_points(cabinet.articulation.rest)
    assert points[:, 2].min() == pytest.approx(0, abs=1e-9)
    assert np.ptp(points[:, 2]) == pytest.approx(0.8)
    assert cabinet.half_diagonal_m == pytest.approx(np.linalg.norm(np.ptp(points, axis=0)) / 2)
    joints = [j.joint for j in cabinet.articulation.joints]
    assert [(j.name, j.kind) for j in joints] == [("joint_drawer", "prismatic"), ("joint_door", "revolute")]
    assert joints[0].upper == pytest.approx(0.35 * 0.8)  # metres
    assert joints[1].upper == pytest.approx(1.5)  # radians
    assert cabinet.movable == (0, 1)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_front_looks_towards_plus_x_however_the_object_was_modelled(tmp_path: Path, yaw: float) -> None:
    turned = [Link("turn", (), yaw=yaw), *(replace(link, parent="turn") for link in (CARCASS, DRAWER, DOOR))]
    articulation = load_object(write_object(tmp_path / "cabinet", *turned)).articulation
    axes = articulation.axes(articulation.poses(articulation.rest))
    np.testing.assert_allclose(axes[0, 3:], [1, 0, 0], atol=1e-9)


def test_links_that_fixed_joints_hold_together_are_one_body(tmp_path: Path) -> None:
    bar = Link("bar", (HANDLE,), parent="door", origin=(0.0, 0.3, 0.0))
    cabinet = load_object(write_object(tmp_path / "cabinet", CARCASS, DRAWER, DOOR, bar))
    assert cabinet.articulation.body_names == ("base", "drawer", "door")
    assert [e.name for e in cabinet.entities] == ["drawer/handle", "door/handle", "door/hinge"]


def test_poses_turn_and_slide(tmp_path: Path) -> None:
    cabinet = load_object(write_cabinet(tmp_path / "cabinet"))
    rest = cabinet.articulation.poses(np.zeros(2))
    moved = cabinet.articulation.poses(np.array([0.1, np.pi / 2]))
    np.testing.assert_allclose(moved[1, :3, 3] - rest[1, :3, 3], [0.1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(moved[2, :3, 3], rest[2, :3, 3], atol=1e-12)  # its origin lies on the hinge
    np.testing.assert_allclose(moved[2, :3, :3] @ [0, 1, 0], [1, 0, 0], atol=1e-12)  # the leaf opens to the front


def test_turns_are_a_quarter_without_limits_and_capped_with_wide_ones(tmp_path: Path) -> None:
    for name, door, most in (
        ("free", replace(DOOR, kind="continuous", limits=None), np.pi / 2),
        ("wide", replace(DOOR, limits=(0, 3.1)), MAX_TURN_RAD),
    ):
        cabinet = load_object(write_object(tmp_path / name, CARCASS, door))
        assert cabinet.articulation.joints[0].travel() == pytest.approx((0, most))


def test_door_modelled_half_open_is_closed(tmp_path: Path) -> None:
    # At position 0 the leaf stands 45 degrees open; closed is at the lower limit.
    door = replace(DOOR, yaw=-np.pi / 4, limits=(-np.pi / 4, np.pi / 4))
    cabinet = load_object(write_object(tmp_path / "cabinet", CARCASS, DRAWER, door))
    closed = load_object(write_cabinet(tmp_path / "closed"))
    joint = cabinet.articulation.joints[1]
    assert joint.rest == pytest.approx(-np.pi / 4)
    assert joint.opening() == pytest.approx(np.pi / 2)
    assert cabinet.half_diagonal_m == pytest.approx(closed.half_diagonal_m)


def test_origins_left_in_old_units_are_mended(tmp_path: Path) -> None:
    """Meshes scaled by 0.1 about a joint origin that was not: the bucket of PartNet-Mobility."""
    folder = write_cabinet(tmp_path / "cabinet")
    edit(folder, '.obj"/>', '.obj" scale="0.1 0.1 0.1"/>')
    for link in (DRAWER, DOOR):  # meshes of one common frame: the visual takes the joint's origin back
        back = '<origin xyz="{} {} {}"/>'.format(*(-x for x in link.origin))
        for box in link.boxes:
            edit(folder, f'<visual name="{box.name}">', f'<visual name="{box.name}">{back}')
    cabinet = load_object(folder)
    assert any("scaled" in warning for warning in cabinet.warnings)
    axes = cabinet.articulation.axes(cabinet.articulation.poses(cabinet.articulation.rest))
    assert np.abs(axes[:, :3]).max() < 1  # inside the object, not ten times as far away
    assert cabinet.articulation.joints[0].joint.upper == pytest.approx(0.1 * 0.35 * cabinet.scale)
    # A user's URDF with meshes in other units looks just so, and means what it says.
    own = load_object((folder / "mobility.urdf").rename(folder / "own.urdf"))
    assert own.source == "own"
    assert not any("scaled" in warning for warning in own.warnings)
    assert own.articulation.joints[0].joint.upper == pytest.approx(0.35)


def test_as_many_joints_as_masks_can_tell(tmp_path: Path) -> None:
    drawers = tuple(replace(DRAWER, name=f"drawer{n}") for n in range(255))
    with pytest.raises(ObjectError, match="at most 254"):
        load_object(write_object(tmp_path / "archive", CARCASS, *drawers))


@pytest.mark.parametrize("file", ["result_after_merging.json", "mobility_v2.json"])
def test_names_come_from_the_annotation_where_the_urdf_has_none(tmp_path: Path, file: str) -> None:
    nameless = replace(DRAWER, boxes=tuple(replace(box, name="") for box in DRAWER.boxes))
    folder = write_object(tmp_path / "cabinet", CARCASS, nameless)
    tree = [{"name": "drawer", "id": 1, "objs": ["drawer-0"]}, {"name": "handle", "id": 2, "objs": ["drawer-1"]}]
    key = "parts" if file.startswith("mobility") else "children"
    (folder / file).write_text(json.dumps([{"name": "cabinet", "id": 0, key: tree}]))
    assert [e.label for e in load_object(folder).entities] == ["handle"]


def test_unknown_categories_and_unreadable_meta_are_flagged(tmp_path: Path) -> None:
    folder = write_object(tmp_path / "cabinet", CARCASS, DRAWER, category=None)
    cabinet = load_object(folder)
    assert cabinet.category == "Unknown"
    assert any("category" in warning for warning in cabinet.warnings)
    assert cabinet.articulation.extent_m.max() == pytest.approx(0.8)
    (folder / "meta.json").write_text("{")
    assert any("meta.json" in warning for warning in load_object(folder).warnings)


def test_missing_and_empty_meshes_are_left_out_and_flagged(tmp_path: Path) -> None:
    ghost, empty = Box("handle-20", (1, 1, 1), missing=True), Box("drawer_side-21", (1, 1, 1))
    folder = write_object(tmp_path / "cabinet", CARCASS, replace(DRAWER, boxes=(*DRAWER.boxes, ghost, empty)))
    (folder / "textured_objs" / "drawer-3.obj").write_text("v 0 0 0\n")
    cabinet = load_object(folder)
    (warning,) = cabinet.warnings
    assert "2 meshes" in warning
    assert "drawer-2.obj, drawer-3.obj" in warning
    assert [e.name for e in cabinet.entities] == ["drawer/handle"]


@pytest.mark.parametrize("name", ["door.glb", "door.3ds", "door.step", "door.dae"])
def test_meshes_that_no_reader_reads_are_left_out_too(tmp_path: Path, name: str) -> None:
    folder = write_cabinet(tmp_path / "cabinet")
    (folder / "textured_objs" / name).write_bytes(b"<a/>")
    edit(folder, "body-0.obj", name)
    (warning,) = load_object(folder).warnings
    assert name in warning


@pytest.mark.parametrize("unit", ["", '<unit name="centimeter" meter="0.01"/>'])
def test_collada_files_tell_their_unit(tmp_path: Path, unit: str) -> None:
    folder = write_object(tmp_path / "cabinet", CARCASS, DRAWER, DOOR, category=None)
    mesh = folder / "textured_objs" / "body-0.dae"
    trimesh.creation.box((0.02, 0.6, 5.0)).export(mesh)
    mesh.write_text(mesh.read_text().replace("</asset>", f"{unit}</asset>", 1))
    urdf = edit(folder, "body-0.obj", "body-0.dae").rename(folder / "own.urdf")
    back = load_object(urdf).articulation.parts[0]
    assert np.ptp(back.surface.vertices[:, 2]) == pytest.approx(0.05 if unit else 5.0)


def test_mirrored_meshes_still_look_outwards(tmp_path: Path) -> None:
    folder = write_cabinet(tmp_path / "cabinet")
    edit(folder, 'door-0.obj"/>', 'door-0.obj" scale="1 -1 1"/>')
    (door,) = [part for part in load_object(folder).articulation.parts if part.name.startswith("door_panel")]
    assert door.surface.volume > 0


def without_meshes(*links: Link) -> tuple[Link, ...]:
    return tuple(replace(link, boxes=tuple(replace(box, missing=True) for box in link.boxes)) for link in links)


CYCLE = (CARCASS, replace(DRAWER, parent="door"), replace(DOOR, parent="drawer"))


@pytest.mark.parametrize(
    ("links", "spoil", "named"),
    [
        ((), lambda urdf: shutil.rmtree(urdf.parent), "expected an object folder"),
        ((), Path.unlink, "expected a URDF file"),
        ((), lambda urdf: urdf.write_text(urdf.read_text()[:300]), "not a readable URDF"),
        ((), lambda urdf: urdf.write_bytes(b"\x00\xff\x00"), "not a readable URDF"),
        ((), lambda urdf: edit(urdf.parent, "geometry>", "shape>"), "no geometry"),
        ((CARCASS, replace(DRAWER, limits=(0, float("nan")))), None, "got 'nan'"),
        ((CARCASS, replace(DRAWER, axis=(0, 0, 0))), None, "axis of length zero"),
        ((CARCASS, replace(DRAWER, parent="nobody")), None, "nobody"),
        (CYCLE, None, "cycle"),
        (without_meshes(CARCASS, DRAWER), None, "expected meshes"),
        ((CARCASS, replace(DRAWER, kind="fixed", limits=None)), None, "expected a joint that moves"),
        ((CARCASS, replace(DRAWER, limits=(0, 0))), None, "expected a joint that moves"),
        ((CARCASS, replace(DRAWER, boxes=())), None, "expected a moving link"),
    ],
)
def test_bad_folders_are_told_with_name_and_remedy(
    tmp_path: Path, links: tuple[Link, ...], spoil: Callable[[Path], object] | None, named: str
) -> None:
    folder = write_object(tmp_path / "cabinet", *(links or (CARCASS, DRAWER)))
    if spoil is not None:
        spoil(folder / "mobility.urdf")
    with pytest.raises(ObjectError, match=named) as error:
        load_object(folder)
    assert str(folder) in str(error.value)
    assert any(word in str(error.value) for word in ("restore", "check", "copy", "use another", "name a folder"))


def test_folder_of_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("QUEST_OBJECTS", raising=False)
    with pytest.raises(ObjectError, match="QUEST_OBJECTS"):
        find_objects()
    with pytest.raises(ObjectError, match="check QUEST_OBJECTS"):
        find_objects(tmp_path / "nowhere")
    with pytest.raises(ObjectError, match=r"mobility\.urdf"):
        find_objects(tmp_path)
    for name in ("b", "a"):
        write_cabinet(tmp_path / name)
    monkeypatch.setenv("QUEST_OBJECTS", str(tmp_path))
    assert [folder.name for folder in find_objects()] == ["a", "b"]


@pytest.mark.partnet
@pytest.mark.parametrize(
    ("object_id", "labels", "names"),
    [
        ("44817", {"handle"}, None),
        ("7320", None, None),  # names meshes that do not exist
        ("kettle_dh", {"knob", "handle"}, {"base/handle"}),  # its meshes, but not its joint limits, carry a scale
        ("bucket_dh", {"handle", "hinge"}, None),  # its origins lack the scale of its meshes
        ("01909", None, {"link_0/handle"}),  # its door's bar is called a door
        ("door_dh", None, {"link_1/handle", "link_1/handle_2", "link_2/handle", "link_2/handle_2"}),
        ("10495", None, {"link_0/handle", "base/handle"}),
        ("101284", None, {"link_0/rim", "link_1/rim"}),
        ("103104", None, {"link_0/rim", "link_1/rim"}),
    ],
)
def test_real_objects_have_plausible_sizes_and_travels_and_the_entities_of_their_category(
    partnet_root: Path, object_id: str, labels: set[str] | None, names: set[str] | None
) -> None:
    folder = partnet_root / object_id
    if not folder.is_dir():
        pytest.skip(f"no object {object_id}")
    thing = load_object(folder)
    assert thing.movable
    assert labels is None or {e.label for e in thing.entities} == labels
    assert names is None or {e.name for e in thing.entities if e.label not in ("hinge", "knob")} == names
    points = thing.articulation.world_points(thing.articulation.rest)
    for line in thing.articulation.axes(thing.articulation.poses(thing.articulation.rest)):
        assert (line[:3] > points.min(axis=0) - thing.half_diagonal_m).all()
        assert (line[:3] < points.max(axis=0) + thing.half_diagonal_m).all()
    assert all(e.travel_m < 3 * thing.half_diagonal_m for e in thing.entities)
    if object_id == "kettle_dh":  # its lid lifts off by a few centimetres
        lid, handle = thing.entities
        assert 0.02 < lid.travel_m < 0.1
        assert (handle.fixed, handle.travel_m) == (True, 0.0)


def test_refrigerator_that_would_be_too_deep_is_a_small_one(tmp_path: Path) -> None:
    deep = load_object(write_object(tmp_path / "deep", CARCASS, DOOR, category="Refrigerator"))
    assert deep.articulation.extent_m[2] == pytest.approx(1.7)
    boxes = tuple(replace(b, size=(2 * b.size[0], *b.size[1:])) for b in CARCASS.boxes)
    door = replace(DOOR, origin=(0.5, -0.3, 0.25))
    deeper = load_object(
        write_object(tmp_path / "deeper", replace(CARCASS, boxes=boxes), door, category="Refrigerator")
    )
    size = deeper.articulation.extent_m
    assert size[0] == pytest.approx(0.65)
    assert size[2] < 0.9
