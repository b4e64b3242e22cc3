"""Simulated sensors: how depth fails and where, and that what is not asked for does not change."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quest.errors import ConfigError, InputError
from quest.sim.sensor import SENSORS, STEREO, STRUCTURED_LIGHT, DepthSensor, SensorModel, sense
from quest.types import Camera

CAMERA = Camera(150.0, 150.0, 64.0, 48.0, 128, 96)
DEVICES = pytest.mark.parametrize("device", [STRUCTURED_LIGHT, STEREO], ids=["structured-light", "stereo"])


def walls(*depth_m: float) -> np.ndarray:
    """One frame a wall, which looks at the camera."""
    return np.tile(np.array(depth_m, np.float32)[:, None, None], (1, 96, 128))


def grey(frames: int, value: int = 120) -> np.ndarray:
    return np.full((frames, 96, 128, 3), value, np.uint8)


def sensed(depth_m: np.ndarray, device: DepthSensor, *, seed: int = 0, value: int = 120) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sense(grey(len(depth_m), value), depth_m, SensorModel(device), rng, camera=CAMERA)[1]


def before_a_wall(near_m: float, far_m: float) -> np.ndarray:
    """A board from column 50 to 80 before a wall, many times."""
    depth = walls(*[far_m] * 12)
    depth[:, 30:70, 50:80] = near_m
    return depth


@given(st.integers(0, 2**31 - 1))
def test_an_ideal_sensor_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rgb, depth = rng.integers(0, 256, (2, 96, 128, 3), dtype=np.uint8), rng.random((2, 96, 128), dtype=np.float32)
    same_rgb, same_depth = sense(rgb, depth, SENSORS["ideal"], rng, camera=CAMERA)
    assert same_rgb is rgb
    assert same_depth is depth


@DEVICES
def test_noise_and_steps_grow_with_the_square_of_depth(device: DepthSensor) -> None:
    fixed = replace(device, lateral_px=0.0, torn=0.0)
    for z in (1.0, 2.0, 4.0):
        (frame,) = sensed(walls(z), fixed)
        values = frame[frame > 0]
        (expected,) = np.hypot(device.sigma_m(np.array([z])), device.step_m(np.array([z])) / np.sqrt(12))
        assert np.std(values) == pytest.approx(expected, rel=0.15)
        assert np.mean(values) == pytest.approx(z, abs=0.02 * z)
        disparity = device.focal_px * device.baseline_m / values / device.step_px
        np.testing.assert_allclose(disparity, np.rint(disparity), atol=0.02)
    steps = device.step_m(np.array([1.0, 2.0, 4.0]))
    np.testing.assert_allclose(steps / steps[0], [1, 4, 16])


def test_figures_of_the_devices() -> None:
    (frame,) = sensed(walls(2.0), replace(STEREO, lateral_px=0.0))
    error = frame.astype(float) - 2.0  # which neighbours share
    assert np.corrcoef(error[:, :-1].ravel(), error[:, 1:].ravel())[0, 1] > 0.25
    assert abs(np.corrcoef(error[:, :-12].ravel(), error[:, 12:].ravel())[0, 1]) < 0.05
    np.testing.assert_allclose(STRUCTURED_LIGHT.step_m(np.array([1.0, 5.0])), [0.00287, 0.0718], rtol=0.01)
    np.testing.assert_allclose(STRUCTURED_LIGHT.sigma_m(np.array([0.4, 1.4])), [0.0012, 0.0031])
    np.testing.assert_allclose(STEREO.sigma_m(np.array([1.0, 2.0])), [0.00372, 0.01488], rtol=1e-3)


@DEVICES
def test_a_shadow_lies_to_the_left_of_what_is_nearer(device: DepthSensor) -> None:
    holes = (sensed(before_a_wall(0.8, 2.4), device) == 0)[:, 35:65].mean(axis=(0, 1))
    width = round(150 * device.baseline_m * (1 / 0.8 - 1 / 2.4))
    assert width > 5
    assert (holes[50 - width + 1 : 49] > 0.95).all()
    assert holes[: 50 - width - 2].max() < 0.02
    assert holes[53:77].max() < 0.02
    assert holes[82:].max() < 0.02  # none on the right
    assert holes[79:82].max() > 0.1  # but a torn edge


@DEVICES
def test_edges_jitter(device: DepthSensor) -> None:
    frames = sensed(before_a_wall(1.5, 1.6), device)
    near = (frames > 0) & (frames < 1.55)
    column = near[:, 35:65, 79:81]
    assert 0.02 < column[..., 0].mean() < 0.98
    assert len(np.unique(column.reshape(12, -1), axis=0)) == 12


@DEVICES
def test_grazing_dark_and_shiny_surfaces_are_lost(device: DepthSensor) -> None:
    # A floor seen under 5 to 40 degrees: z = h / tan(pitch) per row.
    rows = (np.arange(96) + 0.5 - 48) / 150
    floor = np.zeros((6, 96, 128), np.float32)
    floor[:, 52:] = (0.25 / rows[52:, None]).astype(np.float32)
    lost = (sensed(floor, replace(device, range_m=(0.1, 100.0))) == 0)[:, 53:].mean(axis=(0, 2))
    assert lost[:3].min() > 0.5  # 2 to 4 degrees above the floor
    assert (np.diff(lost[:20].reshape(5, 4).mean(axis=1)) < 0).all()
    share = {value: (sensed(walls(1.5, 1.5, 1.5), device, value=value) == 0).mean() for value in (2, 120, 255)}
    assert share[120] < 0.005
    assert share[2] == pytest.approx(device.lost_dark * 0.94, abs=0.06)
    assert share[255] == pytest.approx(device.lost_shiny, abs=0.05)


@DEVICES
def test_missing_stays_missing_and_range_is_limited(device: DepthSensor) -> None:
    depth = before_a_wall(1.0, 1.8)
    depth[:, :20] = 0
    depth[:, 40:50, 60:70] = 0
    result = sensed(depth, device)
    assert np.isfinite(result).all()
    assert not result[depth == 0].any()
    assert not sensed(walls(0.8 * device.range_m[0], 1.2 * device.range_m[1]), device).any()
    assert not sensed(walls(0.0), device).any()


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_seeds_frames_and_what_follows(name: str) -> None:
    model = replace(SENSORS[name], rgb_noise=0.02, motion_blur_px=3.0, jpeg_quality=60)
    depth, rgb = before_a_wall(0.9, 2.0), grey(12)
    rgb[..., ::7, :] = 30
    first = sense(rgb, depth, model, np.random.default_rng(3), camera=CAMERA)
    again = sense(rgb, depth, model, np.random.default_rng(3), camera=CAMERA)
    start = sense(rgb[:5], depth[:5], model, np.random.default_rng(3), camera=CAMERA)
    other = sense(rgb, depth, model, np.random.default_rng(4), camera=CAMERA)
    for a, b, c, d in zip(first, again, start, other, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[:5], c)
        assert a.dtype == b.dtype
        if a is not depth:
            assert (a != d).any()
            assert (a[0] != a[1]).any()  # the scene stands still, the noise does not
    # Depth does not depend on what happens to colours, and the generator advances alike.
    plain, rng = replace(model, rgb_noise=0.0, motion_blur_px=0.0, jpeg_quality=None), np.random.default_rng(3)
    np.testing.assert_array_equal(sense(rgb, depth, plain, rng, camera=CAMERA)[1], first[1])
    reference = np.random.default_rng(3)
    sense(rgb, depth, SENSORS["ideal"], reference, camera=CAMERA)
    assert rng.random() == reference.random()


def test_noise_blur_and_compression_of_colours() -> None:
    for share in (0.01, 0.1):
        rgb, _ = sense(grey(3), walls(1, 1, 1), SensorModel(rgb_noise=share), np.random.default_rng(0), camera=CAMERA)
        assert rgb.std() == pytest.approx(255 * share, rel=0.05)
        assert rgb.mean() == pytest.approx(120, abs=0.5)
    rgb, depth = grey(2, 20), walls(1, 1)
    rgb[:, 40:60, 50:90] = (220, 40, 90)

    def seen(model: SensorModel) -> np.ndarray:
        return sense(rgb, depth, model, np.random.default_rng(1), camera=CAMERA)[0].astype(float)

    sharpness = [np.abs(np.diff(seen(SensorModel(blur_px=s)), axis=2)).max() for s in (0.0, 0.8, 2.0)]
    assert sharpness[0] > sharpness[1] > sharpness[2]
    smeared = seen(SensorModel(motion_blur_px=9.0))
    assert smeared.mean() == pytest.approx(rgb.mean(), rel=0.01)
    edges = [np.abs(np.diff(smeared, axis=a)).max() for a in (1, 2)]
    assert max(edges) < 200
    error = [np.abs(seen(SensorModel(jpeg_quality=q)) - rgb).mean() for q in (95, 40, 5)]
    assert 0 < error[0] < error[1] < error[2] < 20
    colours = seen(SensorModel(jpeg_quality=90))[0, 50, 70]
    np.testing.assert_allclose(colours, (220, 40, 90), atol=12)  # red stays red


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1), (7, 3)])
def test_pictures_of_odd_sizes(size: tuple[int, int]) -> None:
    height, width = size
    camera = Camera(50.0, 50.0, width / 2, height / 2, width, height)
    depth = np.full((2, height, width), 1.5, np.float32)
    rgb, result = sense(
        np.zeros((2, *size, 3), np.uint8), depth, SENSORS["stereo"], np.random.default_rng(0), camera=camera
    )
    assert rgb.shape == (2, height, width, 3)
    assert result.shape == depth.shape
    assert result.dtype == np.float32


def test_errors() -> None:
    wrong_models: list[dict[str, Any]] = [
        {"rgb_noise": -0.1},
        {"rgb_noise": np.nan},
        {"blur_px": -1.0},
        {"jpeg_quality": 0},
    ]
    for arguments in wrong_models:
        with pytest.raises(ConfigError, match="sensor: expected"):
            SensorModel(**arguments)
    numbers = [f.name for f in fields(DepthSensor) if f.name != "range_m"]
    for name in numbers:
        with pytest.raises(ConfigError, match="depth sensor: expected"):
            replace(STEREO, **{name: -1.0})
    with pytest.raises(ConfigError, match="range"):
        replace(STEREO, range_m=(2.0, 1.0))
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="expected colours and depth of 96 x 128 pixels"):
        sense(grey(1), walls(1), SENSORS["stereo"], rng, camera=Camera(150.0, 150.0, 48.0, 64.0, 96, 128))
    for wrong in (np.nan, -1.0, np.inf):
        with pytest.raises(InputError, match="finite depth"):
            sense(grey(1), walls(wrong), SENSORS["stereo"], rng, camera=CAMERA)
