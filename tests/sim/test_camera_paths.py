"""How cameras move: bounded, smooth, with the spectrum of hands, necks and knocks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quest.errors import ConfigError, InputError
from quest.sim.annotate import project_points
from quest.sim.cameras import (
    CAMERA_MOTIONS,
    CameraPath,
    CameraStyle,
    bump,
    displaced,
    fixations,
    hand_shake,
    jolt,
    look,
    sample_camera_paths,
    sample_cameras,
    there_and_back,
)
from quest.sim.motion import FRAMES_PER_S
from quest.types import Camera
from tests.sim.test_cameras import cloud

seeds = st.integers(0, 2**31 - 1)


def paths_of(seed: int, style: CameraStyle, frames: int = 90, count: int = 2) -> list[CameraPath]:
    rng = np.random.default_rng(seed)
    return sample_camera_paths(cloud(seed), count, frames, rng, style=style, width=128, height=96)


def turned_deg(path: CameraPath) -> np.ndarray:
    """Angle of every frame's camera to the first one's."""
    relative = path.cam_from_world[:, :3, :3] @ path.cam_from_world[0, :3, :3].T
    return np.rad2deg(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))


def inside(path: CameraPath, points: np.ndarray) -> np.ndarray:
    """Which points are inside the image, at every frame."""
    local = points @ path.cam_from_world[:, :3, :3].transpose(0, 2, 1) + path.cam_from_world[:, None, :3, 3]
    uv = local[..., :2] / local[..., 2:] * path.camera.fx + [path.camera.cx, path.camera.cy]
    within = ((uv >= 0) & (uv <= [path.camera.width, path.camera.height])).all(axis=-1)
    pixel, _ = project_points(points, path.at(len(path) - 1))
    np.testing.assert_allclose(uv[-1], pixel, atol=1e-6)
    return within & (local[..., 2] > 0)


def assert_rigid(path: CameraPath) -> None:
    rotation = path.cam_from_world[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (len(path), 1, 1)), atol=1e-9)
    assert (np.linalg.det(rotation) > 0).all()
    np.testing.assert_array_equal(path.cam_from_world[:, 3], np.tile([0, 0, 0, 1.0], (len(path), 1)))


@given(seeds, st.integers(1, 4), st.integers(1, 20))
def test_static_paths_are_the_static_cameras(seed: int, count: int, frames: int) -> None:
    points = cloud(seed)
    cameras = sample_cameras(points, count, np.random.default_rng(seed), width=128, height=96)
    paths = paths_of(seed, CameraStyle(), frames, count)
    for camera, path in zip(cameras, paths, strict=True):
        assert path.static
        assert len(path) == frames
        for t in (0, frames - 1):
            assert path.at(t).camera == camera.camera
            np.testing.assert_array_equal(path.at(t).cam_from_world, camera.cam_from_world)


@settings(max_examples=40)
@given(seeds, st.floats(10, 90), st.sampled_from(["around", "over", "any"]))
def test_orbit_sees_everything_and_keeps_its_distance(seed: int, sweep: float, turn: str) -> None:
    points = cloud(seed)
    for path in paths_of(seed, CameraStyle("orbit", sweep_deg=sweep, turn=turn), 40):  # type: ignore[arg-type]
        assert_rigid(path)
        assert not path.static
        assert inside(path, points).all()
        eye = -(path.cam_from_world[:, :3, :3].transpose(0, 2, 1) @ path.cam_from_world[:, :3, 3:])[..., 0]
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        away = np.linalg.norm(eye - middle, axis=1)
        assert np.ptp(away) < 0.2 * away.mean()
        assert (eye[:, 2] >= 0).all()  # never below the floor
        azimuth = np.rad2deg(np.arctan2(-path.cam_from_world[:, 2, 1], -path.cam_from_world[:, 2, 0]))
        assert np.abs(azimuth[np.abs(path.cam_from_world[:, 2, 2]) < 0.99]).max() <= 70 + 1e-6


@given(seeds, st.floats(10, 90))
def test_orbit_over_the_object_ends_at_its_top(seed: int, sweep: float) -> None:
    for path in paths_of(seed, CameraStyle("orbit", sweep_deg=sweep, turn="over")):
        elevation = np.rad2deg(np.arcsin(np.clip(-path.cam_from_world[:, 2, 2], -1, 1)))
        assert -1e-6 <= elevation[0] <= 10 + 1e-6
        assert elevation[-1] - elevation[0] == pytest.approx(sweep, abs=1e-5)
        assert np.diff(elevation).min() > -1e-5


@given(seeds, st.floats(10, 90))
def test_orbit_around_the_object_turns_as_far_as_asked(seed: int, sweep: float) -> None:
    for path in paths_of(seed, CameraStyle("orbit", sweep_deg=sweep, turn="around")):
        azimuth = np.rad2deg(np.arctan2(-path.cam_from_world[:, 2, 1], -path.cam_from_world[:, 2, 0]))
        assert abs(azimuth[-1] - azimuth[0]) == pytest.approx(sweep, abs=1e-6)
        steps = np.abs(np.diff(azimuth))
        assert steps[0] < 0.2 * steps.max() > steps[-1]  # eased
        assert steps.max() < 1.875 / 0.76 * sweep / 89 * 1.05


@settings(max_examples=40)
@given(seeds)
def test_handheld_shakes_a_little(seed: int) -> None:
    points = cloud(seed)
    for path in paths_of(seed, CameraStyle("handheld"), 150):
        assert_rigid(path)
        assert 0.2 < turned_deg(path).max() < 12
        centre = path.cam_from_world[:, :3, :3] @ points.mean(axis=0) + path.cam_from_world[:, :3, 3]
        assert np.abs(np.diff(centre, axis=0)).max() < 0.04 * centre[:, 2].mean()
        assert inside(path, points).mean() > 0.9


@settings(max_examples=40)
@given(seeds)
def test_pan_keeps_the_centre_in_the_image(seed: int) -> None:
    points = cloud(seed)
    for path in paths_of(seed, CameraStyle("pan"), 150):
        assert_rigid(path)
        assert inside(path, points.mean(axis=0, keepdims=True)).all()
        assert inside(path, points).mean() > 0.6
        eye = -(path.cam_from_world[:, :3, :3].transpose(0, 2, 1) @ path.cam_from_world[:, :3, 3:])[..., 0]
        assert np.linalg.norm(eye - eye[0], axis=1).max() < 0.2 * np.linalg.norm(eye[0] - points.mean(axis=0))


@pytest.mark.parametrize("motion", [*CAMERA_MOTIONS, "mixed"])
def test_same_generator_same_paths(motion: str) -> None:
    style = CameraStyle(motion)  # type: ignore[arg-type]
    for first, again in zip(paths_of(4, style), paths_of(4, style), strict=True):
        np.testing.assert_array_equal(first.cam_from_world, again.cam_from_world)
        assert first.camera == again.camera


def test_mixed_draws_every_motion() -> None:
    paths = paths_of(0, CameraStyle("mixed"), frames=30, count=24)
    assert 0 < sum(path.static for path in paths) < 20


@given(seeds, st.sampled_from(["static", "handheld", "orbit"]), st.integers(1, 59))
def test_bump_is_sudden_and_stays(seed: int, motion: str, frame: int) -> None:
    path = paths_of(seed, CameraStyle(motion), frames=120, count=1)[0]  # type: ignore[arg-type]
    bumped = bump(path, frame, np.random.default_rng(seed))
    assert_rigid(bumped)
    np.testing.assert_array_equal(bumped.cam_from_world[:frame], path.cam_from_world[:frame])
    off = bumped.cam_from_world @ np.linalg.inv(path.cam_from_world)
    turn = np.rad2deg(np.arccos(np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert 2 - 1e-6 <= turn[-1] <= 4 + 1e-6
    assert turn[frame : frame + 3].max() >= 0.9 * turn[-1]
    assert turn.max() < 1.5 * turn[-1]
    np.testing.assert_allclose(off[frame + 31 :], off[-1:].repeat(89 - frame, axis=0), atol=1e-9)


@pytest.mark.parametrize("frame", [-1, 0, 20])
def test_bump_outside_the_path(frame: int) -> None:
    path = paths_of(0, CameraStyle(), frames=20)[0]
    with pytest.raises(ConfigError, match="bump"):
        bump(path, frame, np.random.default_rng(0))


@given(seeds, st.integers(1, 1500))
def test_there_and_back(seed: int, frames: int) -> None:
    progress = there_and_back(frames, np.random.default_rng(seed))
    assert progress.shape == (frames,)
    assert progress[0] == 0
    assert progress.min() >= 0
    assert progress.max() <= 1
    if frames > 100:
        assert progress.max() == 1
        assert np.abs(np.diff(progress)).max() < 1.875 / (0.76 * 0.45 * 300) if frames > 300 else True


def test_hand_shake_has_the_spectrum_of_hands() -> None:
    signal = hand_shake(3000, np.random.default_rng(0))
    np.testing.assert_allclose(np.sqrt((signal**2).mean(axis=0)), 1, rtol=1e-6)
    power = np.abs(np.fft.rfft(signal, axis=0)) ** 2
    frequency = np.fft.rfftfreq(3000, 1 / FRAMES_PER_S)

    def band(low: float, high: float) -> np.ndarray:
        return power[(frequency >= low) & (frequency <= high)].sum(axis=0) / power.sum(axis=0)

    assert (band(0.09, 2.01) > 0.99).all()
    assert (band(2.1, 7.9) < 1e-9).all()
    assert ((band(7.9, 12.1) > 1e-3) & (band(7.9, 12.1) < 1e-2)).all()
    assert np.abs(np.corrcoef(signal.T) - np.eye(6)).max() < 0.7  # no axis copies another


@given(seeds, st.integers(1, 400))
def test_fixations_rest_and_go(seed: int, frames: int) -> None:
    rng = np.random.default_rng(seed)
    targets = rng.uniform(-0.3, 0.3, (8, 2))
    angles = fixations(targets, frames, rng)
    assert angles.shape == (frames, 2)
    np.testing.assert_array_equal(angles[:9], np.zeros((min(frames, 9), 2)))
    assert np.abs(angles).max() <= np.abs(targets).max() + 1e-12
    # 1.875 times the fastest mean speed, or the longest way in the shortest time
    assert np.linalg.norm(np.diff(angles, axis=0), axis=1).max(initial=0) <= 1.875 / FRAMES_PER_S * max(
        1.0, 0.85 / 0.23
    )


@given(seeds, st.integers(0, 40))
def test_jolt(seed: int, at: int) -> None:
    response = jolt(90, at, np.random.default_rng(seed))
    assert (response[:at] == 0).all()
    assert 1 < response[at : at + 4].max() < 1.4
    assert (response[at + 31 :] == 1).all()


@given(st.floats(-np.pi, np.pi), st.floats(0, np.pi / 2))
def test_look_is_level_and_aims_back(azimuth: float, elevation: float) -> None:
    (towards,), (rotation,) = look(np.array([azimuth]), np.array([elevation]))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0
    np.testing.assert_allclose(rotation[2], -towards, atol=1e-12)
    assert rotation[0, 2] == 0  # level
    assert rotation[1, 2] <= 1e-12  # not upside down


def test_displaced_in_the_cameras_own_axes() -> None:
    start = np.tile(np.eye(4), (2, 1, 1))
    moved = displaced(start, np.array([[0, 0, np.pi / 2], [0, 0, 0]]), np.array([[0, 0, 0], [1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(moved[0, :3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(moved[1, :3, 3], [1, 2, 3])


def test_path_knows_its_frames() -> None:
    path = paths_of(1, CameraStyle("handheld"), frames=30, count=1)[0]
    kept = path.kept(np.arange(0, 30, 4))
    assert len(kept) == 8
    np.testing.assert_array_equal(kept.at(2).cam_from_world, path.at(8).cam_from_world)
    assert kept.camera == path.camera


@pytest.mark.parametrize("poses", [np.zeros((0, 4, 4)), np.full((2, 4, 4), np.nan)])
def test_path_refuses_what_is_no_path(poses: np.ndarray) -> None:
    with pytest.raises(InputError, match="camera path"):
        CameraPath(Camera(50, 50, 32, 24, 64, 48), poses)


@pytest.mark.parametrize(
    "setting",
    [
        {"azimuth_deg": (10, -10)},
        {"azimuth_deg": (0, 200)},
        {"elevation_deg": (-5, 10)},
        {"elevation_deg": (10, 90)},
        {"sweep_deg": 0},
        {"sweep_deg": 91},
    ],
)
def test_style_refuses_what_cannot_be(setting: dict) -> None:
    with pytest.raises(ConfigError, match="camera"):
        CameraStyle(**setting)


def test_no_frames() -> None:
    with pytest.raises(ConfigError, match="at least one frame"):
        paths_of(0, CameraStyle(), frames=0)


@given(seeds)
def test_viewpoints_never_trained_on(seed: int) -> None:
    style = CameraStyle(azimuth_deg=(60, 85), elevation_deg=(55, 75), mirrored=True)
    for path in paths_of(seed, style, frames=1):
        towards = -path.cam_from_world[0, 2, :3]
        assert 60 - 1e-6 <= abs(np.rad2deg(np.arctan2(towards[1], towards[0]))) <= 85 + 1e-6
        assert 55 - 1e-6 <= np.rad2deg(np.arcsin(towards[2])) <= 75 + 1e-6
        assert inside(path, cloud(seed)).all()
