"""Lines of joints: through the entity's own points, over the range that was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.types import Joints, Tracks
from quest.viz.joint_lines import joint_lines

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
