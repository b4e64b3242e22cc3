"""Queries on one link share one joint."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.grounding import JointEstimator, JointKind, LinkGroups
from quest.track.saving import load, save
from tests.grounding.scenes import FRAMES, door, drawers, noisy, opened, two_doors
from tests.grounding.tracks import angle_deg

SIGMA = 0.002


class Watcher:
    """Links and the queries' own joints, fed frame by frame."""

    def __init__(self, queries: int) -> None:
        self.own = {k: JointEstimator(SIGMA) for k in range(queries)}
        self.links = LinkGroups(SIGMA)

    def see(self, t: int, points: np.ndarray, hidden: tuple[int, ...] = ()) -> None:
        seen = {k: point for k, point in enumerate(points) if k not in hidden}
        for k, point in seen.items():
            self.own[k].add(point)
        self.links.see(t, seen, {k: e.joint for k, e in self.own.items()})


def watch(tracks: np.ndarray) -> tuple[Watcher, list[tuple[int, ...]]]:
    """What was learned from tracks (T x K x 3), and the partners of the first query in every frame."""
    watcher, partners = Watcher(tracks.shape[1]), []
    for t, points in enumerate(tracks):
        watcher.see(t, points)
        partners.append(watcher.links.partners(0))
    return watcher, partners


@pytest.mark.parametrize("seed", range(3))
def test_two_points_of_a_door_share_its_joint(seed: int):
    tracks, axis = door(seed, opened(1.2, 15, 100))
    watcher, _ = watch(noisy(tracks, seed))
    assert watcher.links.partners(0) == (1,)
    assert watcher.links.partners(1) == (0,)
    joints = [watcher.links.joint(k) for k in (0, 1)]
    for k, joint in enumerate(joints):
        assert joint is not None
        assert joint.kind is JointKind.REVOLUTE
        assert angle_deg(joint.axis, axis) < 1
        q = joint.locate(tracks[:, k])
        np.testing.assert_allclose(joint.at(q), tracks[:, k], atol=0.004)
    # One coordinate for both.
    first, second = (j.locate(tracks[:, k]) for k, j in enumerate(joints) if j is not None)
    np.testing.assert_allclose(first, second, atol=0.01)


def test_a_hidden_point_is_where_its_partner_says():
    tracks, _ = door(4, opened(1.4, 10, 110))
    seen = noisy(tracks, 4)
    watcher, wrong = Watcher(2), []
    for t, points in enumerate(seen):
        hidden = (1,) if t >= 80 else ()
        watcher.see(t, points, hidden)
        if hidden:
            found = watcher.links.predict(1, {0: points[0]})
            wrong.append(np.nan if found is None else np.linalg.norm(found - tracks[t, 1]))
    told = np.isfinite(wrong)
    assert told.mean() > 0.75  # not by outliers of the partner
    assert np.median(np.array(wrong)[told]) < 0.005
    assert watcher.links.predict(1, {}) is None
    assert watcher.links.predict(7, {0: tracks[-1, 0]}) is None


@pytest.mark.slow
def test_what_is_opened_one_after_the_other_is_not_joined():
    seed = 0
    one, other, late = opened(0.3, 10, 50), opened(0.3, 60, 110), opened(0.3, 35, 110)
    scenes = [
        drawers(seed, one, other),
        drawers(seed, one, late),
        drawers(seed, one, np.zeros(FRAMES)),
        two_doors(seed, 4 * one, 4 * other),
        two_doors(seed, 4 * one, 4 * one),
    ]
    for tracks in scenes:
        _, partners = watch(noisy(tracks, seed))
        assert not any(partners)


def test_drawers_that_move_at_the_same_time_are_joined_until_one_moves_alone():
    """While they move alike nothing tells them apart."""
    together, alone = opened(0.2, 5, 50), opened(0.2, 60, 115)
    _, partners = watch(noisy(drawers(0, together, together + alone), 0, outliers=0.0))
    assert partners[55] == (1,)
    assert partners[-1] == ()


@pytest.mark.slow
def test_three_on_a_drawer_one_still_and_one_elsewhere():
    one, other = opened(0.3, 10, 60), opened(0.3, 55, 110)
    watcher, _ = watch(noisy(drawers(3, one, one, one, other, np.zeros(FRAMES)), 3))
    assert [watcher.links.partners(k) for k in range(5)] == [(1, 2), (0, 2), (0, 1), (), ()]
    joint = watcher.links.joint(2)
    assert joint is not None
    assert joint.kind is JointKind.PRISMATIC
    assert joint.upper == pytest.approx(0.3, abs=0.02)
    watcher.links.forget(0)
    assert watcher.links.partners(1) == (2,)
    watcher.links.forget(1)
    assert watcher.links.joint(2) is None
    assert watcher.links.partners(0) == ()


def test_restored_links_go_on_to_the_same_bytes():
    tracks = noisy(door(1, opened(1.2, 10, 100))[0], 1)
    whole, first = Watcher(2), Watcher(2)
    for t, points in enumerate(tracks):
        whole.see(t, points)
        first.see(t, points)
        if t in (30, 70):
            again = Watcher(2)
            again.links, again.own = load(save((first.links, first.own)), tuple[LinkGroups, dict[int, JointEstimator]])
            first = again
    assert first.links.joint(0) is not None
    assert save(first.links) == save(whole.links)


def test_memory_is_bounded():
    links, joints = LinkGroups(SIGMA, capacity=16), {0: None}
    for t in range(100):
        links.see(t, {0: np.array([0.01 * t, 0.0, 0.0])}, joints)
    frames = links._frames.copy()
    assert len(frames) == 16
    assert frames[0] == 0
    for t in range(100, 200):
        links.see(t, {0: np.array([0.99, 0.0, 0.0])}, joints)
    np.testing.assert_array_equal(links._frames, frames)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="sigma"):
        LinkGroups(0.0)
    links = LinkGroups(SIGMA)
    with pytest.raises(InputError):
        links.see(0, {0: np.zeros(2)}, {})
    with pytest.raises(InputError, match="finite point"):
        links.see(0, {0: np.full(3, np.nan)}, {})
    links.see(3, {0: np.zeros(3)}, {})
    with pytest.raises(InputError, match="in order"):
        links.see(3, {0: np.zeros(3)}, {})
