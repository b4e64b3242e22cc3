"""Takes: ground truth agrees with the pictures, the same seed gives the same arrays, a run goes on where it stopped."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.cli import main as program
from quest.data.store import TakeStore
from quest.data.take_format import hash_take
from quest.errors import ConfigError, ObjectError
from quest.geometry import lift_depth, project, transform
from quest.sim.annotate import VISIBLE_WITHIN
from quest.sim.generate import generate_take
from quest.sim.motion import FRAMES_PER_S, HOLD_FRAMES
from quest.sim.objects import SimObject, load_object
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings
from quest.sim.staging import choose_joints
from quest.sim.suites import find_suites
from quest.types import Take, View
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, TRAY, write_cabinet, write_object

SMALL = ("--views", "1", "--size", "48", "--frames-per-joint", "24", "--every", "8")


def true_pixels_and_depths(take: Take, view: View, t: int) -> tuple[np.ndarray, np.ndarray]:
    pose = torch.from_numpy(view.clip.cam_from_world[t])
    in_camera = transform(pose, torch.from_numpy(take.point_world[t].astype(np.float64)))
    return project(in_camera, view.clip.camera).numpy(), in_camera[:, 2].numpy()


@pytest.mark.render
def test_what_is_in_a_take(take: Take) -> None:
    info = take.info
    assert info.name == "cabinet-L2-s000003"
    assert [e.label for e in info.entities] == ["handle", "rim", "hinge"]
    assert sorted(info.moved_joints) == [0, 1]
    assert info.provenance["commit"] == "none"
    assert set(info.provenance) == {"commit", "settings"}
    assert take.moved[take.tracked].all()
    assert len(take) == 2 * 24 / 3
    np.testing.assert_allclose(np.diff(take.stamp_s), 3 / FRAMES_PER_S)
    assert info.frames_per_s == pytest.approx(FRAMES_PER_S / 3)
    for view in take.views:
        assert view.clip.rgb.shape == (16, 96, 96, 3)
        assert view.clip.rgb.std() > 5  # lit
        assert (view.clip.cam_from_world == view.clip.cam_from_world[0]).all()
        assert set(np.unique(view.link_id)) <= {0, 1, 2, 3}
        assert set(np.unique(view.entity_id)) <= {0, 1, 2}  # hinges have no mask
        np.testing.assert_array_equal(view.clip.stamp_s, take.stamp_s)
    assert not np.array_equal(take.views[0].clip.cam_from_world[0], take.views[1].clip.cam_from_world[0])


@pytest.mark.render
def test_nothing_moves_in_the_hold_and_then_one_joint_after_the_other(take: Take) -> None:
    hold = range(-(-HOLD_FRAMES // 3))  # frames 0, 3, 6 of the script
    for t in hold:
        np.testing.assert_array_equal(take.link_pose[t], take.link_pose[0])
        np.testing.assert_array_equal(take.point_world[t], take.point_world[0])
        for view in take.views:
            np.testing.assert_array_equal(view.clip.rgb[t], view.clip.rgb[0])
    first, second = take.info.moved_joints
    assert (take.joint_position[:8, second] == take.joint_position[0, second]).all()
    assert np.ptp(take.joint_position[8:, first]) < 1e-6
    assert (np.ptp(take.joint_position, axis=0) > 0.1).all()


@pytest.mark.render
def test_flow_velocity_and_axes_follow_from_the_rest(take: Take) -> None:
    np.testing.assert_allclose(take.flow_world[:-1], np.diff(take.point_world, axis=0), atol=1e-6)
    assert not take.flow_world[-1].any()
    # Over three frames the mean velocity is within reach of the velocities at both ends.
    mean = np.diff(take.joint_position, axis=0) / np.diff(take.stamp_s)[:, None]
    fastest = np.abs(take.joint_velocity).max(axis=0)
    assert (np.abs(mean).max(axis=0) <= 1.1 * fastest).all()
    assert (np.abs(mean).max(axis=0) >= 0.5 * fastest).all()
    np.testing.assert_allclose(np.linalg.norm(take.joint_axis[..., 3:], axis=-1), 1, atol=1e-6)
    # A slide moves its entity along its axis, a hinge keeps it at its distance from the axis.
    handle, rim = take.point_world[:, 0], take.point_world[:, 1]
    slide, turn = take.joint_axis[0, 0], take.joint_axis[0, 1]
    moved = take.joint_position[:, :1] - take.joint_position[:1, :1]
    np.testing.assert_allclose(handle - handle[0], moved * slide[3:], atol=1e-5)
    radius = np.linalg.norm(np.cross(rim - turn[:3], turn[3:]), axis=-1)
    np.testing.assert_allclose(radius, radius[0], atol=1e-5)


@pytest.mark.render
def test_visible_entities_are_where_the_picture_says(take: Take) -> None:
    unit = take.info.half_diagonal_m
    seen = 0
    for view in take.views:
        assert view.visible.any()
        depth_m = view.clip.depth_m
        assert depth_m is not None
        for t in range(len(take)):
            uv, z = true_pixels_and_depths(take, view, t)
            np.testing.assert_allclose(view.uv_px[t], uv, atol=1e-3)
            for e in np.flatnonzero(view.visible[t]):
                x, y = uv[e].astype(int)
                around = (t, slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2))
                own = view.link_id[around] == 1 + take.info.entities[e].link
                assert np.abs(depth_m[around][own] - z[e]).min() <= VISIBLE_WITHIN * unit
                seen += 1
                if take.info.entities[e].label == "handle":
                    assert (view.entity_id[around] == 1 + e).any()
    assert seen > len(take)


@pytest.mark.render
def test_lifted_depth_lies_on_the_link_that_the_label_names(take: Take, cabinet: SimObject) -> None:
    margin = 0.01 * cabinet.half_diagonal_m
    for view in take.views:
        assert view.clip.depth_m is not None
        world_from_cam = np.linalg.inv(view.clip.cam_from_world[0])
        for t in (0, len(take) // 2, len(take) - 1):
            in_camera = lift_depth(torch.from_numpy(view.clip.depth_m[t].astype(np.float64)), view.clip.camera)
            for link, points in enumerate(cabinet.articulation.body_points):
                pixels = in_camera[torch.from_numpy(view.link_id[t] == 1 + link)]
                if len(pixels) == 0:
                    continue
                link_from_cam = np.linalg.inv(take.link_pose[t, link].astype(np.float64)) @ world_from_cam
                on_link = transform(torch.from_numpy(link_from_cam), pixels).numpy()
                assert (on_link >= points.min(axis=0) - margin).all()
                assert (on_link <= points.max(axis=0) + margin).all()


@pytest.mark.render
def test_same_seed_same_take_other_seed_other_take(cabinet: SimObject, renderer: Renderer) -> None:
    settings = TakeSettings(views=2, size=48, every=8, frames_per_joint=24)
    first, again, other = (generate_take(cabinet, 1, seed, renderer=renderer, settings=settings) for seed in (5, 5, 6))
    assert hash_take(first) == hash_take(again)
    assert not np.array_equal(first.joint_position, other.joint_position)
    for a, b in zip(first.views, other.views, strict=True):
        assert not np.array_equal(a.clip.rgb, b.clip.rgb)
        assert not np.array_equal(a.uv_px, b.uv_px)


@pytest.mark.render
def test_in_a_fixed_scene_only_the_motion_is_of_the_take(cabinet: SimObject, renderer: Renderer) -> None:
    (suite,) = find_suites("published")
    settings = dataclasses.replace(suite.settings, size=48, every=8, frames_per_joint=24)
    one, other = (
        generate_take(cabinet, level, seed, renderer=renderer, settings=settings, suite=suite)
        for level, seed in ((1, 5), (2, 6))
    )
    assert len(one.views) == 3
    for a, b in zip(one.views, other.views, strict=True):
        assert a.clip.camera == b.clip.camera
        np.testing.assert_array_equal(a.clip.cam_from_world[0], b.clip.cam_from_world[0])
        np.testing.assert_array_equal(a.clip.rgb[0], b.clip.rgb[0])
    assert not np.array_equal(one.joint_position, other.joint_position[: len(one)])


@pytest.mark.render
def test_images_may_be_wider_than_high(cabinet: SimObject, renderer: Renderer) -> None:
    settings = TakeSettings(views=1, size=(64, 48), every=8, frames_per_joint=24)
    take = generate_take(cabinet, 1, 5, renderer=renderer, settings=settings)
    (view,) = take.views
    assert view.clip.depth_m is not None
    assert view.clip.rgb.shape == (len(take), 48, 64, 3)
    assert view.clip.depth_m.shape == view.link_id.shape == (len(take), 48, 64)
    _, depth = true_pixels_and_depths(take, view, 0)
    seen = view.visible[0]
    assert seen.any()
    x, y = view.uv_px[0, seen].astype(int).T
    np.testing.assert_allclose(view.clip.depth_m[0, y, x], depth[seen], atol=0.05)


def test_impossible_levels(cabinet: SimObject) -> None:
    for level in (0, 3):
        with pytest.raises(ObjectError, match=r"number of joints .* \(2\), got"):
            choose_joints(cabinet, level, np.random.default_rng(0))


def test_what_is_behind_a_door_moves_after_it(tmp_path: Path) -> None:
    thing = load_object(write_object(tmp_path / "cabinet", CARCASS, TRAY, DRAWER, DOOR))
    orders = [choose_joints(thing, 3, np.random.default_rng(seed)) for seed in range(10)]
    assert {order[-1] for order in orders} == {0}
    assert len(set(orders)) > 1
    assert all(0 not in choose_joints(thing, 2, np.random.default_rng(seed)) for seed in range(10))


@pytest.mark.parametrize(
    "wrong",
    [{"views": 0}, {"size": 8}, {"size": (64, 8)}, {"every": 0}, {"every": 9}, {"fixed_scene": True, "stretch": 1.2}],
)
def test_settings_out_of_range(wrong: dict) -> None:
    with pytest.raises(ConfigError):
        TakeSettings(**wrong)


@pytest.mark.render
def test_a_run_skips_what_is_there_and_what_is_impossible(
    tmp_path: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cabinet(tmp_path / "objects" / "cabinet")
    broken = write_cabinet(tmp_path / "objects" / "broken")
    (broken / "mobility.urdf").write_text("<robot")
    common = ["generate", "--out", str(tmp_path / "takes"), "--objects-root", str(tmp_path / "objects"), *SMALL]
    both = [*common, "--objects", "partnet:cabinet,broken", "--level", "1", "4"]
    assert program.main(both) == 0
    store = TakeStore(tmp_path / "takes")
    assert store.names() == ["cabinet-L1-s000000"]
    message = " ".join(capsys.readouterr().err.split())
    assert "skipped broken" in message
    assert "not a readable URDF" in message
    assert "skipped cabinet" in message
    assert "got 4" in message
    before = store.data_hash("cabinet-L1-s000000")
    command = store.infos()["cabinet-L1-s000000"].provenance["command"]
    assert command.startswith(f"quest generate --out {tmp_path / 'takes'} --objects partnet:cabinet,broken ")
    assert program.main([*both, "--takes-per-object", "2"]) == 0
    assert "1 there already" in " ".join(capsys.readouterr().err.split())
    assert TakeStore(tmp_path / "takes").names() == ["cabinet-L1-s000000", "cabinet-L1-s000001"]
    assert store.data_hash("cabinet-L1-s000000") == before
    assert program.main([*common, "--objects", "partnet:broken"]) == program.EXIT_ERROR
    assert "no planned take can be made (1 skipped)" in " ".join(capsys.readouterr().err.split())
