"""What pulls: that it holds what it shall, keeps out of what it shall not touch, and comes and goes in time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from quest.errors import ConfigError, ObjectError
from quest.sim.annotate import entity_points
from quest.sim.articulation import apply
from quest.sim.cameras import sample_cameras
from quest.sim.gripper import GRIPPER_PARTS, gripper_tool, plan_gripper, sample_gripper_surfaces
from quest.sim.hand import (
    SKIN_TONES,
    Hand,
    MeshPart,
    hand_scale,
    plan_hand,
    sample_hand_build,
    sample_hand_look,
    sample_skin,
)
from quest.sim.hand_shape import (
    BONES_M,
    FOREARM_M,
    FOREARM_SECTIONS_M,
    GRIPS,
    HandBuild,
    bone_balls,
    elbow_direction,
    folds,
    hand_targets,
    palm_balls,
    pose_hand,
    rounded,
    tube_of_sections,
)
from quest.sim.motion import HOLD_FRAMES, MotionStyle, motion_script
from quest.sim.objects import SimObject, load_object
from quest.sim.procedural import make_object
from quest.sim.props import Occluder, Prop
from quest.sim.pull import ObjectSamples, Puller, Task, search_grasp
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings
from quest.sim.suites import find_suites
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, HANDLE, TRAY, Box, Link, write_object

MARGIN = (20, 12)
SHARE = 70
NOWHERE = np.zeros((0, 3))
BUILD = HandBuild(scale=1.0, side=1, thickness=1.0, curl=0.5)
PALM = next(i for i, part in enumerate(GRIPPER_PARTS) if part.material == "shell" and part.kind == "box")
PADS = [i for i, part in enumerate(GRIPPER_PARTS) if part.material == "rubber" and part.side]
HAND_PALM = 0
PULLERS = pytest.mark.parametrize("noun", ["gripper", "hand"])


def pull(noun: str, task: Task, rng: np.random.Generator, eyes: np.ndarray = NOWHERE) -> Puller:
    return plan_gripper(task, rng) if noun == "gripper" else plan_hand(task, rng, eyes)


def plan(
    noun: str, sim_object: SimObject, *joints: int, seed: int = 0, eyes: np.ndarray = NOWHERE
) -> tuple[Puller, np.ndarray]:
    """What pulls, with the poses of the bodies, of a script of its margins."""
    style = MotionStyle(margin=MARGIN)
    rng = np.random.default_rng(seed)
    script = motion_script(sim_object.articulation, joints, rng, frames_per_joint=SHARE, style=style)
    task = Task(sim_object, script, joints, MARGIN, SHARE)
    return pull(noun, task, rng, eyes), task.poses


def plan_a_hand(sim_object: SimObject, *joints: int, seed: int = 0, eyes: np.ndarray = NOWHERE) -> Hand:
    hand, _ = plan("hand", sim_object, *joints, seed=seed, eyes=eyes)
    assert isinstance(hand, Hand)
    return hand


def held(sim_object: SimObject, label: str) -> int:
    """Joint of the only entity of a label."""
    (joint,) = {e.joint for e in sim_object.entities if e.label == label}
    return joint


def world_from_part(puller: Puller) -> np.ndarray:
    """Pose of every part at every frame."""
    frames = range(len(puller.parts[0].world_from_shape))  # type: ignore[attr-defined]
    return np.stack([[part.pose(t) for part in puller.parts] for t in frames])


def half_m(gripper: Puller, part: int) -> np.ndarray:
    occluder = gripper.parts[part]
    assert isinstance(occluder, Occluder)
    return occluder.shape.half_m


def corners(gripper: Puller, part: int, frame: int) -> np.ndarray:
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    return apply(gripper.parts[part].pose(frame), signs * half_m(gripper, part))


def of_hand(hand: Puller) -> list[MeshPart]:
    """Palm, bones and nails, without the arm."""
    arm = len(tube_of_sections(FOREARM_SECTIONS_M).vertices)
    parts = [part for part in hand.parts if isinstance(part, MeshPart)]
    return parts[: next(n for n, part in enumerate(parts) if len(part.mesh.vertices) == arm)]


def fingertips(hand: Hand) -> np.ndarray:
    """World points of thumb and fingers at every frame."""
    bones = [part for part in of_hand(hand)[1:] if part.surface == hand.parts[HAND_PALM].surface]
    assert len(bones) == 15
    ends = hand.build.scale * BONES_M[:, 2, None] * [0.0, 0.0, 1.0]
    tips = [
        b.world_from_shape[:, :3, :3] @ p + b.world_from_shape[:, :3, 3] for b, p in zip(bones[2::3], ends, strict=True)
    ]
    return np.stack(tips, axis=1)


def meets(puller: Puller, points: np.ndarray, frame: int, *, margin_m: float = 0.002) -> int:
    """Points that lie inside a gripper's parts, or within the hulls of a hand's palm and bones."""
    found = 0
    for part in of_hand(puller) if isinstance(puller, Hand) else puller.parts:
        local = apply(np.linalg.inv(part.pose(frame)), points)
        if isinstance(part, Occluder):
            inside = (np.abs(local) < part.shape.half_m - margin_m).all(axis=1)
        else:
            assert isinstance(part, MeshPart)
            local = local[np.linalg.norm(local, axis=1) < 0.25]
            sides = ConvexHull(part.mesh.vertices).equations
            inside = (local @ sides[:, :3].T + sides[:, 3] < -margin_m).all(axis=1)
        found += int(inside.sum())
    return found


def lowest_m(puller: Puller, frame: int) -> float:
    if isinstance(puller, Hand):
        return min(apply(part.pose(frame), part.mesh.vertices)[:, 2].min() for part in puller.parts)
    return min(corners(puller, p, frame)[:, 2].min() for p in range(len(puller.parts)))


def middle(puller: Puller) -> np.ndarray:
    """Between the pads, or between the fingertips, at every frame."""
    if isinstance(puller, Hand):
        return fingertips(puller).mean(axis=1)
    return world_from_part(puller)[:, PADS][..., :3, 3].mean(axis=1)


def opened(puller: Puller) -> np.ndarray:
    """From pad to pad, or from the thumb to the index, at every frame."""
    one, other = (
        fingertips(puller)[:, :2] if isinstance(puller, Hand) else world_from_part(puller)[:, PADS][..., :3, 3]
    ).swapaxes(0, 1)
    return np.linalg.norm(one - other, axis=1)


@PULLERS
@pytest.mark.parametrize("seed", range(3))
def test_it_is_fixed_in_the_link_that_it_holds_and_meets_nothing_else(chest: SimObject, noun: str, seed: int) -> None:
    puller, poses = plan(noun, chest, 0, 1, seed=seed)
    assert all(isinstance(part, Prop) for part in puller.parts)
    assert [name for name, _, _ in puller.grasps] == [e.name for e in chest.entities]
    parts = world_from_part(puller)[:, : len(of_hand(puller)) if isinstance(puller, Hand) else None]
    points = entity_points(chest.entities, poses)
    for joint, (_, first, end) in enumerate(puller.grasps):
        assert (first, end) == (joint * SHARE + (HOLD_FRAMES if joint == 0 else 0) + 19, (joint + 1) * SHARE - 12)
        local = np.linalg.inv(poses[first:end, None, 1 + joint]) @ parts[first:end]
        np.testing.assert_allclose(local, np.tile(local[0], (end - first, 1, 1, 1)), atol=1e-9)
        assert np.ptp(parts[first:end, 0, 0, 3]) > 0.1
        tips = fingertips(puller) if isinstance(puller, Hand) else parts[:, PADS][..., :3, 3]
        away = np.linalg.norm(tips[first:end] - points[first:end, joint, None], axis=2)
        assert away.min(axis=1).max() < 0.04
    samples = ObjectSamples(chest.articulation)
    front = chest.articulation.world_points(chest.articulation.rest)[:, 0].max()
    for t in range(0, len(poses), 9 if noun == "hand" else 4):
        points, area_m2 = samples.world(poses[t])
        met = meets(puller, points, t)
        if isinstance(puller, Hand):
            assert met * 1e4 * area_m2[0] < 5 * puller.build.scale**2, (t, met)
            assert lowest_m(puller, t) > -0.01
        else:
            assert met <= 2
            assert lowest_m(puller, t) > -1e-3
            assert corners(puller, PALM, t)[:, 0].min() > front - 1e-3


@PULLERS
def test_it_comes_opens_and_goes(chest: SimObject, noun: str) -> None:
    puller, poses = plan(noun, chest, 1)
    ((name, first, end),) = puller.grasps
    (entity,) = [e for e in chest.entities if e.name == name]
    away = np.linalg.norm(middle(puller) - entity_points([entity], poses)[:, 0], axis=1)
    assert away[:5].min() > 0.25
    assert away[-1] > 0.15
    width = opened(puller)
    np.testing.assert_allclose(width[first:end], width[first], atol=1e-9)
    assert min(width[first - 8], width[-1]) > width[first] + (0.012 if noun == "hand" else 0.015)
    parts = world_from_part(puller)
    assert np.linalg.norm(np.diff(middle(puller), axis=0), axis=1).max() < 0.15  # nothing jumps
    assert np.linalg.norm(np.diff(parts[..., :3, 3], axis=0), axis=-1).max() < 0.2
    turns = np.einsum("tpij,tpij->tp", parts[1:, :, :3, :3], parts[:-1, :, :3, :3])
    assert turns.min() > 1 + 2 * np.cos(np.deg2rad(40))
    np.testing.assert_allclose(np.linalg.det(parts[..., :3, :3]), 1, atol=1e-9)


def test_a_gripper_comes_and_goes_in_straight_lines_with_the_handle_between_its_pads(chest: SimObject) -> None:
    gripper, poses = plan("gripper", chest, 0)
    ((_, first, end),) = gripper.grasps
    path = middle(gripper)
    coming, going = (np.linalg.norm(path - path[t], axis=1) for t in (first, end - 1))
    assert (np.diff(coming[: first + 1]) <= 1e-9).all()
    assert (np.diff(going[end - 1 :]) >= -1e-9).all()
    for straight in (path[first - 9 : first], path[end + 3 : end + 6]):
        np.testing.assert_allclose(straight[:, 1:], straight[:1, 1:] + np.zeros((len(straight), 1)), atol=1e-6)
    assert not meets(gripper, entity_points(chest.entities[:1], poses)[:8, 0], 0)
    parts = [np.asarray(chest.articulation.parts[i].surface.vertices) for i in chest.entities[0].parts]
    bar = apply(poses[first, 1], np.concatenate(parts))
    gap = opened(gripper)[first] - 2 * half_m(gripper, PADS[0])[1]
    assert gap == pytest.approx(np.ptp(bar[:, 2]), abs=1e-3)
    assert abs(gripper.parts[PADS[0]].pose(first)[2, 1]) > 0.99  # across the bar, which lies along y
    assert bar[:, 2].min() - 1e-3 < path[first, 2] < bar[:, 2].max() + 1e-3
    assert bar[:, 0].min() < path[first, 0] < bar[:, 0].max() + 0.02


def test_nothing_jumps_on_the_way_from_one_handle_to_the_next() -> None:
    cabinet = make_object("cabinet", 3)
    parts = world_from_part(plan_a_hand(cabinet, *cabinet.movable[:2], seed=1))
    turns = np.einsum("tpij,tpij->tp", parts[1:, :, :3, :3], parts[:-1, :, :3, :3])
    assert turns.min() > 1 + 2 * np.cos(np.deg2rad(60))
    assert np.linalg.norm(np.diff(parts[..., :3, 3], axis=0), axis=-1).max() < 0.3


def test_grips_by_label(tmp_path: Path) -> None:
    bar = replace(HANDLE, size=(0.012, 0.2, 0.012), centre=(0.265, 0, 0))
    short = replace(bar, size=(0.03, 0.02, 0.02), centre=(0.235, 0, 0))
    for name, boxes, label, grip in (
        ("bar", (DRAWER.boxes[0], bar), "handle", "hook"),
        ("short", (DRAWER.boxes[0], short), "handle", "pinch"),
        ("plain", DRAWER.boxes[:1], "front", "touch"),
    ):
        thing = load_object(write_object(tmp_path / name, CARCASS, replace(DRAWER, boxes=boxes)))
        assert plan_a_hand(thing, held(thing, label)).grips == (grip,)


def test_a_front_is_touched_and_a_thin_edge_is_pinched(tmp_path: Path) -> None:
    plain = load_object(write_object(tmp_path / "plain", CARCASS, replace(DRAWER, boxes=DRAWER.boxes[:1])))
    gripper, _ = plan("gripper", plain, held(plain, "front"))
    ((_, first, end),) = gripper.grasps
    np.testing.assert_allclose(opened(gripper)[first:end], 2 * half_m(gripper, PADS[0])[1], atol=1e-9)  # closed
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
    gripper, poses = plan("gripper", boxed, held(boxed, "rim"))
    ((_, first, end),) = gripper.grasps
    scale = gripper_tool(boxed.half_diagonal_m).scale
    assert 0 < opened(gripper)[first] - scale * 0.006 < 0.03
    assert abs(gripper.parts[PADS[0]].pose(first)[2, 1]) > 0.9  # one finger above, one below
    samples = ObjectSamples(boxed.articulation)
    assert max(meets(gripper, samples.world(poses[t])[0], t) for t in range(first, end)) <= 3


@PULLERS
def test_seeds(chest: SimObject, noun: str) -> None:
    (one, _), (same, _), (other, _) = (plan(noun, chest, 0, seed=seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(world_from_part(one), world_from_part(same))
    assert [part.surface for part in one.parts] == [part.surface for part in same.parts]  # type: ignore[attr-defined]
    assert (world_from_part(one)[:, :3] != world_from_part(other)[:, :3]).any()
    if noun == "hand":
        assert isinstance(one, Hand)
        assert isinstance(other, Hand)
        assert one.build != other.build
        for mine, its in zip(one.parts, same.parts, strict=True):
            np.testing.assert_array_equal(mine.mesh.vertices, its.mesh.vertices)  # type: ignore[attr-defined]


def test_looks_and_builds_differ() -> None:
    rngs = [np.random.default_rng(seed) for seed in range(200)]
    assert len({sample_gripper_surfaces(rng)["shell"].colour for rng in rngs[:20]}) == 20
    looks = [sample_hand_look(rng) for rng in rngs[:60]]
    assert {look.glove for look in looks} == {True, False}
    assert {look.sleeve_start_m > FOREARM_M for look in looks} == {True, False}
    tones = np.array([sample_skin(rng).colour for rng in rngs]).mean(axis=1)
    assert tones.min() < 0.2
    assert tones.max() > 0.8
    assert len(SKIN_TONES) == 10
    builds = [sample_hand_build(0.6, rng, glove=False) for rng in rngs]
    assert {build.side for build in builds} == {-1, 1}
    assert all(0.91 < build.scale < 1.14 for build in builds)


def test_the_arm_keeps_clear_of_the_camera(chest: SimObject) -> None:
    eye = np.array([[1.6, 0.1, 0.9]])
    angles = []
    for seed in range(6):
        hand = plan_a_hand(chest, 0, seed=seed, eyes=eye)
        ((_, first, end),) = hand.grasps
        wrist, elbow = (hand.parts[n].world_from_shape[first:end, :3, 3] for n in (HAND_PALM, -1))
        arm, sight = elbow - wrist, eye - wrist
        cos = np.sum(arm * sight, axis=1) / np.linalg.norm(arm, axis=1) / np.linalg.norm(sight, axis=1)
        angles.append(np.rad2deg(np.arccos(cos)).min())
    assert np.median(angles) > 20


def test_bones_keep_their_lengths_and_fingertips_meet_their_targets() -> None:
    opening = np.linspace(0.02, 0.048, 5)
    for grip in GRIPS:
        for side in (1, -1):
            build = replace(BUILD, side=side, scale=1.1)
            targets = hand_targets(build, grip, 0.02, opening)
            pose = pose_hand(build, targets)
            lengths = np.linalg.norm(np.diff(pose.joints, axis=2), axis=3)
            np.testing.assert_allclose(lengths, np.broadcast_to(1.1 * BONES_M, lengths.shape), atol=1e-9)
            wanted = 1.1 * targets.tips * [side, 1, 1]
            missed = np.linalg.norm(pose.joints[:, :, 3] - wanted, axis=2)
            assert missed.max() < 0.012, (grip, missed.max())
            np.testing.assert_allclose(np.linalg.norm(pose.across, axis=2), 1)
    right, left = (pose_hand(replace(BUILD, side=s), hand_targets(BUILD, "hook", 0.02, opening)) for s in (1, -1))
    np.testing.assert_allclose(left.joints, right.joints * [-1, 1, 1], atol=1e-12)


def test_wrists_bend_only_so_far_and_elbows_stay_above_the_floor() -> None:
    rng = np.random.default_rng(0)
    wrist = rng.uniform([0, -1, 0.1], [1, 1, 1.5], (200, 3))
    straight = rng.normal(size=(200, 3))
    straight /= np.linalg.norm(straight, axis=1, keepdims=True)
    shoulder = rng.uniform([0.5, -1, 0.5], [2, 1, 1.5], (200, 3))
    found = elbow_direction(wrist, straight, shoulder, BUILD)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    bent = np.rad2deg(np.arccos(np.clip(np.sum(found * straight, axis=1), -1, 1)))
    high = wrist[:, 2] > 0.4
    assert bent[high].max() < 62.1
    assert (wrist + FOREARM_M * found)[:, 2].min() > -0.01


def test_meshes_look_outwards() -> None:
    tube = tube_of_sections(FOREARM_SECTIONS_M, folds(len(FOREARM_SECTIONS_M), 0.002, np.random.default_rng(0)))
    for mesh in (rounded(palm_balls(BUILD)[0]), rounded(bone_balls(1, 2, 0.0158, 1.0)), tube):
        corner = mesh.vertices[mesh.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(normal, axis=1)
        smooth = mesh.normals[mesh.faces].mean(axis=1)
        assert (np.sum(normal * smooth, axis=1)[area > 1e-9] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


def test_small_things_meet_a_small_gripper_and_a_smaller_hand(tmp_path: Path, chest: SimObject) -> None:
    assert gripper_tool(chest.half_diagonal_m).scale == hand_scale(0.6) == 1
    assert hand_scale(0.01) == 0.6
    tiny = load_object(write_object(tmp_path / "tiny", CARCASS, DRAWER, category="Eyeglasses"))
    gripper, _ = plan("gripper", tiny, 0)
    palm = half_m(gripper, PALM)
    np.testing.assert_allclose(palm, gripper_tool(tiny.half_diagonal_m).scale * np.array(GRIPPER_PARTS[PALM].half_m))
    assert palm.max() < 0.03
    glasses = make_object("eyeglasses", 4)
    assert 0.5 < plan_a_hand(glasses, int(glasses.movable[0])).build.scale < 0.8


@PULLERS
def test_what_cannot_be_held(tmp_path: Path, chest: SimObject, noun: str) -> None:
    closed = replace(
        DOOR, boxes=(Box("door_panel-9", (0.02, 0.58, 0.5), (0.01, 0.3, 0)), replace(HANDLE, centre=(0.04, 0.5, 0)))
    )
    sim_object = load_object(write_object(tmp_path / "behind", CARCASS, closed, TRAY))
    tray = next(e.joint for e in sim_object.entities if "tray" in e.name)
    with pytest.raises(
        ObjectError, match=rf"tray.*within a {noun}'s reach.*blocked by the object itself.*leave the {noun} away"
    ):
        plan(noun, sim_object, tray)
    still = np.tile(chest.articulation.rest, (SHARE, 1))
    moving = still + np.linspace([0.0, 0.0], [0.2, 0.0], SHARE)
    for joints, script, margin, message in (
        ((0,), still, (2, 12), f"{noun}: expected margins of at least"),
        ((0, 1), still, MARGIN, "expected a script of 140 frames, got 70"),
        ((0,), moving, MARGIN, "joint_drawer to move within frames 28 to 58 only"),
    ):
        with pytest.raises(ConfigError, match=message):
            pull(noun, Task(chest, script, joints, margin, SHARE), np.random.default_rng(0))


def test_settings_and_the_suite() -> None:
    with pytest.raises(ConfigError, match="a gripper or a hand"):
        TakeSettings(hand=True, gripper=True)
    with pytest.raises(ConfigError, match="a hand pulls one joint after the other"):
        TakeSettings(hand=True, frames=500)
    (suite,) = find_suites("hands")
    assert suite.settings.pulled
    assert suite.settings.hand
    assert suite.settings.cameras.motion == "handheld"
    assert TakeSettings(hand=False).digest == TakeSettings().digest != TakeSettings(hand=True).digest


@pytest.mark.partnet
@pytest.mark.parametrize("name", ["44817", "7263", "10849", "26657"])
def test_handles_of_real_objects_are_pinched_from_the_front(partnet_root: Path, name: str) -> None:
    sim_object = load_object(partnet_root / name)
    samples, tool = ObjectSamples(sim_object.articulation), gripper_tool(sim_object.half_diagonal_m)
    for joint in sim_object.movable[:2]:
        path = np.linspace(0, 1, 5)[:, None] * sim_object.articulation.joints[joint].opening()
        positions = sim_object.articulation.rest + path * (np.arange(len(sim_object.articulation.joints)) == joint)
        motion = sim_object.articulation.poses(positions)
        entity = next(e for e in sim_object.entities if e.joint == joint)
        grasp, cost = search_grasp(tool, sim_object, entity, samples, motion)
        assert cost < 0.5
        assert 0.002 < grasp.width_m < 0.07
        assert (motion[0, entity.body] @ grasp.body_from_gripper)[0, 2] > 0.7


@PULLERS
@pytest.mark.render
def test_it_is_drawn_and_hides_a_part_of_the_handle(chest: SimObject, renderer: Renderer, noun: str) -> None:
    puller, poses = plan(noun, chest, 0)
    ((_, first, _),) = puller.grasps
    points = np.concatenate([chest.articulation.world_points(chest.articulation.rest), [[0.6, 0, 0.4]]])
    stage = renderer.stage(chest, sample_cameras(points, 2, np.random.default_rng(2), width=96, height=96))
    actors = [part.add(stage.scene) for part in puller.parts]
    seen = []
    for t in (0, first):
        stage.pose(poses[first])
        for part, actor in zip(puller.parts, actors, strict=True):
            part.place(actor, t)
        seen.append(stage.pictures())
    for away, here in zip(*seen, strict=True):
        covered = (here.depth_m > 0) & (here.body == 0) & (away.body > 0)  # the object's pixels that it turns to 0
        assert covered.any()
        assert (here.entity[covered] == 0).all()
        assert (here.depth_m[covered] < away.depth_m[covered] + 1e-3).all()
        assert (here.entity == 1).sum() < (away.entity == 1).sum()
