"""Recordings in the layouts of others, written here as their recorders do."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quest.data.folder import nearest
from quest.data.pictures import read_depth_file
from quest.data.recording import open_recording, read_recording
from quest.errors import RecordingError
from quest.types import Camera
from tests.data.layout_writers import (
    CAMERA,
    DEPTH_M,
    FRAMES,
    HEIGHT,
    POSES,
    RGB,
    WIDTH,
    exr,
    matrix_as_text,
    nerfstudio,
    open3d,
    record3d,
    rscan,
    scannet,
    seven_scenes,
    stray,
    tum,
)

SEVEN_SCENES = Camera(585.0, 585.0, 320.0, 240.0, WIDTH, HEIGHT)
TUM = Camera(525.0, 525.0, 320.0, 240.0, WIDTH, HEIGHT)
LAYOUTS: dict[str, tuple[Callable[[Path], Path], Camera]] = {
    "TUM RGB-D": (tum, TUM),
    "7-Scenes": (seven_scenes, SEVEN_SCENES),
    "3RScan": (rscan, CAMERA),
    "Open3D": (open3d, CAMERA),
    "ScanNet": (scannet, CAMERA),
    "matrix": (matrix_as_text, CAMERA),
    "Record3D": (record3d, CAMERA),
    "Stray Scanner": (stray, CAMERA),
    "nerfstudio": (nerfstudio, CAMERA),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_as_they_come(name: str, tmp_path: Path):
    write, camera = LAYOUTS[name]
    (tmp_path / "it").mkdir()
    root = write(tmp_path / "it")
    clip = read_recording(root)
    np.testing.assert_allclose(np.array(clip.camera.matrix), camera.matrix, atol=1e-9)
    assert len(clip) == FRAMES
    assert np.abs(clip.rgb.astype(int) - RGB).mean() < (6 if name in ("Stray Scanner", "3RScan") else 1e-9)
    assert clip.depth_m is not None
    small = name in ("Record3D", "Stray Scanner", "3RScan")  # registered: every pixel is drawn as a square
    for t in (0, FRAMES - 1):
        both = (clip.depth_m[t] > 0) & (DEPTH_M > 0)
        assert both.mean() > 0.8
        off = np.abs(clip.depth_m[t] - DEPTH_M)[both]
        assert np.quantile(off, 0.9 if small else 1.0) < (0.06 if small else 1e-5)
        assert (clip.depth_m[t][:40] == 0).all()
    poses = np.linalg.inv(POSES)
    if name == "matrix":
        poses[:] = np.eye(4)
    if name == "ScanNet":
        poses[2] = poses[1]
        assert any("no pose in 1 frame" in note for note in clip.notes)
    np.testing.assert_allclose(clip.cam_from_world, poses, atol=1e-6)
    seconds = np.arange(FRAMES) / (25 if name in ("TUM RGB-D", "Record3D", "Stray Scanner") else 30)
    np.testing.assert_allclose(clip.stamp_s, seconds, atol=1e-6)
    # A camera file of one's own overrules every layout, and poses are kept.
    inner = root / "EXR_RGBD" if (root / "EXR_RGBD").is_dir() else root
    fields = {"fx": 500, "fy": 501, "cx": 320, "cy": 240, "width": WIDTH, "height": HEIGHT}
    (inner / "camera.json").write_text(json.dumps(fields))
    source = open_recording(root)
    assert (source.camera.fx, source.camera.fy) == (500, 501)
    np.testing.assert_allclose(next(iter(source)).cam_from_world, poses[0], atol=1e-6)


def test_lists_of_tum_pair_by_time_whatever_the_names(tmp_path: Path):
    root = tum(tmp_path, "rgbd_dataset_freiburg3_cabinet")
    for kind in ("rgb", "depth"):
        lines = []
        for t, line in enumerate((root / f"{kind}.txt").read_text().splitlines()[1:]):
            seconds, name = line.split()
            (root / name).rename(root / kind / f"{t}.png")
            lines.append(f"{seconds} {kind}/{t}.png")
        (root / f"{kind}.txt").write_text("\n".join(lines))
    source = open_recording(root)
    assert source.camera == Camera(535.4, 539.2, 320.6, 248.1, WIDTH, HEIGHT), "that of freiburg 3 is known"
    assert [frame.depth_m is None for frame in source] == [False, False, False, True, False]
    assert any("no depth" in flag for flag in source.flags)
    assert not any("recommends" in flag for flag in source.flags)


def test_a_camera_of_the_user_keeps_times_poses_and_units(tmp_path: Path):
    root = tum(tmp_path)
    assert any("TUM RGB-D recommends" in flag for flag in open_recording(root).flags)
    clip = read_recording(root, camera=CAMERA)
    assert clip.camera == CAMERA
    assert clip.depth_m is not None
    assert np.median(clip.depth_m[0][DEPTH_M > 0]) == pytest.approx(np.median(DEPTH_M[DEPTH_M > 0]), abs=1e-3)
    np.testing.assert_allclose(clip.cam_from_world, np.linalg.inv(POSES), atol=1e-6)
    assert clip.stamp_s[-1] == pytest.approx(0.16)


@pytest.mark.parametrize("suffix", [".tiff", ".exr", ".npy"])
def test_floats_are_metres(suffix: str, tmp_path: Path):
    root = open3d(tmp_path)
    for file in (root / "depth").iterdir():
        file.unlink()
    for t in range(FRAMES):
        path = root / "depth" / f"{t:06d}{suffix}"
        metres = DEPTH_M.astype(np.float32)
        if suffix == ".exr":
            exr(path, metres)
        elif suffix == ".npy":
            np.save(path, metres)
        else:
            Image.fromarray(metres).save(path)
    clip = read_recording(root)
    assert clip.depth_m is not None
    np.testing.assert_allclose(clip.depth_m[0], DEPTH_M, atol=1e-6)


def test_a_stray_scan_with_fewer_depth_pictures_is_cut_and_says_so(tmp_path: Path):
    root = stray(tmp_path)
    (root / "depth" / f"{FRAMES - 1:06d}.png").unlink()
    clip = read_recording(root)
    assert len(clip) == FRAMES - 1
    assert any("the first 4 are read" in note for note in clip.notes)


def test_poses_of_nerfstudio_without_depth_are_not_used(tmp_path: Path):
    root = nerfstudio(tmp_path)
    fields = json.loads((root / "transforms.json").read_text())
    for frame in fields["frames"]:
        del frame["depth_file_path"]
    (root / "transforms.json").write_text(json.dumps(fields))
    clip = read_recording(root)
    assert (clip.cam_from_world == np.eye(4)).all()
    assert any("unknown scale" in note for note in clip.notes)


BROKEN: dict[str, tuple[Callable[[Path], Path], str, Callable[[str], str]]] = {
    "TUM: a path that leads out": (tum, "rgb.txt", lambda text: text.replace("rgb/13", "../13", 1)),
    "TUM: three columns": (tum, "rgb.txt", lambda text: text + "1.0 a b\n"),
    "TUM: nothing listed": (tum, "rgb.txt", lambda text: "#\n"),
    "TUM: quaternions of zeros": (tum, "groundtruth.txt", lambda text: re.sub(r"( \S+){4}\n", " 0 0 0 0\n", text)),
    "Open3D: no matrix": (open3d, "intrinsic.json", lambda text: text.replace("intrinsic_matrix", "matrix")),
    "Open3D: a list": (open3d, "intrinsic.json", lambda text: "[]"),
    "matrix: letters": (matrix_as_text, "K.txt", lambda text: "fx fy cx"),
    "matrix: another camera": (matrix_as_text, "K.txt", lambda text: "0 0 0\n0 0 0\n0 0 0"),
    "Record3D: no JSON": (record3d, "EXR_RGBD/metadata.json", lambda text: text.replace('"K": [5', '"K": [[5')),
    "Stray: no such column": (stray, "odometry.csv", lambda text: text.replace("qw", "w")),
    "Stray: one row too short": (stray, "odometry.csv", lambda text: text + "1, 2\n"),
    "nerfstudio: no frames": (nerfstudio, "transforms.json", lambda text: text.replace('"frames"', '"images"')),
    "nerfstudio: out": (nerfstudio, "transforms.json", lambda text: text.replace("images/frame_00003", "/etc/frame")),
    "3RScan: no depth": (rscan, "_info.txt", lambda text: text.replace("m_depthWidth", "m_width")),
}  # fmt: skip


@pytest.mark.parametrize("how", BROKEN)
def test_broken_files_are_named(how: str, tmp_path: Path):
    write, name, spoil = BROKEN[how]
    root = write(tmp_path)
    file = root / name
    spoilt = spoil(file.read_text())
    assert spoilt != file.read_text()
    file.write_text(spoilt)
    with pytest.raises(RecordingError, match=re.escape(file.name)):
        read_recording(root)


def test_other_files_beside_a_recording_do_not_change_what_it_is(tmp_path: Path):
    root = open3d(tmp_path)
    (root / "metadata.json").write_text('{"scene": "kitchen"}')
    (root / "odometry.csv").write_text("t, x\n")
    assert open_recording(root).length == FRAMES


def test_lists_of_many_frames_are_matched_in_little_memory():
    times = np.arange(200_000) / 30
    np.testing.assert_array_equal(nearest(times, times + 0.01), np.arange(200_000))
    np.testing.assert_array_equal(nearest(np.array([1.0]), np.array([0.0, 5.0])), [0, 0])


def test_files_that_are_refused(tmp_path: Path):
    exr(tmp_path / "d.exr", np.ones((4, 4)))
    data = (tmp_path / "d.exr").read_bytes()
    window = np.array([0, 0, 3, 3], "<i4").tobytes()
    (tmp_path / "d.exr").write_bytes(data.replace(window, np.array([0, 0, 99999, 99999], "<i4").tobytes()))
    with pytest.raises(RecordingError, match="10000000000 pixels"):  # an EXR that claims to be huge
        read_depth_file(tmp_path / "d.exr")
    (tmp_path / "scan.r3d").write_bytes(b"PK")
    with pytest.raises(RecordingError, match=r"EXR \+ RGB"):
        open_recording(tmp_path / "scan.r3d")
