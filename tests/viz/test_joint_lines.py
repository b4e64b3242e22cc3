"""Lines of joints: through the entity's own points, over the range that was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.filter.joints import Joint, JointKind
from quest.track.state import StreamState
from quest.types import Joints, State, Tracks
from quest.viz.joint_lines import joint_lines, state_lines

FRAMES = 20


def tracks_of(kind: str, *, range_seen: tuple[float, float] = (-0.2, 1.1)) -> Tracks:
    """One query that goes over 0.1 to 0.9 of the range, beside the path that its joint was fitted to."""
    low, high = range_seen
    q = np.linspace(low + 0.1 * (high - low), high - 0.1 * (high - low), FRAMES)
    axis, origin = np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, 0.5])
    if kind == "revolute":
        point = origin + np.stack((0.4 * np.cos(q + 0.3), 0.4 * np.sin(q + 0.3), np.full(FRAMES, 0.7)), axis=1)
    else:
        point = origin + [0.1, 0.0, 0.0] + q[:, None] * axis
    joints = replace(
        Joints.unknown(FRAMES, 1), kind=(kind,), axis=axis[None].astype(np.float32),
        origin=origin[None].astype(np.float32), q_min_seen=np.array([low], np.float32),
        q_max_seen=np.array([high], np.float32), q=q[:, None].astype(np.float32),
    )  # fmt: skip
    return Tracks(
        names=("lid",), labels=(None,), uv_px=np.zeros((FRAMES, 1, 2), np.float32),
        point_world=point[:, None].astype(np.float32), confidence=np.ones((FRAMES, 1), np.float32),
        visible=np.ones((FRAMES, 1), bool), state=np.full((FRAMES, 1), "tracking"), stamp_s=np.arange(FRAMES) / 30,
        joints=joints,
    )  # fmt: skip


def test_an_arc_goes_through_the_points_about_the_axis():
    tracks = tracks_of("revolute")
    lines = joint_lines(tracks)[0]
    assert lines is not None
    assert lines.axis is not None
    np.testing.assert_allclose(np.linalg.norm(lines.path[:, :2] - [1, 2], axis=1), 0.4, atol=1e-5)
    np.testing.assert_allclose(lines.path[:, 2], 1.2, atol=1e-5)
    np.testing.assert_allclose(lines.axis[:, :2], [[1, 2], [1, 2]], atol=1e-5)
    np.testing.assert_allclose(lines.axis.mean(axis=0), [1, 2, 1.2], atol=1e-5)
    angle = np.arctan2(*(lines.path[[0, -1], :2] - [1, 2]).T[::-1])
    np.testing.assert_allclose(angle, [0.1, 1.4], atol=1e-5)
    gap = np.linalg.norm(tracks.point_world - lines.path[None], axis=-1).min(axis=1)
    assert gap.max() < 0.01
    np.testing.assert_allclose([arm[1] for arm in lines.arms], lines.path[[0, -1]])


def test_a_line_goes_through_the_points():
    lines = joint_lines(tracks_of("prismatic"))[0]
    assert lines is not None
    assert lines.axis is None
    np.testing.assert_allclose(lines.path[[0, -1]], [[1.1, 2, 0.3], [1.1, 2, 1.6]], atol=1e-5)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_few_wild_points_move_no_line(kind: str):
    tracks = tracks_of(kind)
    point, visible = tracks.point_world.copy(), tracks.visible.copy()
    point[3], point[5], point[8:10], visible[8:10] = 9.0, np.nan, -4.0, False
    wild, clean = joint_lines(replace(tracks, point_world=point, visible=visible))[0], joint_lines(tracks)[0]
    assert wild is not None
    assert clean is not None
    np.testing.assert_allclose(wild.path, clean.path, atol=1e-2)


def test_what_does_not_move_or_is_not_known_has_no_lines():
    tracks = tracks_of("prismatic")
    assert tracks.joints is not None
    for kind in ("static", "unknown"):
        assert joint_lines(replace(tracks, joints=replace(tracks.joints, kind=(kind,)))) == (None,)
    assert joint_lines(replace(tracks, joints=None)) == (None,)
    nowhere = np.full_like(tracks.point_world, np.nan)
    assert joint_lines(replace(tracks, point_world=nowhere)) == (None,)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_stream_draws_what_the_whole_track_draws(kind: str):
    tracks = tracks_of(kind)
    joints, t = tracks.joints, 7
    assert joints is not None
    rest = tracks.point_world[0, 0].astype(np.float64)
    seen = float(joints.q_min_seen[0]), float(joints.q_max_seen[0])
    known = Joint(JointKind(kind), joints.axis[0], joints.origin[0], rest, *seen, np.eye(4))
    state = StreamState(
        names=("lid",), labels=(None,), uv_px=tracks.uv_px[t], point_world=tracks.point_world[t],
        confidence=tracks.confidence[t], visible=tracks.visible[t], state=(State.TRACKING,), stamp_s=0.0,
        has_depth=True, query=(0,), joint=(known,), q=joints.q[t], lost_log_odds=np.zeros(1, np.float32),
        lost_p=np.zeros(1, np.float32), alarm=(None,),
    )  # fmt: skip
    whole, now = joint_lines(tracks)[0], state_lines(state)[0]
    assert whole is not None
    assert now is not None
    np.testing.assert_allclose(now.path, whole.path, atol=1e-5)
    if whole.axis is not None and now.axis is not None:
        np.testing.assert_allclose(now.axis, whole.axis, atol=1e-5)
    for unknown in (replace(state, joint=(None,)), replace(state, q=np.full(1, np.nan, np.float32))):
        assert state_lines(unknown) == (None,)
    assert state_lines(replace(state, joint=(replace(known, kind=JointKind.STATIC),))) == (None,)
