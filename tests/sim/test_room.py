"""Rooms: an object among other furniture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.objects import SimObject
from quest.sim.procedural import make_object
from quest.sim.procedural.model import Dice
from quest.sim.room import furnished
from quest.sim.settings import TakeSettings

TEST_SEED = 110_000


def in_a_room(sim_object: SimObject, seed: int = 0, *, things: str | None = None) -> tuple[SimObject, tuple[str, ...]]:
    return furnished(sim_object, Dice(np.random.PCG64(seed)), things=things)


def entity_points(sim_object: SimObject) -> np.ndarray:
    articulation = sim_object.articulation
    poses = articulation.poses(articulation.rest)
    return np.array([apply(poses[e.body], e.point) for e in sim_object.entities])


@pytest.mark.parametrize("name", ["chest", "refrigerator", "microwave", "laptop"])
def test_the_object_is_what_it_is_alone(name: str) -> None:
    alone = make_object(name, TEST_SEED)
    room, beside = in_a_room(alone)
    assert (room.source, room.object_id, room.half_diagonal_m) == (alone.source, alone.object_id, alone.half_diagonal_m)
    assert room.movable == alone.movable
    assert len(beside) >= 2
    at = {e.name: point for e, point in zip(room.entities, entity_points(room), strict=True)}
    shift = [at[e.name] - point for e, point in zip(alone.entities, entity_points(alone), strict=True)]
    on_furniture = name in ("microwave", "laptop")
    np.testing.assert_allclose(shift, np.tile(shift[0], (len(shift), 1)), atol=1e-9)
    np.testing.assert_allclose(shift[0][:2], 0, atol=1e-9)
    assert shift[0][2] > 0.6 if on_furniture else shift[0][2] == 0


@pytest.mark.parametrize("seed", range(6))
def test_furniture_stands_beside_furniture(seed: int) -> None:
    room, _ = in_a_room(make_object("cabinet", TEST_SEED + seed), seed)
    articulation, boxes = room.articulation, {}
    poses = articulation.poses(articulation.rest)
    for part in articulation.parts:
        points = apply(poses[part.body], np.asarray(part.surface.vertices))
        boxes.setdefault(part.name.rpartition("/")[0], []).append(points)
    still = np.concatenate(boxes.pop("room"))
    bounds = {name: np.stack((p.min(axis=0), p.max(axis=0))) for name, p in
              ((name, np.concatenate(points)) for name, points in boxes.items())}  # fmt: skip
    names = sorted(bounds)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            overlap = np.minimum(bounds[a][1], bounds[b][1]) - np.maximum(bounds[a][0], bounds[b][0])
            assert overlap.min() < 1e-3, (a, b, overlap)
        assert bounds[a][0, 2] > -1e-6
        assert still[:, 0].min() < bounds[a][0, 0], "the wall is behind everything"


def test_neighbours_belong_to_the_same_part_of_the_split() -> None:
    for seed, (low, high) in ((TEST_SEED, (110_000, 119_999)), (3, (0, 99_999))):
        _, beside = in_a_room(make_object("chest", seed), seed)
        assert all(low <= int(name.rpartition("-")[2]) <= high for name in beside), beside


def test_entities_are_told_apart_and_hinges_come_last() -> None:
    room, _ = in_a_room(make_object("base_cabinet", TEST_SEED), 4)
    names = [e.name for e in room.entities]
    assert len(set(names)) == len(names)
    hinges = [e.label == "hinge" for e in room.entities]
    assert hinges == sorted(hinges)
    for entity in room.entities:
        for part in entity.parts:
            assert room.articulation.parts[part].body == entity.body


def test_a_seed_is_a_room() -> None:
    first, second, other = (in_a_room(make_object("desk", TEST_SEED), seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(entity_points(first), entity_points(second))
    assert first.view_m is not None
    assert second.view_m is not None
    np.testing.assert_array_equal(first.view_m, second.view_m)
    assert {e.name for e in first.entities} != {e.name for e in other.entities}


def test_small_things_have_no_room() -> None:
    with pytest.raises(ObjectError, match="for a room"):
        in_a_room(make_object("stapler", TEST_SEED))


def test_things_of_a_folder_stand_on_the_furniture(tmp_path: Path) -> None:
    for name, size in (("cup", 0.1), ("tower", 3.0)):
        folder = tmp_path / name
        folder.mkdir()
        trimesh.creation.box((0.1, 0.1, size)).apply_translation((0, 0, size / 2)).export(folder / "body.obj")
        (folder / f"{name}.urdf").write_text(
            f'<robot name="{name}"><link name="{name}"><visual name="{name}"><geometry><mesh filename="body.obj"/>'
            "</geometry></visual></link></robot>"
        )
    rooms = [in_a_room(make_object("chest", TEST_SEED), seed, things=str(tmp_path))[0] for seed in range(3)]
    placed = [part for room in rooms for part in room.articulation.parts if part.name.startswith("things/")]
    assert {part.name for part in placed} == {"things/cup"}, "a tower of three metres does not stand on a chest"
    assert not any(part.name.startswith("room/thing") for room in rooms for part in room.articulation.parts)
    for room in rooms:
        world = room.articulation.world_from_root
        for part in room.articulation.parts:
            if part.name == "things/cup":
                assert part.body == 0
                assert apply(world, np.asarray(part.surface.vertices))[:, 2].min() > 0.3


def test_a_folder_without_things(tmp_path: Path) -> None:
    with pytest.raises(ObjectError, match="import"):
        in_a_room(make_object("chest", TEST_SEED), things=str(tmp_path))
    with pytest.raises(ConfigError, match="room"):
        TakeSettings(things=str(tmp_path))
