"""Physics: joints follow the script as bodies do, rest in the hold, keep to their limits, and always the same way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from quest.errors import InputError
from quest.sim.articulation import Part
from quest.sim.motion import HOLD_FRAMES, MotionStyle, motion_script
from quest.sim.objects import SimObject, load_object
from quest.sim.physics import Heft, JointFeel, play_physically
from quest.sim.procedural import make_object
from tests.sim.small_objects import CARCASS, DRAWER, Box, Link, write_object

PARTNET = Path(__file__).parents[3] / "shared" / "data" / "partnet-mobility"
LID = Link(
    "lid",
    (Box("lid-1", (0.4, 0.6, 0.03), (0.2, 0, 0.015)),),
    kind="revolute",
    origin=(-0.2, 0, 1.0),
    axis=(0, -1, 0),
    limits=(0, 1.4),
)
"""On top of the carcass, hinged at the back: its weight shuts it."""


def part(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> Part:
    surface = trimesh.creation.box(size).apply_translation(centre)
    return Part("", "", 0, np.eye(4), None, (1, 1, 1), (1, 1, 1), "box", None, surface)


@pytest.fixture(scope="module")
def trunk(tmp_path_factory: pytest.TempPathFactory) -> SimObject:
    return load_object(write_object(tmp_path_factory.mktemp("objects") / "trunk", CARCASS, DRAWER, LID))


def assert_possible(sim_object: SimObject, script: np.ndarray, played: np.ndarray) -> None:
    assert played.shape == script.shape
    assert np.isfinite(played).all()
    np.testing.assert_array_equal(played[:HOLD_FRAMES], script[:HOLD_FRAMES])
    for j, joint in enumerate(sim_object.articulation.joints):
        assert played[:, j].min() >= joint.joint.lower
        assert played[:, j].max() <= joint.joint.upper
        before = np.append(np.flatnonzero(script[:, j] != script[0, j]), len(script))[0]
        np.testing.assert_array_equal(played[:before, j], script[:before, j])  # latched


def off(sim_object: SimObject, script: np.ndarray, played: np.ndarray) -> np.ndarray:
    """Distance to the script as a share of every joint's travel."""
    travel = np.array([max(j.travel()) for j in sim_object.articulation.joints])
    return np.abs(played - script) / travel


@pytest.mark.parametrize("category", ["base_cabinet", "laptop", "french_refrigerator", "microwave"])
def test_procedural_objects_at_their_highest_level(category: str) -> None:
    play_at_the_highest_level(make_object(category, 3))


@pytest.mark.partnet
@pytest.mark.parametrize("object_id", ["44817", "7128", "7179", "bucket_dh", "101284", "103283"])
def test_partnet_objects_at_their_highest_level(object_id: str) -> None:
    if not (PARTNET / object_id).is_dir():
        pytest.skip(f"no PartNet-Mobility object {object_id}")
    play_at_the_highest_level(load_object(PARTNET / object_id))


def play_at_the_highest_level(thing: SimObject) -> None:
    moved = thing.movable[:4]
    script = motion_script(thing.articulation, moved, np.random.default_rng(1), style=MotionStyle("mixed", overlap=0.3))
    played = play_physically(thing, script, np.random.default_rng(2), substeps=8)
    assert_possible(thing, script, played)
    distance = off(thing, script, played)[:, list(moved)]
    assert 1e-4 < distance.mean() < 0.05
    assert distance.max() < 0.25


def test_same_generator_same_motion(cabinet: SimObject) -> None:
    script = motion_script(cabinet.articulation, (0, 1), np.random.default_rng(0))
    first, again, other = (play_physically(cabinet, script, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_weight_pulls_a_lid_down_and_leaves_a_drawer(trunk: SimObject, monkeypatch: pytest.MonkeyPatch) -> None:
    script = np.zeros((180, 2))
    script[HOLD_FRAMES:40] = np.linspace(0, 1, 32)[:, None] * [0.2, 0.8]
    script[40:] = [0.2, 0.8]

    def end(support: float) -> np.ndarray:
        ones = np.ones(2)
        feel = JointFeel(6 * ones, 0.8 * ones, 0 * ones, ones, ones, support * ones)
        monkeypatch.setattr(JointFeel, "drawn", classmethod(lambda cls, joints, rng: feel))
        return play_physically(trunk, script, np.random.default_rng(0))[-1]

    held, half = end(1.0), end(0.5)
    np.testing.assert_allclose(held, script[-1], atol=2e-3)
    # A lid of length L hinged at its edge: g cos(angle) / (2/3 L) of acceleration against 0.5 of it and the spring.
    length = 0.4 * trunk.scale
    slope = half[1] + np.arctan(0.015 / 0.2)  # of the way from the hinge to the lid's middle
    sag = 0.5 * 9.81 * np.cos(slope) / (2 / 3 * length) / (2 * np.pi * 6) ** 2
    assert held[1] - half[1] == pytest.approx(sag, rel=0.05)
    assert half[0] == pytest.approx(held[0], abs=1e-4)


def test_stops_stop(cabinet: SimObject) -> None:
    """A script that slams a joint into its limit: it arrives, and never goes beyond."""
    upper = np.array([j.joint.upper for j in cabinet.articulation.joints])
    script = np.zeros((90, 2))
    script[10:14] = np.linspace(0, 1, 4)[:, None] * upper
    script[14:] = upper
    played = play_physically(cabinet, script, np.random.default_rng(0))
    assert_possible(cabinet, script, played)
    assert (played.max(axis=0) > 0.999 * upper).all()
    np.testing.assert_allclose(played[-1], upper, rtol=0.05)


def test_scripts_that_cannot_be_played(cabinet: SimObject) -> None:
    rest = np.zeros((20, 2))
    np.testing.assert_array_equal(play_physically(cabinet, rest, np.random.default_rng(0)), rest)
    moving, outside, broken = rest.copy(), rest.copy(), rest.copy()
    moving[3:] = 0.1
    outside[10:, 0] = 5
    broken[10:, 0] = np.nan
    rng = np.random.default_rng(0)
    for script, words in (
        (np.zeros((20, 3)), "positions of 2 joints"),
        (np.zeros((0, 2)), "positions of 2 joints"),
        (broken, "finite positions"),
        (moving, "first 8 frames"),
        (outside, "joint_drawer"),
    ):
        with pytest.raises(InputError, match=words):
            play_physically(cabinet, script, rng)
    with pytest.raises(InputError, match="steps per frame"):
        play_physically(cabinet, rest, rng, substeps=4)


def test_what_bodies_weigh() -> None:
    board = Heft.of([part((0.6, 0.4, 0.02), (1, 0, 0))], 650)
    assert board.mass_kg == pytest.approx(650 * 0.6 * 0.4 * 0.02)
    np.testing.assert_allclose(board.centre, [1, 0, 0], atol=1e-12)
    expected = board.mass_kg / 12 * np.array([0.4**2 + 0.02**2, 0.6**2 + 0.02**2, 0.6**2 + 0.4**2])
    np.testing.assert_allclose(board.inertia, np.diag(expected), rtol=1e-9)
    whole = Heft.of([part((0.02, 0.4, 0.3))], 500)
    halves = Heft.of([part((0.02, 0.2, 0.3), (0, y, 0)) for y in (-0.1, 0.1)], 500)
    assert halves.mass_kg == pytest.approx(whole.mass_kg)
    np.testing.assert_allclose(halves.inertia, whole.inertia, rtol=1e-9)


def test_what_is_thick_is_hollow_and_what_is_empty_weighs_a_gram() -> None:
    assert Heft.of([part((1, 1, 1))], 1000).mass_kg == pytest.approx(1000 * 6 / 2 * 0.02)
    assert Heft.of([], 1000).mass_kg == 1e-3
    assert (np.linalg.eigvalsh(Heft.of([], 1000).inertia) > 0).all()
