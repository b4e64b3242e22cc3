"""Clips from arrays in memory, and what clips and cameras are checked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import quest
from quest.data.frame_source import Parts
from quest.data.recording import read_recording, write_recording
from quest.errors import InputError, RecordingError, TakeError
from quest.types import GUESSED_CAMERA, Camera, Clip, Joints, Query
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_take(frames=12, views=1, size=(64, 48)).views[0].clip


def test_arrays_in_memory(clip: Clip):
    assert clip.depth_m is not None
    depth_m = clip.depth_m.astype(np.float64)
    depth_m[0, 0, :4] = [np.nan, np.inf, -np.inf, -1]
    found = Clip.from_arrays(clip.rgb, depth_m, clip.camera, fps=10)
    assert found.depth_m is not None
    assert found.depth_m.dtype == np.float32
    np.testing.assert_array_equal(found.depth_m[0, 0, :4], 0)
    np.testing.assert_allclose(found.stamp_s[:3], [0, 0.1, 0.2])
    assert found.notes == ()
    plain = Clip.from_arrays(clip.rgb)
    assert plain.depth_m is None
    np.testing.assert_allclose(plain.stamp_s[:3], [0, 1 / 30, 2 / 30])
    np.testing.assert_array_equal(plain.cam_from_world, np.tile(np.eye(4), (12, 1, 1)))


def test_tensors_and_lists(clip: Clip):
    assert clip.depth_m is not None
    expected = Clip.from_arrays(clip.rgb, clip.depth_m, clip.camera, name="mine")
    lists = Clip.from_arrays(list(clip.rgb), list(clip.depth_m), clip.camera, name="mine")
    channels_first = torch.from_numpy(clip.rgb).permute(0, 3, 1, 2)
    tensors = Clip.from_arrays(
        channels_first.permute(0, 2, 3, 1), torch.from_numpy(clip.depth_m).double().requires_grad_(), clip.camera,
        stamp_s=torch.arange(12) / 30, cam_from_world=torch.eye(4), name="mine",
    )  # fmt: skip
    for rgb in (clip.rgb.astype(np.float32) / 255, torch.from_numpy(clip.rgb) / 255):  # from 0 to 1
        np.testing.assert_array_equal(Clip.from_arrays(rgb).rgb, clip.rgb)
    for found in (lists, tensors):
        np.testing.assert_array_equal(found.rgb, expected.rgb)
        np.testing.assert_array_equal(found.depth_m, expected.depth_m)  # type: ignore[arg-type]
        np.testing.assert_allclose(found.stamp_s, expected.stamp_s, atol=1e-6)
        np.testing.assert_array_equal(found.cam_from_world, expected.cam_from_world)


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        (lambda rgb: rgb.transpose(0, 3, 1, 2), r"\[12, 3, 48, 64\].*rgb\.transpose\(0, 2, 3, 1\)"),
        (lambda rgb: rgb[0], r"rgb\[None\]"),
        (lambda rgb: rgb[..., 0], "grey"),
        (lambda rgb: np.concatenate((rgb, rgb[..., :1]), axis=-1), "alpha"),
        (lambda rgb: rgb.astype(np.float32), r"floats from 0 to 1, got floats from \S+ to \d+; .*astype"),
        (lambda rgb: np.full(rgb.shape, np.nan), "floats from nan"),
        (lambda rgb: rgb.astype(np.int64), "got int64"),
        (lambda rgb: [rgb[0], rgb[1, :4]], "one array"),
        (lambda rgb: "video", r"\[T, H, W, 3\], got \[\]"),
    ],
)
def test_colours_of_another_kind(clip: Clip, change, advice: str):
    with pytest.raises(InputError, match=advice):
        Clip.from_arrays(change(clip.rgb))


def test_cameras_of_arrays(clip: Clip):
    guessed = Clip.from_arrays(clip.rgb)
    assert guessed.camera == Camera(64, 64, 32, 24, 64, 48)
    assert guessed.notes == (GUESSED_CAMERA,)
    stated = Clip.from_arrays(clip.rgb, fov_deg=90)
    assert stated.camera.fx == pytest.approx(32)
    assert stated.notes == ()
    upright = Camera.from_fov(48, 64, 90)
    assert (upright.fx, upright.fy, upright.cx, upright.cy) == pytest.approx((32, 32, 24, 32))
    matrix = Clip.from_arrays(clip.rgb, camera=[[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]])
    assert matrix.camera == Camera(50, 51, 32, 24, 64, 48)
    wrong: list[dict[str, Any]] = [{"fov_deg": 180}, {"fov_deg": 60, "camera": clip.camera}, {"camera": np.eye(4)}]
    for how in wrong:
        with pytest.raises(InputError, match=r"field of view|3 x 3"):
            Clip.from_arrays(clip.rgb, **how)


def test_shapes_that_contradict_each_other(clip: Clip):
    assert clip.depth_m is not None
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"depth_m": clip.depth_m[:5]}, "depth of shape"),
        ({"depth_m": clip.depth_m[..., None]}, "depth of shape"),
        ({"camera": Camera.from_fov(48, 64)}, "64 x 48 but the camera is for 48 x 64"),
        ({"stamp_s": np.arange(5.0)}, "12 time stamps"),
        ({"cam_from_world": np.eye(3)}, "12 time stamps and poses"),
        ({"stamp_s": np.arange(12.0), "fps": 10}, "not from both"),
        ({"fps": 0}, "fps > 0"),
        ({"stamp_s": clip.stamp_s[::-1].copy()}, "sort the frames"),
    ]
    for how, what in wrong:
        with pytest.raises(InputError, match=what):
            Clip.from_arrays(clip.rgb, **how)
    with pytest.raises(InputError, match="at least one frame"):
        Clip.from_arrays(clip.rgb[:0])
    with pytest.raises(RecordingError, match=r"depth_scale_m = 0\.001 would give"):
        Clip.from_arrays(clip.rgb, (clip.depth_m * 1000).astype(np.uint16), clip.camera)


def test_intrinsics_of_numpy_are_numbers(clip: Clip, tmp_path: Path):
    fx, cx, cy = np.array([50, 32, 24], dtype=np.float32)
    camera = Camera(fx, fx, cx, cy, np.int64(64), np.int64(48))  # type: ignore[arg-type]
    write_recording(replace(clip, camera=camera), tmp_path / "again")
    assert read_recording(tmp_path / "again").camera == camera
    with pytest.raises(InputError, match=r"whole pixels|int"):
        Camera(50.0, 50.0, 32.0, 24.0, 64.5, 48)  # type: ignore[arg-type]


def test_whatever_can_be_tracked_is_read(clip: Clip, tmp_path: Path):
    write_recording(clip, tmp_path / "mine", rgb="png")
    np.testing.assert_array_equal(quest.read(tmp_path / "mine").rgb, clip.rgb)
    assert quest.read(str(tmp_path / "mine"), camera=Camera.from_fov(64, 48)).camera == Camera.from_fov(64, 48)
    assert quest.read("sample").depth_m is not None
    with pytest.raises(RecordingError, match="no such file or folder"):
        quest.read(tmp_path / "nothing")
    with pytest.raises(RecordingError, match="is for a take"):
        quest.read(tmp_path / "mine", parts=Parts(view=1))
    with pytest.raises(TakeError):
        quest.read(tmp_path / "none.zarr")


def test_what_is_printed_is_short(clip: Clip):
    assert repr(clip.camera) == "Camera(64 x 48 px, fx 72.0, fy 72.0, cx 32.0, cy 24.0)"
    name = repr(clip.name)
    assert repr(clip) == f"Clip({name}, 12 frames of 64 x 48 px, 0.37 s, depth, camera stands still)"
    assert repr(Clip.from_arrays(clip.rgb, name="x")).endswith(f"no depth, camera stands still; {GUESSED_CAMERA})")
    assert repr(Query.point(0, 3.5, 4, name="lid")) == "Query.point(0, 3.5, 4, name='lid')"
    assert repr(Query.semantic("rim", intent="lift")) == "Query.semantic(label='rim', intent='lift')"
    assert repr(Query.slot()) == "Query.slot()"
    joints = replace(
        Joints.unknown(5, 3), kind=("revolute", "prismatic", "unknown"),
        q_min_seen=np.array([0, -0.01, np.nan], np.float32), q_max_seen=np.array([1, 0.2, np.nan], np.float32),
    )  # fmt: skip
    assert repr(joints) == "Joints(revolute 0 to 57 deg, prismatic -0.01 to 0.20 m, unknown)"
    assert joints.describe(0, 2) == "revolute ? deg (0 to 57)"
