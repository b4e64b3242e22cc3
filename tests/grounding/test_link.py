"""Evidence for one link and the joint that its points share."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quest.grounding import Joint, JointKind, fit_joint
from quest.grounding.link import Tracks, carried, evidence, fit_link, way_length
from tests.grounding.scenes import door, drawers, noisy, opened, two_doors
from tests.grounding.tracks import angle_deg

SIGMA = 0.002


def observed(tracks: np.ndarray, seed: int, *, outliers: float = 0.0) -> Tracks:
    seen = noisy(tracks, seed, outliers=outliers)
    return Tracks(seen, [fit_joint(seen[:, k], SIGMA) for k in range(seen.shape[1])], SIGMA)


def test_motion_carries_points_like_a_rigid_body():
    axis, origin = np.array([0.0, 0.6, 0.8]), np.array([0.1, 0.2, 0.3])
    place = np.array([0.5, 0.0, 0.0])
    rest = origin + place - (place @ axis) * axis
    joint = Joint(JointKind.REVOLUTE, axis, origin, rest, 0.0, 1.0, np.zeros((6, 6)), SIGMA, 9)
    q = np.array([0.0, 0.5, -1.0])
    points = np.random.default_rng(0).normal(size=(3, 4, 3))
    moved = carried(joint, points, q)
    for t in range(3):
        turn = Rotation.from_rotvec(q[t] * axis)
        np.testing.assert_allclose(moved[t], origin + turn.apply(points[t] - origin), atol=1e-12)
    np.testing.assert_allclose(carried(joint, joint.at(q)[:, None], -q)[:, 0], [rest] * 3, atol=1e-12)
    assert way_length(joint) == pytest.approx(joint.radius)


def test_evidence_tells_one_link_from_two():
    one, other = opened(0.3, 10, 60), opened(0.3, 65, 115)
    same = evidence(observed(door(0, opened(1.2, 10, 100))[0], 0, outliers=0.1))
    assert min(same[0, 1], same[1, 0]) > 20
    for tracks in (drawers(0, one, other), two_doors(0, 4 * one, 4 * one)):
        apart = evidence(observed(tracks, 0, outliers=0.1))
        assert max(apart[0, 1], apart[1, 0]) < -20


def test_standing_still_together_is_no_evidence():
    """Hundreds of frames in which neither moves do not outweigh those in which only one does."""
    tracks = drawers(1, opened(0.3, 10, 60), opened(0.3, 65, 115))
    tracks = np.concatenate([tracks, np.repeat(tracks[-1:], 400, axis=0)])
    told = evidence(observed(tracks, 1))
    assert max(told[0, 1], told[1, 0]) < 0


def test_the_shared_joint_of_a_short_arc_is_better_than_each_own():
    """Two points of a rigid body show its rotation, which one point of a short arc hardly does."""
    shared, own = [], []
    for seed in range(8):
        truth, axis = door(seed, opened(0.5, 10, 100))
        tracks = observed(truth, seed)
        joints = fit_link(tracks)
        assert joints is not None
        shared.append(angle_deg(joints[0].axis, axis))
        own.append(angle_deg(tracks.joints[0].axis, axis))
        assert angle_deg(joints[0].axis, joints[1].axis) < 1e-3
        assert joints[0].axis_sigma_rad < tracks.joints[0].axis_sigma_rad
    assert np.median(shared) < np.median(own)


@pytest.mark.parametrize("kind", [JointKind.REVOLUTE, JointKind.PRISMATIC])
def test_the_covariance_is_that_of_repeated_fits(kind: JointKind):
    q = opened(0.3, 10, 100)
    truth = door(5, 4 * q)[0] if kind is JointKind.REVOLUTE else drawers(5, q, q)
    gaps, claimed = [], []
    for seed in range(25):
        joints = fit_link(observed(truth, seed))
        assert joints is not None
        joint = joints[1]
        assert joint.kind is kind
        at = joint.locate(truth[[0, 60, -1], 1])
        gaps.append(np.linalg.norm(joint.at(at) - truth[[0, 60, -1], 1], axis=1) / 2**0.5)
        claimed.append(joint.spread(at))
    ratio = np.sqrt(np.square(gaps).mean(axis=0)) / np.median(claimed, axis=0)
    assert (ratio > 0.2).all()
    assert (ratio < 2).all()


def test_few_frames_give_no_joint():
    tracks = observed(door(0, opened(1.2, 10, 100))[0], 0)
    hidden = tracks.points.copy()
    hidden[3:, 1] = np.nan
    assert fit_link(Tracks(hidden, tracks.joints, SIGMA)) is None
    assert evidence(Tracks(hidden, tracks.joints, SIGMA))[0, 1] == -np.inf
