"""The hand: that it holds what it shall, bends as hands do, keeps out of the object, and comes and goes in time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.cameras import sample_cameras
from quest.sim.grasp import ObjectSamples
from quest.sim.hand import SKIN_TONES, Hand, MeshPart, hand_scale, plan_hand, sample_hand_look, sample_skin
from quest.sim.hand_mesh import FOREARM_SECTIONS_M, bone_balls, folds, palm_balls, rounded, tube_of_sections
from quest.sim.hand_pose import (
    BONES_M,
    FOREARM_M,
    GRIPS,
    HandBuild,
    elbow_direction,
    hand_targets,
    pose_hand,
)
from quest.sim.motion import HOLD_FRAMES, MotionStyle, motion_script
from quest.sim.objects import SimObject, load_object
from quest.sim.procedural import make_object
from quest.sim.props import Prop
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings
from quest.sim.suites import find_suites
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, HANDLE, TRAY, Box, write_object

MARGIN = (20, 12)
SHARE = 70
NOWHERE = np.zeros((0, 3))
BUILD = HandBuild(scale=1.0, side=1, thickness=1.0, curl=0.5)
PALM = 0


def plan(sim_object: SimObject, *joints: int, seed: int = 0, eyes: np.ndarray = NOWHERE) -> tuple[Hand, np.ndarray]:
    """A hand with the poses of the bodies, of a script of its margins."""
    style = MotionStyle(margin=MARGIN)
    rng = np.random.default_rng(seed)
    script = motion_script(sim_object.articulation, joints, rng, frames_per_joint=SHARE, style=style)
    hand = plan_hand(sim_object, script, joints, margin=MARGIN, frames_per_joint=SHARE, eyes=eyes, rng=rng)
    return hand, sim_object.articulation.poses(script)


def of_hand(hand: Hand) -> list[MeshPart]:
    """Palm, bones and nails, without the arm."""
    first = next(n for n, part in enumerate(hand.parts) if len(part.mesh.vertices) == arm_size())
    return list(hand.parts[:first])


def arm_size() -> int:
    return len(tube_of_sections(FOREARM_SECTIONS_M).vertices)


def fingertips(hand: Hand) -> np.ndarray:
    """World points of thumb and fingers at every frame."""
    bones = [part for part in of_hand(hand)[1:] if part.surface == hand.parts[PALM].surface]
    assert len(bones) == 15
    ends = hand.build.scale * BONES_M[:, 2]
    local = np.array([[0.0, 0.0, end] for end in ends])
    return np.stack(
        [
            part.world_from_shape[:, :3, :3] @ p + part.world_from_shape[:, :3, 3]
            for part, p in zip(bones[2::3], local, strict=True)
        ],
        axis=1,
    )


def inside(hand: Hand, points: np.ndarray, frame: int, *, margin_m: float = 0.002) -> int:
    """Points that lie within the hulls of palm and bones."""
    near = points[np.linalg.norm(points - hand.parts[PALM].world_from_shape[frame, :3, 3], axis=1) < 0.25]
    found = 0
    for part in of_hand(hand):
        sides = ConvexHull(part.mesh.vertices).equations
        local = apply(np.linalg.inv(part.world_from_shape[frame]), near)
        found += int((local @ sides[:, :3].T + sides[:, 3] < -margin_m).all(axis=1).sum())
    return found


def test_it_is_at_the_entity_while_it_holds_it_and_moves_with_its_link(chest: SimObject) -> None:
    for seed in range(3):
        hand, poses = plan(chest, 0, 1, seed=seed)
        assert isinstance(hand, Prop)
        assert [name for name, _, _ in hand.grasps] == [e.name for e in chest.entities]
        tips = fingertips(hand)
        for joint, (name, first, end) in enumerate(hand.grasps):
            assert (first, end) == (joint * SHARE + (HOLD_FRAMES if joint == 0 else 0) + 19, (joint + 1) * SHARE - 12)
            for part in of_hand(hand):
                local = np.linalg.inv(poses[first:end, 1 + joint]) @ part.world_from_shape[first:end]
                np.testing.assert_allclose(local, np.tile(local[0], (end - first, 1, 1)), atol=1e-9)
            (entity,) = [e for e in chest.entities if e.name == name]
            handle = np.array([apply(pose[entity.body], entity.point) for pose in poses[first:end]])
            assert np.linalg.norm(tips[first:end] - handle[:, None], axis=2).min(axis=1).max() < 0.04


def test_it_is_open_earlier_and_later_and_gone_at_the_ends(chest: SimObject) -> None:
    hand, poses = plan(chest, 1)
    ((name, first, end),) = hand.grasps
    (entity,) = [e for e in chest.entities if e.name == name]
    tips = fingertips(hand)
    opened = np.linalg.norm(tips[:, 0] - tips[:, 1], axis=1)  # from the thumb to the index
    np.testing.assert_allclose(opened[first:end], opened[first], atol=1e-9)
    assert opened[first - 8] > opened[first] + 0.012
    assert opened[-1] > opened[first] + 0.012
    place = np.array([apply(pose[entity.body], entity.point) for pose in poses])
    away = np.linalg.norm(tips.mean(axis=1) - place, axis=1)
    assert away[:5].min() > 0.25
    assert away[-1] > 0.15
    assert np.linalg.norm(np.diff(tips, axis=0), axis=2).max() < 0.15  # nothing jumps
    for part in hand.parts:
        assert np.linalg.norm(np.diff(part.world_from_shape[:, :3, 3], axis=0), axis=1).max() < 0.2
        turns = np.einsum("tij,tij->t", part.world_from_shape[1:, :3, :3], part.world_from_shape[:-1, :3, :3])
        assert turns.min() > 1 + 2 * np.cos(np.deg2rad(40))
        np.testing.assert_allclose(np.linalg.det(part.world_from_shape[:, :3, :3]), 1, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_it_stays_out_of_the_object_and_above_the_floor(chest: SimObject, seed: int) -> None:
    hand, poses = plan(chest, 0, 1, seed=seed)
    samples = ObjectSamples(chest.articulation)
    area_cm2 = 1e4 * samples.area_m2()[0]
    for t in range(0, len(poses), 9):
        met = inside(hand, samples.world(poses[t]), t) * area_cm2
        assert met < 5 * hand.build.scale**2, (t, met)
        assert min(apply(part.world_from_shape[t], part.mesh.vertices)[:, 2].min() for part in hand.parts) > -0.01


def test_nothing_jumps_on_the_way_from_one_handle_to_the_next() -> None:
    cabinet = make_object("cabinet", 3)
    hand, _ = plan(cabinet, *cabinet.movable[:2], seed=1)
    for part in hand.parts:
        turns = np.einsum("tij,tij->t", part.world_from_shape[1:, :3, :3], part.world_from_shape[:-1, :3, :3])
        assert turns.min() > 1 + 2 * np.cos(np.deg2rad(60))
        assert np.linalg.norm(np.diff(part.world_from_shape[:, :3, 3], axis=0), axis=1).max() < 0.3


def test_grips_by_label(tmp_path: Path) -> None:
    bar = replace(HANDLE, size=(0.012, 0.2, 0.012), centre=(0.265, 0, 0))
    long = load_object(write_object(tmp_path / "bar", CARCASS, replace(DRAWER, boxes=(DRAWER.boxes[0], bar))))
    hand, _ = plan(long, 0)
    assert hand.grips == ("hook",)
    small = load_object(
        write_object(
            tmp_path / "short",
            CARCASS,
            replace(DRAWER, boxes=(DRAWER.boxes[0], replace(bar, size=(0.03, 0.02, 0.02), centre=(0.235, 0, 0)))),
        )
    )
    assert plan(small, 0)[0].grips == ("pinch",)
    plain = load_object(write_object(tmp_path / "plain", CARCASS, replace(DRAWER, boxes=DRAWER.boxes[:1])))
    hand, _ = plan(plain, next(e.joint for e in plain.entities if e.label == "front"))
    assert hand.grips == ("touch",)


def test_seeds(chest: SimObject) -> None:
    (one, _), (same, _), (other, _) = (plan(chest, 0, seed=seed) for seed in (4, 4, 5))
    for t in range(0, SHARE, 7):
        np.testing.assert_array_equal(one.pose(t), same.pose(t))
    for mine, its in zip(one.parts, same.parts, strict=True):
        assert mine.surface == its.surface
        np.testing.assert_array_equal(mine.mesh.vertices, its.mesh.vertices)
    assert one.build != other.build
    hands = [plan(chest, 0, seed=seed)[0].build for seed in range(12)]
    assert {build.side for build in hands} == {-1, 1}
    assert all(0.91 < build.scale < 1.14 for build in hands)
    looks = [sample_hand_look(np.random.default_rng(seed)) for seed in range(60)]
    assert {look.glove for look in looks} == {True, False}
    assert {look.sleeve_start_m > FOREARM_M for look in looks} == {True, False}
    tones = np.array([sample_skin(np.random.default_rng(seed)).colour for seed in range(200)]).mean(axis=1)
    assert tones.min() < 0.2
    assert tones.max() > 0.8
    assert len(SKIN_TONES) == 10


def test_the_arm_keeps_clear_of_the_camera(chest: SimObject) -> None:
    eye = np.array([[1.6, 0.1, 0.9]])
    angles = []
    for seed in range(6):
        hand, _ = plan(chest, 0, seed=seed, eyes=eye)
        ((_, first, end),) = hand.grasps
        wrist, elbow = (hand.parts[n].world_from_shape[first:end, :3, 3] for n in (PALM, -1))
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
    for mesh in (rounded(palm_balls(1, 1.0)), rounded(bone_balls(1, 2, 0.0158, 1.0)), tube):
        corner = mesh.vertices[mesh.faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(normal, axis=1)
        smooth = mesh.normals[mesh.faces].mean(axis=1)
        assert (np.sum(normal * smooth, axis=1)[area > 1e-9] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


def test_small_things_meet_a_smaller_hand(tmp_path: Path) -> None:
    assert hand_scale(0.6) == 1
    assert hand_scale(0.01) == 0.6
    glasses = make_object("eyeglasses", 4)
    hand, _ = plan(glasses, int(glasses.movable[0]))
    assert 0.5 < hand.build.scale < 0.8


def test_what_cannot_be_held_and_settings_that_cannot_be(tmp_path: Path, chest: SimObject) -> None:
    closed = replace(
        DOOR, boxes=(Box("door_panel-9", (0.02, 0.58, 0.5), (0.01, 0.3, 0)), replace(HANDLE, centre=(0.04, 0.5, 0)))
    )
    sim_object = load_object(write_object(tmp_path / "behind", CARCASS, closed, TRAY))
    tray = next(e.joint for e in sim_object.entities if "tray" in e.name)
    with pytest.raises(ObjectError, match=r"tray.*within a hand's reach.*leave the hand away"):
        plan(sim_object, tray)
    script = np.tile(chest.articulation.rest, (SHARE, 1))
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match="hand: expected margins of at least"):
        plan_hand(chest, script, (0,), margin=(2, 12), frames_per_joint=SHARE, eyes=NOWHERE, rng=rng)
    with pytest.raises(ConfigError, match="a gripper or a hand"):
        TakeSettings(hand=True, gripper=True)
    with pytest.raises(ConfigError, match="a hand pulls one joint after the other"):
        TakeSettings(hand=True, frames=500)


def test_the_suite() -> None:
    (suite,) = find_suites("hands")
    assert suite.settings.pulled
    assert suite.settings.hand
    assert suite.settings.cameras.motion == "handheld"
    assert TakeSettings(hand=False).digest == TakeSettings().digest != TakeSettings(hand=True).digest


@pytest.mark.render
def test_it_is_drawn_and_hides_a_part_of_the_handle(chest: SimObject, renderer: Renderer) -> None:
    hand, poses = plan(chest, 0)
    ((_, first, _),) = hand.grasps
    points = np.concatenate([chest.articulation.world_points(chest.articulation.rest), [[0.6, 0, 0.4]]])
    cameras = sample_cameras(points, 2, np.random.default_rng(2), width=96, height=96)
    actors: list = []
    stage = renderer.stage(chest, cameras)
    stage.dress(lambda scene, bodies: actors.extend(hand.add(scene)))
    seen = []
    for t in (0, first):
        stage.pose(poses[first])
        hand.place(actors, t)
        seen.append(stage.pictures())
    for away, here in zip(*seen, strict=True):
        covered = (here.depth_m > 0) & (here.body == 0) & (away.body > 0)  # the object's pixels that it turns to 0
        assert covered.any()
        assert (here.entity[covered] == 0).all()
        assert (here.depth_m[covered] < away.depth_m[covered] + 1e-3).all()
        assert (here.entity == 1).sum() < (away.entity == 1).sum()
