"""Clips from arrays in memory, and what clips and cameras are checked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from quest.data.recording import clip_from_arrays, read_recording, write_recording
from quest.errors import InputError, RecordingError
from quest.types import Camera, Clip
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_take(frames=12, views=1, size=(64, 48)).views[0].clip


def test_arrays_in_memory(clip: Clip):
    assert clip.depth_m is not None
    depth_m = clip.depth_m.astype(np.float64)
    depth_m[0, 0, :4] = [np.nan, np.inf, -np.inf, -1]
    found = clip_from_arrays(clip.rgb, depth_m, clip.camera, frames_per_s=10)
    assert found.depth_m is not None
    assert found.depth_m.dtype == np.float32
    np.testing.assert_array_equal(found.depth_m[0, 0, :4], 0)
    np.testing.assert_allclose(found.stamp_s[:3], [0, 0.1, 0.2])
    assert clip_from_arrays(clip.rgb, None, clip.camera).depth_m is None


@pytest.mark.parametrize("how", ["of 0 to 1", "grey", "with alpha"])
def test_colours_of_another_kind(clip: Clip, how: str):
    rgb = {
        "of 0 to 1": clip.rgb.astype(np.float32) / 255,
        "grey": clip.rgb[..., 0],
        "with alpha": np.concatenate((clip.rgb, clip.rgb[..., :1]), axis=-1),
    }[how]
    with pytest.raises((InputError, TypeCheckError), match=r"uint8|UInt8"):
        clip_from_arrays(rgb, None, clip.camera)


def test_intrinsics_of_numpy_are_numbers(clip: Clip, tmp_path: Path):
    fx, cx, cy = np.array([50, 32, 24], dtype=np.float32)
    try:
        camera = Camera(fx, fx, cx, cy, np.int64(64), np.int64(48))  # type: ignore[arg-type]
    except TypeCheckError:
        pytest.skip("types are checked, and these are not those that are asked for")
    write_recording(replace(clip, camera=camera), tmp_path / "again")
    assert read_recording(tmp_path / "again").camera == camera
    with pytest.raises((InputError, TypeCheckError), match=r"whole pixels|int"):
        Camera(50.0, 50.0, 32.0, 24.0, 64.5, 48)  # type: ignore[arg-type]


def test_arrays_in_millimetres(clip: Clip):
    assert clip.depth_m is not None
    with pytest.raises(RecordingError, match=r"depth_scale_m = 0\.001 would give"):
        clip_from_arrays(clip.rgb, (clip.depth_m * 1000).astype(np.uint16), clip.camera)


def test_arrays_without_frames_or_with_unsorted_stamps(clip: Clip):
    with pytest.raises(InputError, match="at least one frame"):
        clip_from_arrays(clip.rgb[:0], None, clip.camera)
    with pytest.raises(InputError, match="sort the frames"):
        clip_from_arrays(clip.rgb, None, clip.camera, stamp_s=clip.stamp_s[::-1].copy())
