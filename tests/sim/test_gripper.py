"""The gripper: that it holds what it shall, keeps out of what it shall not touch, and comes and goes in time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.cameras import sample_cameras
from quest.sim.gripper import (
    GRIPPER_PARTS,
    Gripper,
    ObjectSamples,
    find_grasp,
    gripper_scale,
    plan_gripper,
    sample_gripper_surfaces,
)
from quest.sim.motion import HOLD_FRAMES, MotionStyle, motion_script
from quest.sim.objects import SimObject, load_object
from quest.sim.props import Prop
from quest.sim.renderer import Renderer
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, HANDLE, TRAY, Box, Link, write_object

MARGIN = (20, 12)
SHARE = 70
PALM = next(i for i, part in enumerate(GRIPPER_PARTS) if part.material == "shell" and part.kind == "box")
PADS = [i for i, part in enumerate(GRIPPER_PARTS) if part.material == "rubber" and part.side]


def plan(sim_object: SimObject, *joints: int, seed: int = 0) -> tuple[Gripper, np.ndarray]:
    """A gripper with the poses of the bodies, of a script of its margins."""
    style = MotionStyle(margin=MARGIN)
    rng = np.random.default_rng(seed)
    script = motion_script(sim_object.articulation, joints, rng, frames_per_joint=SHARE, style=style)
    gripper = plan_gripper(sim_object, script, joints, margin=MARGIN, frames_per_joint=SHARE, rng=rng)
    return gripper, sim_object.articulation.poses(script)


def held(sim_object: SimObject, label: str) -> int:
    """Joint of the only entity of a label."""
    (joint,) = {e.joint for e in sim_object.entities if e.label == label}
    return joint


def corners(gripper: Gripper, part: int, frame: int) -> np.ndarray:
    shape = gripper.parts[part].shape
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    return apply(gripper.pose(frame)[part], signs * shape.half_m)


def meets(gripper: Gripper, points: np.ndarray, frame: int, *, margin_m: float = 0.002) -> int:
    """Points that lie inside the gripper's parts."""
    inside = np.zeros(len(points), bool)
    for part, pose in zip(gripper.parts, gripper.pose(frame), strict=True):
        local = apply(np.linalg.inv(pose), points)
        inside |= (np.abs(local) < part.shape.half_m - margin_m).all(axis=1)
    return int(inside.sum())


def world_from_part(gripper: Gripper) -> np.ndarray:
    """Pose of every part at every frame."""
    return np.stack([part.world_from_shape for part in gripper.parts], axis=1)


def middle_of_pads(gripper: Gripper) -> np.ndarray:
    return world_from_part(gripper)[:, PADS][..., :3, 3].mean(axis=1)


def test_it_is_fixed_in_the_link_that_it_holds(chest: SimObject) -> None:
    for seed in range(3):
        gripper, poses = plan(chest, 0, 1, seed=seed)
        assert isinstance(gripper, Prop)
        assert [name for name, _, _ in gripper.grasps] == [e.name for e in chest.entities]
        for joint, (_, first, end) in enumerate(gripper.grasps):
            assert (first, end) == (joint * SHARE + (HOLD_FRAMES if joint == 0 else 0) + 19, (joint + 1) * SHARE - 12)
            local = np.linalg.inv(poses[first:end, None, 1 + joint]) @ world_from_part(gripper)[first:end]
            np.testing.assert_allclose(local, np.tile(local[0], (end - first, 1, 1, 1)), atol=1e-9)
            assert np.ptp(world_from_part(gripper)[first:end, PALM, 0, 3]) > 0.1


def test_the_handle_is_between_its_pads(chest: SimObject) -> None:
    gripper, poses = plan(chest, 0)
    ((_, first, _),) = gripper.grasps
    entity = chest.entities[0]
    bar = apply(poses[first, 1], np.concatenate([chest.articulation.parts[i].surface.vertices for i in entity.parts]))
    thick = np.ptp(bar[:, 2])
    pads = gripper.pose(first)[PADS]
    gap = np.linalg.norm(pads[0, :3, 3] - pads[1, :3, 3]) - 2 * gripper.parts[PADS[0]].shape.half_m[1]
    assert gap == pytest.approx(thick, abs=1e-3)
    axis = pads[0, :3, 1]
    assert abs(axis[2]) > 0.99  # across the bar, which lies along y
    assert bar[:, 2].min() - 1e-3 < middle_of_pads(gripper)[first, 2] < bar[:, 2].max() + 1e-3
    assert bar[:, 0].min() < middle_of_pads(gripper)[first, 0] < bar[:, 0].max() + 0.02
    one, other = (world_from_part(gripper)[:, pad, :3, 3] for pad in PADS)
    opened = np.linalg.norm(one - other, axis=1)
    assert opened[first - 8] > opened[first] + 0.015
    assert opened[-1] > opened[first] + 0.015


def test_it_stays_before_the_front_and_out_of_the_object(chest: SimObject) -> None:
    gripper, poses = plan(chest, 0, 1)
    samples = ObjectSamples(chest.articulation)
    front = chest.articulation.world_points(chest.articulation.rest)[:, 0].max()
    for t in range(0, len(poses), 4):
        assert corners(gripper, PALM, t)[:, 0].min() > front - 1e-3
        assert meets(gripper, samples.world(poses[t]), t) <= 2
        assert min(corners(gripper, p, t)[:, 2].min() for p in range(len(gripper.parts))) > -1e-3


def test_it_comes_and_goes_in_straight_lines(chest: SimObject) -> None:
    gripper, poses = plan(chest, 1)
    ((name, first, end),) = gripper.grasps
    (entity,) = [e for e in chest.entities if e.name == name]
    handle = np.array([apply(pose[entity.body], entity.point) for pose in poses])
    path = middle_of_pads(gripper)
    coming, going = (np.linalg.norm(path - path[t], axis=1) for t in (first, end - 1))
    assert (np.diff(coming[: first + 1]) <= 1e-9).all()
    assert (np.diff(going[end - 1 :]) >= -1e-9).all()
    assert coming[:5].min() > 0.25
    assert going[-1] > 0.15
    for straight in (path[first - 9 : first], path[end + 3 : end + 6]):
        np.testing.assert_allclose(straight[:, 1:], straight[:1, 1:] + np.zeros((len(straight), 1)), atol=1e-6)
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert step.max() < 0.15  # nothing jumps
    assert not meets(gripper, handle[:8], 0)


def test_seeds(chest: SimObject) -> None:
    (one, _), (same, _), (other, _) = (plan(chest, 0, seed=seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(world_from_part(one), world_from_part(same))
    assert [p.surface for p in one.parts] == [p.surface for p in same.parts]
    assert (world_from_part(one) != world_from_part(other)).any()
    for t in range(SHARE):
        np.testing.assert_array_equal(one.pose(t), world_from_part(one)[t])
    looks = [sample_gripper_surfaces(np.random.default_rng(s))["shell"].colour for s in range(20)]
    assert len(set(looks)) == 20


def test_a_front_is_touched_and_a_thin_edge_is_pinched(tmp_path: Path) -> None:
    plain = load_object(write_object(tmp_path / "plain", CARCASS, replace(DRAWER, boxes=DRAWER.boxes[:1])))
    gripper, _ = plan(plain, held(plain, "front"))
    ((_, first, end),) = gripper.grasps
    pads = world_from_part(gripper)[:, PADS]
    gap = np.linalg.norm(pads[first:end, 0, :3, 3] - pads[first:end, 1, :3, 3], axis=1)
    np.testing.assert_allclose(gap, 2 * gripper.parts[PADS[0]].shape.half_m[1], atol=1e-9)  # closed
    tip = corners(gripper, PADS[0], first)[:, 0].min()
    front = plain.articulation.world_points(plain.articulation.rest)
    assert 0 <= tip - front[front[:, 2] > 0.5 * front[:, 2].max(), 0].max() + 0.01 < 0.02
    # A lid that stands over its box: an edge with air on both sides.
    base = Link("body", (Box("box-1", (0.4, 0.5, 0.2), (0, 0, 0.1)),))
    lid = Link(
        "lid",
        (Box("lid-2", (0.48, 0.5, 0.015), (0.24, 0, 0)),),
        kind="revolute",
        origin=(-0.2, 0, 0.22),
        axis=(0, -1, 0),
        limits=(0, 1.5),
    )
    boxed = load_object(write_object(tmp_path / "box", base, lid, category="Box"))
    gripper, poses = plan(boxed, held(boxed, "rim"))
    ((_, first, end),) = gripper.grasps
    pads = gripper.pose(first)[PADS][:, :3, 3]
    scale = gripper_scale(boxed.half_diagonal_m)
    assert 0 < np.linalg.norm(pads[0] - pads[1]) - scale * 0.006 < 0.03
    assert abs(gripper.pose(first)[PADS[0], 2, 1]) > 0.9  # one finger above, one below
    assert max(meets(gripper, ObjectSamples(boxed.articulation).world(poses[t]), t) for t in range(first, end)) <= 3


def test_small_things_meet_a_small_gripper(tmp_path: Path, chest: SimObject) -> None:
    assert gripper_scale(chest.half_diagonal_m) == 1
    scaled = load_object(write_object(tmp_path / "tiny", CARCASS, DRAWER, category="Eyeglasses"))
    gripper, _ = plan(scaled, 0)
    palm = gripper.parts[PALM].shape.half_m
    np.testing.assert_allclose(palm, gripper_scale(scaled.half_diagonal_m) * np.array(GRIPPER_PARTS[PALM].half_m))
    assert palm.max() < 0.03


def test_what_cannot_be_held(tmp_path: Path, chest: SimObject) -> None:
    closed = replace(
        DOOR, boxes=(Box("door_panel-9", (0.02, 0.58, 0.5), (0.01, 0.3, 0)), replace(HANDLE, centre=(0.04, 0.5, 0)))
    )
    sim_object = load_object(write_object(tmp_path / "behind", CARCASS, closed, TRAY))
    tray = next(e.joint for e in sim_object.entities if "tray" in e.name)
    with pytest.raises(ObjectError, match=r"tray.*blocked by the object itself"):
        plan(sim_object, tray)
    script = np.tile(chest.articulation.rest, (SHARE, 1))
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match="margins of at least"):
        plan_gripper(chest, script, (0,), margin=(2, 12), frames_per_joint=SHARE, rng=rng)
    with pytest.raises(ConfigError, match="expected a script of 140 frames, got 70"):
        plan_gripper(chest, script, (0, 1), margin=MARGIN, frames_per_joint=SHARE, rng=rng)
    script[:, 0] += np.linspace(0, 0.2, SHARE)
    with pytest.raises(ConfigError, match="joint_drawer to move within frames 28 to 58 only"):
        plan_gripper(chest, script, (0,), margin=MARGIN, frames_per_joint=SHARE, rng=rng)


@pytest.mark.partnet
@pytest.mark.parametrize("name", ["44817", "7263", "10849", "26657"])
def test_handles_of_real_objects_are_pinched_from_the_front(partnet_root: Path, name: str) -> None:
    sim_object = load_object(partnet_root / name)
    samples = ObjectSamples(sim_object.articulation)
    for joint in sim_object.movable[:2]:
        path = np.linspace(0, 1, 5)[:, None] * sim_object.articulation.joints[joint].opening()
        positions = sim_object.articulation.rest + path * (np.arange(len(sim_object.articulation.joints)) == joint)
        motion = sim_object.articulation.poses(positions)
        entity = next(e for e in sim_object.entities if e.joint == joint)
        grasp, cost = find_grasp(sim_object, entity, samples, motion)
        assert cost < 0.5
        assert 0.002 < grasp.width_m < 0.07
        assert (motion[0, entity.body] @ grasp.body_from_gripper)[0, 2] > 0.7


@pytest.mark.render
def test_it_is_drawn_and_hides_a_part_of_the_handle(chest: SimObject, renderer: Renderer) -> None:
    gripper, poses = plan(chest, 0)
    ((_, first, _),) = gripper.grasps
    points = np.concatenate([chest.articulation.world_points(chest.articulation.rest), [[0.6, 0, 0.4]]])
    cameras = sample_cameras(points, 2, np.random.default_rng(2), width=96, height=96)
    actors: list = []
    stage = renderer.stage(chest, cameras)
    stage.dress(lambda scene, bodies: actors.extend(gripper.add(scene)))
    seen = []
    for t in (0, first):
        stage.pose(poses[first])
        gripper.place(actors, t)
        seen.append(stage.pictures())
    for away, here in zip(*seen, strict=True):
        before = (here.depth_m > 0) & (here.body == 0)
        assert 0.005 < before.mean() < 0.5
        nearer = before & (away.body > 0)
        assert nearer.any()
        assert (here.depth_m[nearer] < away.depth_m[nearer] + 1e-3).all()
        handle = [(p.entity == 1).sum() for p in (away, here)]
        assert handle[1] < handle[0]
