"""Takes with occlusions: what hides what, what moves when, what is hidden when, and that the pictures agree."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quest.data.take_format import hash_take
from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.cameras import CameraStyle, PosedCamera
from quest.sim.generate import generate_take
from quest.sim.motion import HOLD_FRAMES, MotionStyle
from quest.sim.objects import SimObject
from quest.sim.props import fit_shape, slide_in
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings
from quest.sim.staging import SURROUNDINGS, occlusion_script
from quest.sim.suites import HIDDEN_FRAMES, SUITES, find_suites
from quest.types import Camera, Take
from tests.sim.small_objects import articulation

ALONE = find_suites("occlusion")[0].hidden_for(12)
BESIDE = ALONE.hidden_for(look_alike=True)
HIDING = {suite.name: suite.hiding for (suite, *_) in SUITES.values() if suite.hiding is not None}
SMALL = TakeSettings(views=1, size=64)

POSED = PosedCamera(
    Camera(110.0, 110.0, 48.0, 48.0, 96, 96),
    np.array([[0, 1, 0, 0], [0, 0, -1, 0.4], [-1, 0, 0, 2.0], [0, 0, 0, 1.0]]),
)
seeds = st.integers(0, 2**31 - 1)
places = st.floats(-0.3, 0.3)
extents = st.floats(0.05, 0.1)


def square(u: float, v: float, a: float, b: float) -> np.ndarray:
    return np.array([[u - a, v - b], [u + a, v - b], [u + a, v + b], [u - a, v + b]])


@given(seeds, places, places, extents, extents)
def test_a_shape_hides_all_rays_from_before_the_object(seed: int, u: float, v: float, a: float, b: float) -> None:
    rays = square(u, v, a, b)
    shape = fit_shape(rays, POSED, 0.8, np.random.default_rng(seed))
    if shape is None:
        return
    assert shape.hides(rays).all()
    assert shape.hides(rays.mean(axis=0, keepdims=True)).all()
    depth = shape.vertices[:, 2]
    assert depth.min() > 0
    assert depth.max() < 0.8
    assert shape.outline.volume < 0.5 * (96 / 110) ** 2
    assert not shape.hides(np.array([[u + 1.5, v]])).any()


def test_most_places_can_be_hidden_and_shapes_differ() -> None:
    rays = square(0.1, -0.1, 0.08, 0.06)
    shapes = [fit_shape(rays, POSED, 1.0, np.random.default_rng(seed)) for seed in range(30)]
    found = [shape for shape in shapes if shape is not None]
    assert len(found) > 20
    assert {shape.kind for shape in found} == {"box", "cylinder"}
    assert len({shape.half_m.tobytes() for shape in found}) == len(found)


def test_too_much_to_hide() -> None:
    assert fit_shape(square(0.0, 0.0, 0.4, 0.4), POSED, 1.0, np.random.default_rng(0)) is None


@given(seeds)
def test_it_comes_from_outside_the_image_and_stands_still_in_its_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = fit_shape(square(0.1, 0.0, 0.08, 0.08), POSED, 1.0, rng)
    if shape is None:
        return
    away = np.array([1.0, 1 - 1e-9, 0.5, 0.0, 0.0])
    poses = POSED.cam_from_world @ slide_in(shape, POSED, away, rng)
    np.testing.assert_allclose(poses[3:], np.tile(shape.cam_from_shape, (2, 1, 1)), atol=1e-9)
    local = apply(np.linalg.inv(shape.cam_from_shape), shape.vertices)
    outside = apply(poses[1], local)
    uv = outside[:, :2] / outside[:, 2:] * 110 + 48
    assert (uv < 0).all(axis=0).any() or (uv > 96).all(axis=0).any()
    np.testing.assert_allclose(poses[2, 2, 3], shape.cam_from_shape[2, 3])  # parallel to the image
    gone = apply(np.linalg.inv(POSED.cam_from_world), apply(poses[0], local))
    assert gone[:, 2].max() < -10  # below the ground, where it casts no shadow


@given(seeds, st.integers(*HIDDEN_FRAMES), st.integers(1, 3), st.sampled_from(sorted(HIDING)))
def test_joints_move_in_view_and_stop_while_hidden(seed: int, hidden: int, count: int, name: str) -> None:
    thing = articulation(("revolute", 0, 1.5), ("prismatic", 0, 0.4), ("revolute", -2, 0.1))
    joints = tuple(range(count))
    position, episodes = occlusion_script(thing, joints, HIDING[name], hidden, np.random.default_rng(seed))
    assert [e.joint for e in episodes] == list(joints)
    assert len(position) == episodes[-1].end
    np.testing.assert_array_equal(position[:HOLD_FRAMES], np.tile(thing.rest, (HOLD_FRAMES, 1)))
    for e, following in zip(episodes, [*episodes[1:], None], strict=True):
        assert following is None or following.start == e.end
        assert e.shown - e.hidden == hidden
        assert e.hidden < e.stops < e.shown
        assert e.hidden - e.slide - e.moves >= 11  # frames that show it moving with nothing before the object
        opened = np.abs(position[:, e.joint] - thing.rest[e.joint])
        assert not opened[: e.moves].any()
        assert np.ptp(opened[e.stops - 1 :]) < 1e-12
        assert 0.35 * opened[-1] < opened[e.hidden - 1] < 0.98 * opened[-1]
        assert (np.diff(opened[e.moves - 1 : e.stops]) > 0).all()
        away = e.away(len(position))
        np.testing.assert_array_equal(np.flatnonzero(away == 0), np.arange(e.hidden, e.shown))
        assert ((away > 0) & (away < 1)).sum() == 2 * e.slide


def check_hidden(take: Take) -> None:
    """Every hidden entity is hidden in its frames with its surroundings, and seen before and after."""
    view, names = take.views[0], [e.name for e in take.info.entities]
    depth_m, size = view.clip.depth_m, view.clip.camera.width
    assert depth_m is not None
    y, x = np.mgrid[:size, :size] + 0.5
    for name, first, end in take.info.provenance["hidden"]:
        e = names.index(name)
        entity = take.info.entities[e]
        assert entity.joint in take.info.moved_joints
        assert not view.visible[first:end, e].any()
        assert view.visible[0, e]
        assert view.visible[first - 5, e]
        assert not (view.entity_id[first:end] == 1 + e).any()
        for t in range(first, end):
            around = np.hypot(x - view.uv_px[t, e, 0], y - view.uv_px[t, e, 1]) <= SURROUNDINGS * size
            z = (view.clip.cam_from_world[t] @ [*take.point_world[t, e], 1.0])[2]
            before = (view.link_id[t] == 0) & (depth_m[t] > 0) & (depth_m[t] < z)
            assert before[around].mean() >= 0.8
        opened = np.abs(take.joint_position[:, entity.joint] - take.joint_position[0, entity.joint])
        assert opened[end - 1] > opened[first]  # it moves on
        assert opened[end - 1] == opened[-1]  # and has stopped


@pytest.mark.render
def test_alone(cabinet: SimObject, renderer: Renderer) -> None:
    take = generate_take(cabinet, 1, 0, renderer=renderer, settings=SMALL, suite=ALONE, provenance={"commit": "none"})
    assert take.info.name == "cabinet-L1-occlusion12-s000000"
    assert (take.info.suite, take.info.level) == ("occlusion", 1)
    assert (take.info.provenance["commit"], take.info.provenance["look_alike"]) == ("none", False)
    ((name, first, end),) = take.info.provenance["hidden"]
    assert end - first == 12
    check_hidden(take)
    e = [entity.name for entity in take.info.entities].index(name)
    assert take.views[0].visible[-1, e]
    again = generate_take(cabinet, 1, 0, renderer=renderer, settings=SMALL, suite=ALONE)
    assert hash_take(take) == hash_take(again)


@pytest.mark.render
def test_beside_a_look_alike_with_every_second_frame(chest: SimObject, renderer: Renderer) -> None:
    settings = replace(SMALL, every=2)
    take = generate_take(chest, 1, 1, renderer=renderer, settings=settings, suite=BESIDE)
    ((name, first, end),) = take.info.provenance["hidden"]
    assert end - first == 6
    check_hidden(take)
    names = [entity.name for entity in take.info.entities]
    other = 1 - names.index(name)
    assert take.views[0].visible[first:end, other].mean() > 0.8


@pytest.mark.render
def test_two_joints_one_after_the_other(chest: SimObject, renderer: Renderer) -> None:
    suite = find_suites("lockers")[0].hidden_for(10)
    take = generate_take(chest, 2, 0, renderer=renderer, settings=SMALL, suite=suite)
    assert take.info.suite == "lockers"
    assert len(take) == 2 * (30 + 10)
    assert len({name for name, _, _ in take.info.provenance["hidden"]}) == 2
    check_hidden(take)


@pytest.mark.render
def test_nothing_that_the_suite_could_hide(cabinet: SimObject, chest: SimObject, renderer: Renderer) -> None:
    with pytest.raises(ObjectError, match="same label, found none"):
        generate_take(cabinet, 1, 0, renderer=renderer, settings=SMALL, suite=BESIDE)
    with pytest.raises(ObjectError, match="no look-alike in view, found none in 24 draws"):
        generate_take(chest, 1, 0, renderer=renderer, settings=SMALL, suite=ALONE)
    with pytest.raises(ConfigError, match="1 view"):
        generate_take(chest, 1, 0, renderer=renderer, settings=replace(SMALL, views=2), suite=BESIDE)


@pytest.mark.parametrize("hidden", [9, 121])
def test_hidden_for_too_short_or_too_long(hidden: int) -> None:
    with pytest.raises(ConfigError, match=f"10 to 120 frames, got {hidden}"):
        ALONE.hidden_for(hidden)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 2},
        {"cameras": CameraStyle(motion="orbit")},
        {"motion": MotionStyle(kind="robot")},
        {"disturbance": "bump"},
        {"gripper": True},
        {"physics": True},
        {"frames": 500},
    ],
)
def test_what_cannot_be_had_together_with_hidden_entities(wrong: dict) -> None:
    with pytest.raises(ConfigError, match="hidden entities"):
        replace(ALONE, settings=replace(SMALL, **wrong))
