"""Verifying takes: what is right passes, and every kind of contradiction is found and named."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quest.data.store import TakeStore
from quest.data.verify import Check, check_truth, check_view, has_sensed_depth, verify_store, verify_take
from quest.types import Clip, Take, View
from tests.synthetic import make_take

MIRROR = np.diag([-1.0, 1, 1, 1])


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=24, views=2, entities=3, name="panels")


def with_view(take: Take, change: Callable[[View], View], number: int = 1) -> Take:
    views = list(take.views)
    views[number] = change(views[number])
    return replace(take, views=tuple(views))


def with_info(take: Take, **fields) -> Take:
    return replace(take, info=replace(take.info, **fields))


def edited(array: np.ndarray | None, at, value) -> np.ndarray:
    changed = np.array(array)
    changed[at] = value
    return changed


def failed(take: Take, folder: Path) -> dict[str, str]:
    """Messages of the failed checks of a take that went through a store."""
    store = TakeStore(folder)
    store.write(take)
    report = verify_take(store, take.info.name)
    assert report.passed == (not report.message())
    return {check.name: str(check) for check in report.checks if not check.passed}


def bad(checks: Iterable[Check]) -> set[str]:
    return {check.name for check in checks if not check.passed}


def test_a_right_take_passes(take: Take, tmp_path: Path):
    assert failed(take, tmp_path) == {}
    report = verify_take(TakeStore(tmp_path), "panels")
    assert (report.frames, report.views) == (24, 2)
    assert len([check for check in report.checks if check.name == "reprojection"]) == 2
    worst = report.worst("reprojection")
    assert worst is not None
    assert worst.worst < 1e-3
    assert json.loads(json.dumps(asdict(report)))["checks"][0]["name"] == "hash"


@pytest.mark.parametrize("frames", [1, 2, 62])
def test_short_and_long_takes_pass(frames: int, tmp_path: Path):
    assert failed(make_take(frames=frames, views=1, entities=1, size=(32, 32)), tmp_path) == {}


def test_the_made_up_take_moves_and_is_the_same_every_time():
    take, again, other = (make_take(frames=24, hinges=True, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(take.views[0].clip.rgb, again.views[0].clip.rgb)
    assert (take.views[0].clip.rgb != other.views[0].clip.rgb).any()
    assert (take.point_world[:8] == take.point_world[0]).all()
    np.testing.assert_allclose(take.joint_position[0], 0, atol=1e-9)
    assert take.moved[take.tracked].all()
    assert not take.moved[-2], "the hinge of a door rests"
    visible = np.concatenate([view.visible[:, take.tracked] for view in take.views])
    assert 0.5 < visible.mean() < 1


def with_clip(take: Take, change: Callable[[Clip], dict[str, Any]]) -> Take:
    return with_view(take, lambda view: replace(view, clip=replace(view.clip, **change(view.clip))))


def stopped_clock(take: Take) -> Take:
    stamp_s = edited(take.stamp_s, 7, take.stamp_s[6])
    views = tuple(replace(view, clip=replace(view.clip, stamp_s=stamp_s)) for view in take.views)
    return replace(take, stamp_s=stamp_s, views=views)


WRONG: dict[str, tuple[Callable[[Take], Take], str, str]] = {
    "shifted pixels": (lambda t: with_view(t, lambda v: replace(v, uv_px=v.uv_px + np.float32(0.4))),
                       "reprojection", "0.5657 px, at most 0.5 px (view 1, frame"),
    "a jumping point": (lambda t: replace(t, point_world=edited(t.point_world, (20, 2), t.point_world[20, 2] + 0.01)),
                        "rigid in link", "frame 20, link_2/rim"),
    "half a joint": (lambda t: replace(t, joint_position=t.joint_position / 2, joint_velocity=t.joint_velocity / 2),
                     "moves on joint", "joint 1 (joint_1)"),
    "a turned axis": (lambda t: replace(t, joint_axis=np.roll(t.joint_axis, 1, axis=-1)), "moves on joint", "joint"),
    "wrong flow": (lambda t: replace(t, flow_world=t.flow_world[::-1].copy()), "flow", "m, at most 1e-05 m"),
    "velocity per frame": (lambda t: replace(t, joint_velocity=t.joint_velocity / 30), "velocity", "joint"),
    "unseen": (lambda t: with_view(t, lambda v: replace(v, visible=edited(v.visible, (slice(0, 5), 0), False))),
               "visibility", "%, at most 0.5 % (view 1, first frame 0, link_0/handle)"),
    "through a wall": (lambda t: with_clip(t, lambda c: {"depth_m": edited(c.depth_m, slice(10, 14), 0.5)}),
                       "visibility", "first frame 10"),
    "a strange mask": (lambda t: with_view(t, lambda v: replace(v, entity_id=edited(v.entity_id, (3, 0, 0), 2))),
                       "masks", "masks 1, at most 0 (view 1"),
    "no such entity": (lambda t: with_view(t, lambda v: replace(v, entity_id=edited(v.entity_id, (3, 0, 0), 9))),
                       "masks", "masks 1, at most 0 (view 1"),
    "not a number": (lambda t: replace(t, joint_velocity=edited(t.joint_velocity, (4, 1), np.nan)),
                     "finite", "finite 1, at most 0 (joint_velocity)"),
    "a stopped clock": (stopped_clock, "stamps", "after frame 6"),
    "a mirrored camera": (lambda t: with_clip(t, lambda c: {"cam_from_world": MIRROR @ c.cam_from_world}),
                          "camera poses", "view 1, frame 0"),
    "a stretched link": (lambda t: replace(t, link_pose=edited(t.link_pose, (5, 1, 0, 0), 1.01)),
                         "link poses", "frame 5"),
    "no such link": (lambda t: with_info(t, entities=(replace(t.info.entities[0], link=7), *t.info.entities[1:])),
                     "indices", "link_0/handle is on link 7 of 3"),
}  # fmt: skip


@pytest.mark.parametrize("how", WRONG)
def test_contradictions_are_found(how: str, take: Take, tmp_path: Path):
    change, name, said = WRONG[how]
    found = failed(change(take), tmp_path)
    assert said in found[name]
    assert "hash" not in found


def test_hash_and_torn_takes(take: Take, tmp_path: Path):
    store = TakeStore(tmp_path)
    for name in ("altered", "torn", "whole"):
        store.write(with_info(take, name=name))
    header = store.path("altered") / "zarr.json"
    header.write_text(header.read_text().replace('"Panels"', '"Doors"'))
    (store.path("torn") / "zarr.json").unlink()
    told = []
    report = verify_store(store, report=told.append)
    assert [take.name for take in report.takes] == [take.name for take in told] == ["altered", "torn", "whole"]
    assert [take.name for take in report.failed] == ["altered", "torn"]
    assert "hash" in report.takes[0].message()
    assert "zarr.json" in report.takes[1].message()
    assert report.takes[2].message() == ""
    assert not report.passed
    worst = report.worst("hash")
    assert worst is not None
    assert worst[0] == "altered"
    assert report.worst("fish") is None


def test_take_that_cannot_even_be_built(take: Take, tmp_path: Path):
    store = TakeStore(tmp_path)
    object.__setattr__(clip := replace(take.views[0].clip), "cam_from_world", np.full((24, 4, 4), np.nan))
    store.write(with_view(take, lambda v: replace(v, clip=clip), 0))
    report = verify_take(store, "panels")
    assert not report.passed
    assert "panels" in report.message()
    assert "finite" in report.message()


def test_joints_on_moving_links(take: Take):
    """A tray in a drawer: its axis moves with the drawer, and the drawer's motion is not the tray's."""
    pose, axis = take.link_pose.astype(np.float64), take.joint_axis.astype(np.float64)
    carried = pose[:, 0] @ np.linalg.inv(pose[0, 0])
    pose[:, 1] = carried @ pose[:, 1]
    axis[:, 1, :3] = np.einsum("tij,tj->ti", carried[:, :3, :3], axis[:, 1, :3]) + carried[:, :3, 3]
    axis[:, 1, 3:] = np.einsum("tij,tj->ti", carried[:, :3, :3], axis[:, 1, 3:])
    nested = replace(take, link_pose=pose.astype(np.float32), joint_axis=axis.astype(np.float32))
    assert "rigid in link" in bad(check_truth(nested))  # the points were left behind
    local = np.linalg.inv(take.link_pose[0, 1]) @ [*take.point_world[0, 1], 1]
    point = take.point_world.copy()
    point[:, 1] = (pose[:, 1] @ local)[:, :3]
    assert not {"rigid in link", "moves on joint"} & bad(check_truth(replace(nested, point_world=point)))
    still = replace(nested, point_world=point, joint_axis=take.joint_axis)
    assert "moves on joint" in bad(check_truth(still))


def test_moving_camera(take: Take):
    """Every frame has a pose of its own: the same pictures, if camera and things move together."""
    turn = np.linspace(0, 0.8, len(take))
    moved = np.tile(np.eye(4), (len(take), 1, 1))
    moved[:, :3, :3] = Rotation.from_euler("z", turn[:, None]).as_matrix()
    moved[:, :3, 3] = turn[:, None] * [0.3, -0.2, 0.5]
    view = take.views[0]
    point = np.einsum("tij,tej->tei", moved[:, :3, :3], take.point_world) + moved[:, None, :3, 3]
    following = replace(view.clip, cam_from_world=view.clip.cam_from_world @ np.linalg.inv(moved))
    truth = replace(take, point_world=point.astype(np.float32))
    assert not bad(check_view(truth, replace(view, clip=following), 0))
    assert "reprojection" in bad(check_view(truth, view, 0))


def test_sensed_depth_is_forgiven_what_a_sensor_does(take: Take):
    rng = np.random.default_rng(0)

    def sensed(view: View) -> View:
        depth = view.clip.depth_m
        assert depth is not None
        noisy = depth + 0.01 * depth**2 * rng.standard_normal(depth.shape).astype(np.float32)
        noisy[rng.random(depth.shape) < 0.1] = 0
        return replace(view, clip=replace(view.clip, depth_m=noisy.astype(np.float32)))

    noisy = with_view(take, sensed, 0)
    told = with_info(noisy, provenance={"sensor": {"depth": {"baseline_m": 0.05}, "rgb_noise": 0.01}})
    colours_only = with_info(noisy, provenance={"sensor": {"depth": None, "rgb_noise": 0.01}})
    assert has_sensed_depth(told.info)
    assert not has_sensed_depth(colours_only.info)
    for candidate, passes in ((told, True), (colours_only, False)):
        assert ("visibility" not in bad(check_view(candidate, candidate.views[0], 0))) == passes
    hidden = with_view(told, lambda v: replace(v, link_id=np.zeros_like(v.link_id)), 0)
    assert "visibility" in bad(check_view(hidden, hidden.views[0], 0))


def test_without_depth_links_decide(take: Take):
    bare = with_view(take, lambda v: replace(v, clip=replace(v.clip, depth_m=None)), 0)
    assert not bad(check_view(bare, bare.views[0], 0))
    ghost = with_view(bare, lambda v: replace(v, link_id=np.zeros_like(v.link_id)), 0)
    assert "visibility" in bad(check_view(ghost, ghost.views[0], 0))


def test_entities_fixed_in_the_base(take: Take):
    entities = (replace(take.info.entities[0], joint=-1), *take.info.entities[1:])
    assert not bad(check_truth(with_info(take, entities=entities)))


def test_points_behind_the_camera(take: Take):
    view = take.views[0]
    uv = np.full_like(view.uv_px, np.nan)
    away = replace(view.clip, cam_from_world=np.diag([-1.0, 1, -1, 1]) @ view.clip.cam_from_world)
    behind = replace(view, clip=away, uv_px=uv, visible=np.zeros_like(view.visible))
    assert not {"reprojection", "visibility"} & bad(check_view(take, behind, 0))
    assert "reprojection" in bad(check_view(take, replace(view, uv_px=uv), 0))
