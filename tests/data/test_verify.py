"""Verifying takes: what is right passes, and every kind of contradiction is found and named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.store import TakeStore
from quest.data.verify import check_truth, check_view, has_sensed_depth, verify_store, verify_take
from quest.types import Take, View
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=24, views=2, entities=3, name="panels")


def with_view(take: Take, change: Callable[[View], View], number: int = 1) -> Take:
    views = list(take.views)
    views[number] = change(views[number])
    return replace(take, views=tuple(views))


def with_info(take: Take, **fields) -> Take:
    return replace(take, info=replace(take.info, **fields))


def edited(array: np.ndarray, at, value) -> np.ndarray:
    array = array.copy()
    array[at] = value
    return array


def failed(take: Take, folder: Path) -> dict[str, str]:
    """Messages of the failed checks of a take that went through a store."""
    store = TakeStore(folder)
    store.write(take)
    report = verify_take(store, take.info.name)
    assert report.passed == (not report.message())
    return {check.name: str(check) for check in report.checks if not check.passed}


def test_a_right_take_passes(take: Take, tmp_path: Path):
    assert failed(take, tmp_path) == {}
    report = verify_take(TakeStore(tmp_path), "panels")
    assert (report.frames, report.views) == (24, 2)
    assert len([check for check in report.checks if check.name == "reprojection"]) == 2
    worst = report.worst("reprojection")
    assert worst is not None
    assert worst.worst < 1e-3


@pytest.mark.parametrize("frames", [1, 2, 70])
def test_short_and_long_takes_pass(frames: int, tmp_path: Path):
    assert failed(make_take(frames=frames, views=1, entities=1), tmp_path) == {}


def shifted_pixel(take: Take) -> Take:
    return with_view(take, lambda v: replace(v, uv_px=v.uv_px + np.float32(0.4)))


def jumping_point(take: Take) -> Take:
    return replace(take, point_world=edited(take.point_world, (20, 2), take.point_world[20, 2] + 0.01))


def half_joint(take: Take) -> Take:
    return replace(take, joint_position=take.joint_position * 0.5, joint_velocity=take.joint_velocity * 0.5)


def turned_axis(take: Take) -> Take:
    return replace(take, joint_axis=np.roll(take.joint_axis, 1, axis=-1))


def wrong_flow(take: Take) -> Take:
    return replace(take, flow_world=take.flow_world[::-1].copy())


def velocity_per_frame(take: Take) -> Take:
    return replace(take, joint_velocity=take.joint_velocity / 30)


def unseen(take: Take) -> Take:
    return with_view(take, lambda v: replace(v, visible=edited(v.visible, (slice(0, 5), 0), False)))


def seen_through_the_wall(take: Take) -> Take:
    depth = lambda v: replace(v.clip, depth_m=edited(v.clip.depth_m, slice(10, 14), 0.5))  # noqa: E731
    return with_view(take, lambda v: replace(v, clip=depth(v)))


def strange_mask(take: Take) -> Take:
    return with_view(take, lambda v: replace(v, entity_id=edited(v.entity_id, (3, 0, 0), 2)))


def no_such_entity(take: Take) -> Take:
    return with_view(take, lambda v: replace(v, entity_id=edited(v.entity_id, (3, 0, 0), 9)))


def not_a_number(take: Take) -> Take:
    return replace(take, joint_velocity=edited(take.joint_velocity, (4, 1), np.nan))


def stopped_clock(take: Take) -> Take:
    stamp_s = edited(take.stamp_s, 7, take.stamp_s[6])
    views = tuple(replace(view, clip=replace(view.clip, stamp_s=stamp_s)) for view in take.views)
    return replace(take, stamp_s=stamp_s, views=views)


def mirrored_camera(take: Take) -> Take:
    mirror = np.diag([-1.0, 1, 1, 1])
    return with_view(take, lambda v: replace(v, clip=replace(v.clip, cam_from_world=mirror @ v.clip.cam_from_world)))


def stretched_link(take: Take) -> Take:
    return replace(take, link_pose=edited(take.link_pose, (5, 1, 0, 0), 1.01 * take.link_pose[5, 1, 0, 0]))


def no_such_link(take: Take) -> Take:
    entities = (replace(take.info.entities[0], link=7), *take.info.entities[1:])
    return with_info(take, entities=entities)


@pytest.mark.parametrize(
    ("change", "name", "said"),
    [
        (shifted_pixel, "reprojection", "0.5657 px, at most 0.5 px (view 1, frame"),
        (jumping_point, "rigid in link", "frame 20, link_2/rim"),
        (half_joint, "moves on joint", "joint 1 (joint_1)"),
        (turned_axis, "moves on joint", "joint"),
        (wrong_flow, "flow", "m, at most 1e-05 m"),
        (velocity_per_frame, "velocity", "joint"),
        (unseen, "visibility", "%, at most 0.5 % (view 1, first frame 0, link_0/handle)"),
        (seen_through_the_wall, "visibility", "first frame 10"),
        (strange_mask, "masks", "masks 1, at most 0 (view 1"),
        (no_such_entity, "masks", "masks 1, at most 0 (view 1"),
        (not_a_number, "finite", "finite 1, at most 0 (joint_velocity)"),
        (stopped_clock, "stamps", "after frame 6"),
        (mirrored_camera, "camera poses", "view 1, frame 0"),
        (stretched_link, "link poses", "frame 5"),
        (no_such_link, "indices", "link_0/handle is on link 7 of 3"),
    ],
)
def test_contradictions_are_found(change: Callable, name: str, said: str, take: Take, tmp_path: Path):
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
    checks = {check.name: check for check in check_truth(nested)}
    assert not checks["rigid in link"].passed  # the points were left behind
    local = np.linalg.inv(take.link_pose[0, 1]) @ [*take.point_world[0, 1], 1]
    point = take.point_world.copy()
    point[:, 1] = (pose[:, 1] @ local)[:, :3]
    checks = {check.name: check for check in check_truth(replace(nested, point_world=point))}
    assert checks["rigid in link"].passed
    assert checks["moves on joint"].passed
    still = replace(nested, point_world=point, joint_axis=take.joint_axis)
    assert not {check.name: check for check in check_truth(still)}["moves on joint"].passed


def test_moving_camera(take: Take):
    """Every frame has a pose of its own: the same pictures, if camera and things move together."""
    turn = np.linspace(0, 0.8, len(take))
    moved = np.tile(np.eye(4), (len(take), 1, 1))
    moved[:, 0, 0], moved[:, 0, 1], moved[:, 1, 0], moved[:, 1, 1] = (
        np.cos(turn),
        -np.sin(turn),
        np.sin(turn),
        np.cos(turn),
    )
    moved[:, :3, 3] = turn[:, None] * [0.3, -0.2, 0.5]
    view = take.views[0]
    point = np.einsum("tij,tej->tei", moved[:, :3, :3], take.point_world) + moved[:, None, :3, 3]
    following = replace(view.clip, cam_from_world=view.clip.cam_from_world @ np.linalg.inv(moved))
    truth = replace(take, point_world=point.astype(np.float32))
    assert all(check.passed for check in check_view(truth, replace(view, clip=following), 0))
    checks = {check.name: check for check in check_view(truth, view, 0)}
    assert not checks["reprojection"].passed


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
        checks = {check.name: check for check in check_view(candidate, candidate.views[0], 0)}
        assert checks["visibility"].passed == passes
    hidden = with_view(told, lambda v: replace(v, link_id=np.zeros_like(v.link_id)), 0)
    assert not {c.name: c for c in check_view(hidden, hidden.views[0], 0)}["visibility"].passed


def test_without_depth_links_decide(take: Take):
    bare = with_view(take, lambda v: replace(v, clip=replace(v.clip, depth_m=None)), 0)
    assert all(check.passed for check in check_view(bare, bare.views[0], 0))
    ghost = with_view(bare, lambda v: replace(v, link_id=np.zeros_like(v.link_id)), 0)
    assert not {c.name: c for c in check_view(ghost, ghost.views[0], 0)}["visibility"].passed


def test_entities_fixed_in_the_base(take: Take):
    entities = (replace(take.info.entities[0], joint=-1), *take.info.entities[1:])
    assert all(check.passed for check in check_truth(with_info(take, entities=entities)))


def test_points_behind_the_camera(take: Take):
    view = take.views[0]
    uv = np.full_like(view.uv_px, np.nan)
    away = replace(view.clip, cam_from_world=np.diag([-1.0, 1, -1, 1]) @ view.clip.cam_from_world)
    behind = replace(view, clip=away, uv_px=uv, visible=np.zeros_like(view.visible))
    checks = {check.name: check for check in check_view(take, behind, 0)}
    assert checks["reprojection"].passed
    assert checks["visibility"].passed
    assert not {c.name: c for c in check_view(take, replace(view, uv_px=uv), 0)}["reprojection"].passed


def test_reports_are_json(take: Take, tmp_path: Path):
    from dataclasses import asdict

    store = TakeStore(tmp_path)
    store.write(take)
    assert json.loads(json.dumps(asdict(verify_take(store, "panels"))))["checks"][0]["name"] == "hash"
