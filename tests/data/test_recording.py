"""Recordings: round trip, other layouts, and every bad input as an error that says what to do."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from quest.data.camera_file import CameraFile, read_camera, write_camera
from quest.data.frame_source import Notes, Parts
from quest.data.recording import open_recording, read_recording, readers, write_recording
from quest.data.registration import Distortion, Rectifier
from quest.data.store import TakeStore
from quest.data.video import write_video
from quest.errors import InputError, RecordingError, TakeError
from quest.types import Camera, Clip
from tests.synthetic import make_take

FRAMES = 8


@pytest.fixture(scope="module")
def clip() -> Clip:
    clip = make_take(frames=FRAMES, views=2, size=(64, 48)).views[1].clip
    return replace(clip, name="recording")


@pytest.fixture(scope="module")
def template(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("template") / "recording"
    write_recording(clip, folder, rgb="png")
    return folder


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    """A recording of PNG frames that a test may spoil."""
    return Path(shutil.copytree(template, tmp_path / "recording"))


def assert_same(found: Clip, expected: Clip) -> None:
    assert found.name == expected.name
    assert found.camera == expected.camera
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    np.testing.assert_array_equal(found.depth_m, expected.depth_m)
    np.testing.assert_array_equal(found.stamp_s, expected.stamp_s)
    np.testing.assert_array_equal(found.cam_from_world, expected.cam_from_world)


def edit_camera(folder: Path, **fields: object) -> None:
    path = folder / "camera.json"
    known = json.loads(path.read_text()) | fields
    path.write_text(json.dumps({key: value for key, value in known.items() if value is not None}))


def write_depth(folder: Path, scale: float, *, dtype: type = np.uint16) -> None:
    """Replace the depth of a recording by a plane that is 2 m away, in other units."""
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.full((48, 64), 2.0 / scale, dtype=dtype))


def test_images_come_back_exactly(folder: Path, clip: Clip, tmp_path: Path):
    assert_same(read_recording(folder), clip)
    edit_camera(folder, pixel_centre="integer")
    assert read_recording(folder).camera.cx == clip.camera.cx + 0.5
    edit_camera(folder, pixel_centre=None, stamp_s=None, fps=10)
    for path in (folder / "rgb").iterdir():
        path.rename(path.with_name(f"frame{int(path.stem)}.png"))
    found = read_recording(folder)
    assert found.camera.cy == clip.camera.cy + 0.5
    np.testing.assert_allclose(found.stamp_s, np.arange(FRAMES) / 10)
    np.testing.assert_array_equal(found.rgb, clip.rgb)
    (folder / "depth").rename(tmp_path / "elsewhere")
    assert read_recording(folder).depth_m is None
    (folder / "camera.json").unlink()
    found = read_recording(folder / "rgb", depth=tmp_path / "elsewhere", camera=clip.camera, depth_scale_m=1e-4)
    np.testing.assert_array_equal(found.depth_m, clip.depth_m)
    np.testing.assert_allclose(found.stamp_s, np.arange(FRAMES) / 30)
    np.testing.assert_array_equal(found.cam_from_world, np.tile(np.eye(4), (FRAMES, 1, 1)))


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_video_comes_back_closely(tmp_path: Path, size: tuple[int, int]):
    clip = replace(make_take(frames=FRAMES, views=1, size=size).views[0].clip, name="video")
    write_recording(clip, tmp_path / "video")
    source = open_recording(tmp_path / "video")
    assert (source.length, source.exact) == (FRAMES, False)
    found = source.clip()
    assert_same(replace(found, rgb=clip.rgb), clip)
    off = found.rgb.astype(int) - clip.rgb
    assert np.abs(off @ [0.299, 0.587, 0.114]).mean() < 2
    # Chroma has half the resolution, so single pixels may be off, but not the colours of the picture.
    assert np.abs(off.mean(axis=(0, 1, 2))).max() < 1.5
    for t, frame in enumerate(source):  # every pass begins anew
        np.testing.assert_array_equal(frame.rgb, found.rgb[t])
    alone = read_recording(tmp_path / "video" / "rgb.mp4")
    assert alone.name == "rgb"
    np.testing.assert_array_equal(alone.rgb, found.rgb)
    assert alone.depth_m is not None
    (tmp_path / "video" / "depth" / "000007.png").unlink()
    with pytest.raises(RecordingError, match="7 depth images for 8 colour frames"):
        read_recording(tmp_path / "video")
    shutil.copy(tmp_path / "video" / "depth" / "000006.png", tmp_path / "video" / "depth" / "000007.png")
    shutil.copy(tmp_path / "video" / "depth" / "000006.png", tmp_path / "video" / "depth" / "000008.png")
    with pytest.raises(RecordingError, match="9 depth images for 8 colour frames"):
        read_recording(tmp_path / "video")


def test_moving_camera_and_far_depth(tmp_path: Path, clip: Clip):
    poses = clip.cam_from_world.copy()
    poses[:, 0, 3] += np.linspace(0, 1, FRAMES)
    assert clip.depth_m is not None
    write_recording(replace(clip, cam_from_world=poses, depth_m=clip.depth_m + 8), tmp_path / "recording", rgb="png")
    found = read_recording(tmp_path / "recording")
    np.testing.assert_array_equal(found.cam_from_world, poses)
    assert found.depth_m is not None
    np.testing.assert_allclose(found.depth_m, clip.depth_m + 8, atol=0.51e-3)


def truncate(path: Path, *, keep: float = 0.6) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])


def empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def resize(path: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    cv2.imwrite(str(path), image[::2, ::2])


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no frames": (lambda f: empty(f / "rgb"), "no frames; expected images in .*rgb"),
    "no colours": (lambda f: shutil.rmtree(f / "rgb"), "no frames; expected images in .*rgb"),
    "two videos": (lambda f: (shutil.rmtree(f / "rgb"), (f / "a.mp4").touch(), (f / "b.mkv").touch()),
                   "expected one video, got a.mp4, b.mkv"),
    "fewer depths": (lambda f: (f / "depth" / "000003.png").unlink(), "7 depth images for 8 colour frames"),
    "fewer colours": (lambda f: (f / "rgb" / "000003.png").unlink(), "stamp_s .* 8 frames, expected 7"),
    "no depths": (lambda f: empty(f / "depth"), "0 depth images for 8 colour frames"),
    "torn colour": (lambda f: truncate(f / "rgb" / "000005.png"), "000005.png: cannot be read.*torn"),
    "torn depth": (lambda f: truncate(f / "depth" / "000005.png"), "000005.png: cannot be read.*torn"),
    "no image": (lambda f: (f / "rgb" / "000005.png").write_text("x"), "000005.png: cannot be.*cannot identify"),
    "sizes differ": (lambda f: resize(f / "rgb" / "000005.png"), "000005.png: 32 x 24, but 000000.png is 64 x 48"),
    "depth of another size": (lambda f: resize(f / "depth" / "000005.png"), "32 x 24, but colour frames are 64 x 48"),
    "depth of 8 bits": (lambda f: write_depth(f, 0.1, dtype=np.uint8), "one channel of 16 bits or floats, got uint8"),
    "depth missing everywhere": (lambda f: write_depth(f, 1e9), "every pixel is missing"),
    "millimetres read as tenths": (lambda f: edit_camera(f, depth_scale_m=1.0), "depth_scale_m = 0.0001 would give"),
    "centimetres read as mm": (lambda f: (write_depth(f, 0.05), edit_camera(f, depth_scale_m=0.001)),
                               "median is 0.04 m with depth_scale_m = 0.001, expected 0.05 to 50 m; the units are"),
    "no camera": (lambda f: (f / "camera.json").unlink(), "depth but no camera.*camera.json beside the frames.*--fov"),
    "torn camera": (lambda f: truncate(f / "camera.json", keep=0.2), "camera.json: cannot be read"),
    "camera is a list": (lambda f: (f / "camera.json").write_text("[]"), "expected an object .* got list"),
    "camera lacks a field": (lambda f: edit_camera(f, fx=None), "lacks fx"),
    "a misspelt field": (lambda f: edit_camera(f, depth_scale=0.001), "has unknown depth_scale; known are"),
    "another size": (lambda f: edit_camera(f, width=640, height=480, cx=320), "64 x 48 but the camera is for 640 x 48"),
    "focal length of nothing": (lambda f: edit_camera(f, fx=0), "of 0.01 to 1,000 times"),
    "focal length is a word": (lambda f: edit_camera(f, fx="wide"), "camera.json: cannot be read.*could not convert"),
    "without end": (lambda f: edit_camera(f, width=float("inf")), "Infinity is no number"),
    "lens without coefficients": (lambda f: edit_camera(f, distortion_model="fisheye"), "without distortion"),
    "too few coefficients": (lambda f: edit_camera(f, distortion=[0.1]), "expected 4 or 5 coefficients, got 1"),
    "depth of nowhere": (lambda f: edit_camera(f, colour_from_depth=np.eye(4).tolist()), "without depth_camera"),
    "half a depth camera": (lambda f: edit_camera(f, depth_camera={"fx": 1}), "depth_camera must be an object of fx"),
    "half a pixel wide": (lambda f: edit_camera(f, width=64.5), "whole pixels"),
    "unknown pixel centre": (lambda f: edit_camera(f, pixel_centre="corner"), "expected 'integer' .* or 'half-intege"),
    "scale of nothing": (lambda f: edit_camera(f, depth_scale_m=0), "depth_scale_m is 0, expected a positive number"),
    "rate of nothing": (lambda f: edit_camera(f, fps=-1), "fps is -1, expected a positive number"),
    "times run backwards": (lambda f: edit_camera(f, stamp_s=list(range(8, 0, -1))), "do not decrease"),
    "pose is not rigid": (lambda f: edit_camera(f, cam_from_world=(2 * np.eye(4)).tolist()), "not a rigid transform"),
    "pose is not a matrix": (lambda f: edit_camera(f, cam_from_world=[1, 2, 3]), "expected one 4 x 4 matrix"),
    "too few poses": (lambda f: edit_camera(f, cam_from_world=[np.eye(4).tolist()] * 3), "3 frames, expected 8"),
}  # fmt: skip


@pytest.mark.parametrize("how", BAD)
def test_bad_recordings(folder: Path, how: str):
    spoil, message = BAD[how]
    spoil(folder)
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(folder)
    assert str(folder.parent) in str(caught.value), "the message names the file"


def test_missing_paths(tmp_path: Path, folder: Path):
    with pytest.raises(RecordingError, match="no such file or folder"):
        read_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"did you mean .*recording\?"):
        read_recording(tmp_path / "recordign")
    with pytest.raises(RecordingError, match="no such folder; expected one 16-bit PNG"):
        read_recording(folder, depth=tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="positive number"):
        read_recording(folder, depth_scale_m=-1.0)


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.95])
def test_torn_videos(tmp_path: Path, clip: Clip, keep: float):
    write_recording(clip, tmp_path / "recording")
    video = tmp_path / "recording" / "rgb.mp4"
    truncate(video, keep=keep)
    with pytest.raises(RecordingError, match=r"rgb\.mp4.*corrupt"):
        read_recording(tmp_path / "recording")


def test_files_that_are_no_videos(folder: Path, tmp_path: Path):
    (folder / "notes.mp4").write_text("hello")
    with pytest.raises(RecordingError, match=r"notes\.mp4: cannot be decoded at all .*corrupt or not a video"):
        open_recording(folder / "notes.mp4")
    with pytest.raises(InputError, match="at least one frame"):
        write_video(tmp_path / "new" / "empty.mp4", [], frames_per_s=30)
    assert list((tmp_path / "new").iterdir()) == []


def test_nothing_is_overwritten(folder: Path, clip: Clip):
    with pytest.raises(InputError, match="not an empty folder"):
        write_recording(clip, folder)
    with pytest.raises(InputError, match="expected a positive number"):
        write_recording(clip, folder / "new", depth_scale_m=0)
    assert not (folder / "new").exists()


def test_frames_come_one_by_one(folder: Path, clip: Clip):
    source = open_recording(folder)
    assert (source.length, source.exact, source.name, source.camera) == (FRAMES, True, "recording", clip.camera)
    (folder / "rgb" / "000005.png").write_bytes(b"torn")
    frames = iter(source)
    for t in range(5):
        frame = next(frames)
        np.testing.assert_array_equal(frame.rgb, clip.rgb[t])
        np.testing.assert_array_equal(frame.cam_from_world, clip.cam_from_world[t])
        assert frame.stamp_s == clip.stamp_s[t]
    with pytest.raises(RecordingError, match=r"000005\.png: cannot be read.*cannot identify"):
        next(frames)


def test_depth_of_another_camera_is_registered(folder: Path):
    half = {"fx": 36, "fy": 36, "cx": 16, "cy": 12, "width": 32, "height": 24}
    shift = np.eye(4)
    shift[0, 3] = 0.02
    edit_camera(folder, depth_camera=half, colour_from_depth=shift.tolist(), depth_scale_m=0.001)
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.full((24, 32), 2000, np.uint16))
    found = read_recording(folder)
    assert found.depth_m is not None
    assert (found.depth_m[:, 4:-4, 6:-6] == 2.0).all()


def test_distorted_frames_are_rectified(folder: Path, clip: Clip):
    lens = Distortion("plumb_bob", (-0.2, 0.05, 0.0, 0.0))
    edit_camera(folder, distortion_model=lens.model, distortion=list(lens.coefficients))
    found = read_recording(folder)
    rectifier = Rectifier(clip.camera, lens)
    assert clip.depth_m is not None
    assert found.depth_m is not None
    np.testing.assert_array_equal(found.rgb[3], rectifier.rgb(clip.rgb[3]))
    np.testing.assert_array_equal(found.depth_m[3], rectifier.depth(clip.depth_m[3]))


def test_camera_files_come_back(tmp_path: Path, clip: Clip):
    shift = np.eye(4)
    shift[1, 3] = -0.01
    small = Camera(30.0, 31.0, 15.5, 12.5, 32, 24)
    lens, other = Distortion("equidistant", (0.1, 0.0, 0.0, 0.0)), Distortion("plumb_bob", (0.1, 0.2, 0.0, 0.0, 0.3))
    written = CameraFile(clip.camera, lens, small, other, shift, depth_scale_m=0.001, frames_per_s=30.0)
    write_camera(written, tmp_path / "camera.json")
    found = read_camera(tmp_path / "camera.json")
    assert (found.distortion, found.depth_camera, found.depth_distortion) == (lens, small, other)
    np.testing.assert_array_equal(found.colour_from_depth, shift)


def test_notes_count_and_begin_anew():
    notes = Notes()
    notes.say("colours only")
    notes.say("colours only")
    notes.count("no depth", 3)
    notes.count("no depth", 5)
    assert notes.words == ("colours only", "no depth: 2 frames, first 3")
    notes.restart()
    assert notes.words == ("colours only",)


def test_colours_without_a_camera_are_read_with_a_guess(folder: Path, clip: Clip, tmp_path: Path):
    write_video(tmp_path / "mine.mp4", clip.rgb, frames_per_s=10)
    for source in (tmp_path / "mine.mp4", folder / "rgb"):
        found = open_recording(source)
        assert found.camera == Camera(64, 64, 32, 24, 64, 48)
        assert any("guessed a focal length of 64 px, the longer side" in flag for flag in found.flags)
        assert found.clip().depth_m is None
        found = open_recording(source, fov_deg=90)
        assert found.camera.fx == pytest.approx(32)
        assert any("a focal length of 32 px from --fov 90" in flag for flag in found.flags)
    np.testing.assert_allclose(read_recording(tmp_path / "mine.mp4").stamp_s, np.arange(FRAMES) / 10)


def test_depth_needs_a_camera_or_a_field_of_view(folder: Path, clip: Clip):
    with pytest.raises(RecordingError, match="--fov is for recordings without a camera"):
        open_recording(folder, fov_deg=60)
    (folder / "camera.json").unlink()
    assert read_recording(folder, fov_deg=60, depth_scale_m=1e-4).depth_m is not None
    with pytest.raises(RecordingError, match="expected a field of view of 1 to 175 degrees, got 0"):
        open_recording(folder, fov_deg=0)


def test_every_reader_says_how_its_recordings_look(tmp_path: Path):
    known = readers()
    assert len({reader.kind for reader in known}) == len(known)
    assert not any(reader.accepts(str(tmp_path)) for reader in known)
    with pytest.raises(RecordingError, match="this is an empty folder; expected ") as caught:
        open_recording(tmp_path)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(RecordingError, match="with nothing of these in it; expected "):
        open_recording(tmp_path)
    assert all(f"{reader.kind} ({reader.form})" in str(caught.value) for reader in known)


def test_takes_are_recordings_too(tmp_path: Path):
    store, take = TakeStore(tmp_path / "takes"), make_take(frames=3, views=2, size=(64, 48), name="a")
    store.write(take)
    with pytest.raises(TakeError, match=r"a store of 1 take \(a\); name one, such as .*takes/a\.zarr"):
        open_recording(store.root)
    store.write(replace(take, info=replace(take.info, name="b")))
    with pytest.raises(TakeError, match=r"a store of 2 takes \(a, b\)"):
        open_recording(store.root)
    found = read_recording(store.root / "b.zarr", parts=Parts(view=1))
    np.testing.assert_array_equal(found.rgb, take.views[1].clip.rgb)
    with pytest.raises(RecordingError, match=r"--camera .* is for .* a LeRobot v3 dataset or .* and this is a take"):
        open_recording(store.root / "b.zarr", camera="c.json")
