"""What is seen of the front of a link, and what a query makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from quest.grounding import JointKind
from quest.grounding.hinge import Plane
from quest.track import TrackerConfig
from quest.track.expectation import BeliefRow
from quest.track.front import Front
from quest.track.grounded import Ground
from quest.track.saving import load, save
from quest.track.surface import plane_at

SIDE, FOCAL = 224, 112.0
CAMERA = np.zeros(3)
DOOR_AXIS, DOOR_ORIGIN = np.array([0.0, 1.0, 0.0]), np.array([-0.3, 0.0, 1.0])


def picture(normal: np.ndarray, through: np.ndarray, *, handle: bool = False) -> np.ndarray:
    """What every pixel shows of a plane, with a handle standing out at its middle."""
    u, v = np.meshgrid(np.arange(SIDE) + 0.5 - SIDE / 2, np.arange(SIDE) + 0.5 - SIDE / 2)
    ray = np.stack((u / FOCAL, v / FOCAL, np.ones_like(u)), axis=-1)
    depth = (normal @ through) / (ray @ normal)
    if handle:
        depth[100:124, 110:114] -= 0.04
    return (ray * depth[..., None]).astype(np.float32)


def pixel(place: np.ndarray) -> np.ndarray:
    return FOCAL * place[:2] / place[2] + SIDE / 2


@pytest.mark.parametrize("tilt", [0.0, 0.6, -1.0])
def test_the_plane_behind_a_handle(tilt: float):
    normal, place = np.array([np.sin(tilt), 0.0, -np.cos(tilt)]), np.array([0.0, 0.0, 1.0])
    plane = plane_at(picture(normal, place, handle=True), pixel(place), place, CAMERA, near=None, least_cosine=0.9)
    assert plane is not None
    assert plane.normal @ normal > np.cos(0.02)
    assert abs((plane.middle - place) @ normal) < 0.01
    assert not plane.behind


def test_a_plane_that_is_expected_is_told_from_others_and_seen_from_behind():
    normal, place = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    image = picture(normal, place)
    seen = plane_at(image, pixel(place), place, CAMERA, near=-normal, least_cosine=0.9)
    assert seen is not None
    assert seen.behind
    assert seen.normal @ normal < -0.99
    aside = np.array([1.0, 0.0, 0.0])
    assert plane_at(image, pixel(place), place, CAMERA, near=aside, least_cosine=0.9) is None


def test_no_plane_where_nothing_is_known():
    place = np.array([0.0, 0.0, 1.0])
    image = picture(np.array([0.0, 0.0, -1.0]), place)
    for uv in (np.array([np.nan, 5.0]), np.array([-1.0, 5.0]), np.array([5.0, SIDE + 1.0])):
        assert plane_at(image, uv, place, CAMERA, near=None, least_cosine=0.9) is None
    assert plane_at(np.zeros_like(image), pixel(place), place, CAMERA, near=None, least_cosine=0.9) is None
    scattered = image + np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    assert plane_at(scattered, pixel(place), place, CAMERA, near=None, least_cosine=0.9) is None


def door(angle: float) -> tuple[np.ndarray, Plane]:
    """Handle and front of a door that turns about DOOR_AXIS."""
    out = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    normal = np.array([-np.sin(angle), 0.0, -np.cos(angle)])
    return DOOR_ORIGIN + 0.5 * out, Plane(normal, DOOR_ORIGIN + 0.45 * out, behind=bool(-normal[2] < 0))


def opened(*, to: float = 0.8) -> Front:
    front = Front(0.04)
    for angle in (*np.zeros(8), *np.arange(0.0, to, 0.03)):
        point, plane = door(angle)
        front.see(plane, elapsed=1.0)
        front.learn(point)
    return front


def test_a_front_tells_how_far_a_door_is_open_and_what_to_expect():
    front = opened()
    assert front.joint is not None
    point, plane = door(1.0)
    assert not front.see(plane, elapsed=1.0)
    assert front.turned(front.joint) == pytest.approx(1.0, abs=0.05)
    normal, least = front.expected(point)
    assert normal is not None
    assert normal @ plane.normal > max(least, np.cos(0.05))
    front.see(None, elapsed=1.0)
    assert front.turned(front.joint) is None


def test_what_disagrees_for_long_gives_the_joint_up():
    front, (_, plane) = opened(), door(0.8)
    other = Plane(plane.normal, plane.middle + 0.3 * plane.normal, behind=False)
    assert [front.see(other, elapsed=1.0) for _ in range(21)] == [False] * 20 + [True]
    assert front.joint is None
    assert front.belief is None


def test_where_no_turn_brings_the_query_it_is_seen_again_and_again_until_the_joint_is_given_up():
    front, (on, _) = opened(), door(0.8)
    off = on + np.array([0.0, 0.0, 0.3])
    assert [front.given_up_for(point) for point in (*[off] * 5, on, *[off] * 6)] == [False] * 11 + [True]
    assert front.joint is None
    assert front.expected(on)[0] is None  # any plane may be the front again


def test_an_unseen_front_may_turn_further():
    front = Front(0.04)
    assert front.expected(np.zeros(3))[0] is None
    front.see(door(0.0)[1], elapsed=1.0)
    first = front.expected(np.zeros(3))[1]
    front.see(None, elapsed=2.0)
    assert front.expected(np.zeros(3))[1] < first


def seen(angle: float) -> BeliefRow:
    """A network that believes in a drawer."""
    return BeliefRow(-1.0, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.full(3, 0.4), np.full(3, 0.2))


def ground_of_a_door() -> tuple[Ground, np.ndarray]:
    """What is known of a handle, and where it is, after its door opened by 0.8 radians."""
    ground, point = Ground(TrackerConfig()), door(0.0)[0]
    for t, angle in enumerate((*np.zeros(8), *np.arange(0.0, 0.8, 0.03))):
        point, plane = door(angle)
        ground.face(plane, elapsed=1.0)
        ground.see(point, seen(angle), now=t)
    return ground, point


def test_a_joint_that_was_given_up_is_no_prior_any_more():
    """A drawer whose handle turned for a while: from the frame in which the hinge goes it is a drawer again."""
    ground, point = ground_of_a_door()
    for t in range(6):
        assert ground.front.joint is not None
        ground.face(None, elapsed=1.0)
        ground.see(point + np.array([0.0, 0.0, -0.4 - 0.1 * t]), seen(0.8), now=40 + t)
    assert ground.front.joint is None
    assert ground._estimator.prior is not None
    assert ground._estimator.prior.revolute_probability < 0.5


def test_a_query_follows_the_front_where_the_network_slides_along_it():
    """In its last frame it is said to be at the hinge; the front and the sights before tell better."""
    ground, _ = ground_of_a_door()
    assert ground.joint is not None
    assert ground.joint.kind is JointKind.REVOLUTE
    point, plane = door(1.2)
    ground.face(plane, elapsed=1.0)
    wrong = DOOR_ORIGIN + np.array([0.0, 0.1, 0.0])
    np.testing.assert_allclose(ground.settle(wrong), point, atol=0.05)
    np.testing.assert_allclose(ground.settle(point), point, atol=0.03)
    there, off = ground.favour(np.stack((point, door(0.2)[0])))
    assert there > off + 0.5
    ground.see(wrong, seen(1.2), now=40.0)  # what is not where the front says teaches nothing
    assert abs(ground.joint.axis @ DOOR_AXIS) > 0.99
    again = load(save(ground), Ground)
    for each in (ground, again):
        each.face(door(1.3)[1], elapsed=1.0)
    np.testing.assert_array_equal(again.settle(wrong), ground.settle(wrong))
