"""ROS bags: the same frames however they are stored; encodings, pairing in time, tf, lenses, and what is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quest.data import bags
from quest.data.frame_source import Parts
from quest.data.recording import open_recording, read_recording
from quest.data.registration import Distortion, Rectifier
from quest.data.ros_frames import CAMERA_CHANGED, LATE, NO_DEPTH, NO_POSE, NO_STAMP, _Play
from quest.errors import RecordingError
from quest.types import Camera
from tests.data.bags import (
    BEGIN,
    CAMERA,
    COLOUR,
    COLOUR_FRAME,
    COLOUR_INFO,
    DEPTH,
    DEPTH_FRAME,
    DEPTH_INFO,
    DEPTH_MM,
    FRAMES,
    IMAGE,
    INFO,
    OPTICAL,
    RGB,
    SECOND,
    STEP,
    TF,
    WRITERS,
    Sent,
    base_at,
    camera_info,
    colours,
    compressed,
    depths,
    frames_of,
    image,
    info,
    recording,
    transform,
    write_bag,
    write_mcap,
    write_ros1,
)


@pytest.mark.parametrize("writer", WRITERS.values(), ids=WRITERS.keys())
def test_every_storage_gives_the_same_frames(writer: Callable[[Path, Sequence[Sent]], Path], tmp_path: Path):
    source = open_recording(writer(tmp_path, recording()))
    assert (source.name, source.length) == ("bag", FRAMES)
    clip = source.clip()
    assert source.flags == ()
    assert clip.camera == CAMERA
    np.testing.assert_array_equal(clip.rgb, RGB)
    assert clip.depth_m is not None
    np.testing.assert_allclose(clip.depth_m, DEPTH_MM / 1000, atol=1e-6)
    np.testing.assert_allclose(clip.stamp_s, [(BEGIN + t * STEP) * 1e-9 for t in range(FRAMES)], atol=1e-6)
    for t in range(FRAMES):
        world_from_cam = base_at(t * STEP / SECOND)
        world_from_cam[:3, 3] += world_from_cam[:3, :3] @ [0.1, 0.02, 0.5]
        world_from_cam[:3, :3] = world_from_cam[:3, :3] @ OPTICAL[:3, :3]
        np.testing.assert_allclose(clip.cam_from_world[t], np.linalg.inv(world_from_cam), atol=2e-4)


def test_frames_come_before_the_bag_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_mcap(tmp_path / "bag.mcap", recording(), chunk_size=4096)
    read, original = [], bags._read_mcap

    def counted(*arguments: Any) -> Any:
        for found in original(*arguments):
            read.append(found[0])
            yield found

    source = open_recording(path)
    monkeypatch.setattr(bags, "_read_mcap", counted)
    iterator = iter(source)
    next(iterator)
    assert read.count(COLOUR) <= 3
    assert len(list(iterator)) == FRAMES - 1
    assert len(list(source)) == FRAMES, "a second pass begins anew"


def test_the_nearest_depth_in_time_is_taken(tmp_path: Path):
    sent = [info(), *(colours(t) for t in range(4))]
    sent += [depths(0, at_ns=BEGIN + 15 * STEP // 100), depths(1, at_ns=BEGIN + 95 * STEP // 100)]
    sent += [depths(2, at_ns=BEGIN + 2 * STEP + STEP // 2)]  # 25 ms from both its neighbours
    path = write_mcap(tmp_path / "bag.mcap", sorted(sent, key=lambda one: one[3]))
    frames, flags = frames_of(path)
    found = [None if f.depth_m is None else round(float(f.depth_m[5, 5]) * 1000) for f in frames]
    assert found == [DEPTH_MM[0, 5, 5], DEPTH_MM[1, 5, 5], None, None]
    assert "no depth within 0.02 s of the colours: 2 frames, first 2" in flags
    frames, flags = frames_of(path, sync_s=0.03)
    assert all(frame.depth_m is not None for frame in frames)
    assert flags == (NO_POSE,)
    clip = read_recording(path)
    assert clip.depth_m is not None
    assert (clip.depth_m[2] == 0).all(), "a clip has zeros where depth is missing"


def test_depth_before_the_first_colours_is_not_kept(tmp_path: Path):
    """However long the depth camera runs alone, memory stays as it is."""
    early = [depths(0, at_ns=BEGIN - i * STEP) for i in range(200, 0, -1)]
    source = open_recording(write_mcap(tmp_path / "bag.mcap", [info(), *early, colours(0), depths(0)]))
    held = []
    original = _Play.take

    def watched(self: _Play, topic: str, log_ns: int, message: Any) -> None:
        original(self, topic, log_ns, message)
        held.append(len(self.depths))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(_Play, "take", watched)
        (frame,) = source
    assert len(held) > 200
    assert max(held) < 100
    assert frame.depth_m is not None


def test_depth_of_another_camera_is_registered(tmp_path: Path):
    """A wall 2 m in front of the colours; the depth camera sits 5 cm to the left and has half the pixels."""
    half = Camera(20.0, 20.5, 8.1, 6.05, 16, 12)
    colour_from_depth = np.eye(4)
    colour_from_depth[0, 3] = -0.05
    wall = image(np.full((12, 16), 2000, np.uint16), "16UC1", BEGIN, frame=DEPTH_FRAME)
    static = ("/tf_static", TF, transform(COLOUR_FRAME, DEPTH_FRAME, colour_from_depth, BEGIN), BEGIN)
    depth_info = (DEPTH_INFO, INFO, camera_info(half, BEGIN, frame=DEPTH_FRAME), BEGIN)
    sent = [static, info(), depth_info, colours(0), (DEPTH, IMAGE, wall, BEGIN)]
    frames, _ = frames_of(write_mcap(tmp_path / "bag.mcap", sent))
    assert frames[0].depth_m is not None
    assert (frames[0].depth_m[4:-4, 4:-4] == 2.0).all()
    with pytest.raises(RecordingError, match=r"no tf joins the depth's frame 'camera_depth_optical_frame'.*tf_static"):
        open_recording(write_mcap(tmp_path / "bag.mcap", sent[1:]))
    with pytest.raises(RecordingError, match=r"no camera_info for /camera/depth.*--topic-depth-info"):
        open_recording(write_mcap(tmp_path / "bag.mcap", [static, info(), colours(0), (DEPTH, IMAGE, wall, BEGIN)]))
    frames, flags = frames_of(write_mcap(tmp_path / "bag.mcap", sent[1:]), topic_depth="none")
    assert frames[0].depth_m is None
    assert NO_DEPTH in flags


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0)),
        ("plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),  # some drivers send more zeros
        ("rational_polynomial", (0.4, 0.1, 0.0, 0.0, 0.0, 0.6, 0.1, 0.0)),
        ("equidistant", (0.01, 0.0, 0.0, 0.0)),
    ],
)
def test_distorted_colours_are_rectified(model: str, d: tuple[float, ...], tmp_path: Path):
    frames, _ = frames_of(write_mcap(tmp_path / "bag.mcap", [info(model=model, d=d), colours(0)]))
    lens = Distortion(model, d[:5] if model == "plumb_bob" else d)
    np.testing.assert_array_equal(frames[0].rgb, Rectifier(CAMERA, lens).rgb(RGB[0]))
    assert (frames[0].rgb != RGB[0]).any()


def test_regions_of_interest_and_binning_move_the_camera(tmp_path: Path):
    whole = Camera(160.0, 164.0, 100.5, 70.5, 200, 150)
    roi = {"x_offset": 40, "y_offset": 30, "height": 96, "width": 128, "do_rectify": False}
    sensor = camera_info(whole, BEGIN) | {"roi": roi, "binning_x": 4, "binning_y": 4}
    path = write_mcap(tmp_path / "a.mcap", [(COLOUR_INFO, INFO, sensor, BEGIN), colours(0)])
    assert open_recording(path).camera == Camera(40.0, 41.0, 15.125, 10.125, 32, 24)
    # A driver that says so but has it in its numbers already.
    done = camera_info(CAMERA, BEGIN) | {"binning_x": 4, "binning_y": 4}
    path = write_mcap(tmp_path / "b.mcap", [(COLOUR_INFO, INFO, done, BEGIN), colours(0)])
    assert open_recording(path).camera == CAMERA


def test_rectified_topics_use_the_projection_matrix(tmp_path: Path):
    message = camera_info(CAMERA, BEGIN, d=(-0.3, 0.1, 0.0, 0.0, 0.0))
    message["p"][0] = 55.0
    topic = "/camera/color/image_rect_color"
    sent = [(COLOUR_INFO, INFO, message, BEGIN), (topic, IMAGE, image(RGB[0], "rgb8", BEGIN), BEGIN)]
    source = open_recording(write_mcap(tmp_path / "bag.mcap", sent))
    assert source.camera.fx == 55.0
    np.testing.assert_array_equal(next(iter(source)).rgb, RGB[0])


def test_times_of_logging_where_headers_have_none(tmp_path: Path):
    sent = [info()]
    for t in range(3):
        at = BEGIN + t * STEP
        sent.append(("/tf", TF, transform("odom", COLOUR_FRAME, base_at(t), 0), at))
        sent.append((COLOUR, IMAGE, image(RGB[t], "rgb8", 0), at + STEP // 10))
    frames, flags = frames_of(write_mcap(tmp_path / "bag.mcap", sent))
    assert NO_STAMP in flags
    np.testing.assert_allclose(np.diff([frame.stamp_s for frame in frames]), 0.05, atol=1e-6)
    # Between two transforms, a tenth on; the last frame has the last one.
    np.testing.assert_allclose(np.linalg.inv(frames[2].cam_from_world), base_at(2), atol=1e-6)
    assert not np.allclose(frames[0].cam_from_world, frames[1].cam_from_world)
    # A clock that begins at zero is kept.
    sent = [info()] + [(COLOUR, IMAGE, image(RGB[t], "rgb8", t * STEP), BEGIN + t * STEP) for t in range(3)]
    frames, flags = frames_of(write_mcap(tmp_path / "zero.mcap", sent))
    assert [round(frame.stamp_s, 6) for frame in frames] == [0.0, 0.05, 0.1]
    assert NO_STAMP not in flags


def test_world_frame(tmp_path: Path):
    path = write_mcap(tmp_path / "bag.mcap", recording())
    frames, _ = frames_of(path, world_frame="base")
    np.testing.assert_allclose(frames[0].cam_from_world, frames[-1].cam_from_world)
    with pytest.raises(RecordingError, match=r"no tf joins .* to 'map' \(--world-frame\); it hangs on 'odom'"):
        frames_of(path, world_frame="map")


def test_tf_that_ends_early_is_said(tmp_path: Path):
    sent = [one for one in recording() if one[0] != "/tf" or one[3] < BEGIN + STEP // 2]
    sent += [colours(0, at_ns=BEGIN + 2 * SECOND), depths(0, at_ns=BEGIN + 2 * SECOND)]
    frames, flags = frames_of(write_mcap(tmp_path / "bag.mcap", sent))
    assert len(frames) == FRAMES + 1
    assert flags == (f"tf has nothing within 0.5 s: the nearest pose is used: 1 frame, first {FRAMES}",)


def test_what_changes_on_the_way_is_said(tmp_path: Path):
    late = (COLOUR, IMAGE, image(RGB[0], "rgb8", BEGIN), BEGIN + STEP + 1)
    other = info(1, Camera(80.0, 80.0, 16, 12, 32, 24))
    frames, flags = frames_of(write_mcap(tmp_path / "bag.mcap", [info(), colours(1), late, other, colours(2)]))
    assert len(frames) == 2
    assert f"{LATE}: 1 frame, first 1" in flags
    assert CAMERA_CHANGED in flags


def test_topics_are_chosen_by_name_where_several_could_be(tmp_path: Path):
    aligned = "/camera/aligned_depth_to_color/image_raw"
    infrared = ("/camera/infra1/image_rect_raw", IMAGE, image(RGB[0][..., 0], "mono8", BEGIN), BEGIN)
    other_depth = (DEPTH, IMAGE, image(DEPTH_MM[1], "16UC1", BEGIN, frame=DEPTH_FRAME), BEGIN)
    path = write_mcap(tmp_path / "bag.mcap", [info(), colours(0), infrared, depths(0, topic=aligned), other_depth])
    frames, _ = frames_of(path)
    np.testing.assert_array_equal(frames[0].rgb, RGB[0])
    assert frames[0].depth_m is not None
    np.testing.assert_allclose(frames[0].depth_m, DEPTH_MM[0] / 1000, atol=1e-6)


def sent_colours(fields: dict[str, Any], after: int = 0) -> Sent:
    return COLOUR, IMAGE, fields, BEGIN + after


def sent_compressed(topic: str, data: bytes, kind: str) -> Sent:
    return topic, "sensor_msgs/msg/CompressedImage", compressed(data, kind, BEGIN), BEGIN


METRES = image((DEPTH_MM[0] * 1.0).astype(np.float32), "32FC1", BEGIN)
BAD: dict[str, tuple[list[Sent], dict[str, Any], str]] = {
    "no images": ([info()], {}, r"no topic of colour images.*topics found: /camera/color/camera_info"),
    "two cameras": ([info(), colours(0), ("/wrist/color/image_raw", IMAGE, image(RGB[1], "rgb8", BEGIN), BEGIN)], {},
                    "several topics may be the colours: /camera/color.*, /wrist.*--topic-rgb"),
    "no such topic": ([info(), colours(0)], {"topic_rgb": "/nothing"},
                      r"no topic /nothing \(--topic-rgb\); topics found: .*image_raw \(sensor_msgs/Image, 1\)"),
    "topic of another type": ([info(), colours(0)], {"topic_rgb": COLOUR_INFO},
                              "is of type sensor_msgs/CameraInfo, expected sensor_msgs/Image"),
    "no camera_info": ([colours(0)], {}, "no camera_info for /camera/color/image_raw.*--camera FILE"),
    "never calibrated": ([(COLOUR_INFO, INFO, camera_info(CAMERA, BEGIN) | {"k": [0.0] * 9}, BEGIN), colours(0)], {},
                         "never calibrated"),
    "camera of another size": ([info(camera=Camera(40.0, 40.0, 32.0, 24.0, 64, 48)), colours(0)], {},
                               "is 32 x 24 but its camera is for 64 x 48"),
    "unknown lens": ([info(model="omni", d=(0.1, 0.2)), colours(0)], {}, "distortion model 'omni' is unknown"),
    "mixed sizes": ([info(), colours(0), sent_colours(image(RGB[1, ::2, ::2], "rgb8", BEGIN + STEP), STEP)], {},
                    "message 1 of /camera/color/image_raw: colours: 16 x 12, but the camera is for 32 x 24"),
    "torn image": ([info(), colours(0), colours(1, data=b"abc")], {},
                   "message 1 of /camera/color/image_raw: 3 bytes for 32 x 24 pixels"),
    "torn JPEG": ([info(), sent_compressed(COLOUR + "/compressed", b"no", "jpeg")], {}, "2 bytes are no JPEG or PNG"),
    "time goes back": ([info(), colours(0), sent_colours(image(RGB[1], "rgb8", BEGIN - 9 * SECOND), STEP)], {},
                       r"message 1 of /camera/color/image_raw: time goes back by 9.000 s; cut the bag"),
    "depth is no depth": ([info(), colours(0), depths(0), ("/b/image", IMAGE, image(RGB[1], "rgb8", BEGIN), BEGIN)],
                          {"topic_rgb": COLOUR, "topic_depth": "/b/image"}, "encoding 'rgb8' is not one of depth"),
    "colours are no colours": ([info(), colours(0), depths(0)], {"topic_rgb": DEPTH, "topic_info": COLOUR_INFO},
                               "encoding '16UC1' is not one of colours"),
    "wrong units": ([info(), colours(0), (DEPTH, IMAGE, METRES, BEGIN)], {},
                    "the units are wrong, depth_scale_m = 0.001 would give 1.8"),
    "torn RVL": ([info(), colours(0), sent_compressed(DEPTH + "/compressedDepth", b"0" * 99,
                                                      "16UC1; compressedDepth rvl")], {},
                 "cannot be read .*the message is torn"),
}  # fmt: skip


@pytest.mark.parametrize("how", BAD)
def test_what_is_refused(how: str, tmp_path: Path):
    sent, parts, message = BAD[how]
    path = write_mcap(tmp_path / "bag.mcap", sent)
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(path, parts=Parts(**parts))
    assert "bag" in str(caught.value)


def test_empty_and_torn_folders(tmp_path: Path):
    with pytest.raises(RecordingError, match="has no topics"):
        open_recording(write_bag(tmp_path / "empty", []))
    path = write_bag(tmp_path / "torn.mcap", recording())  # a folder may be named like a file
    assert open_recording(path).length == FRAMES
    (database,) = path.glob("*.db3")
    database.write_bytes(database.read_bytes()[:8000])
    with pytest.raises(RecordingError, match=r"the bag is corrupt.*reindex"):
        read_recording(path)
    for spoil in (database.unlink, lambda: (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")):
        spoil()
        with pytest.raises(RecordingError, match="cannot be read"):
            read_recording(path)
    path = write_ros1(tmp_path / "bag.bag", recording())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(RecordingError, match=r"the bag is corrupt.*`rosbag reindex`"):
        read_recording(path)
    (tmp_path / "drive.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(RecordingError, match="rosbag reindex"):
        open_recording(tmp_path / "drive.bag.active")


def test_arguments_are_checked(tmp_path: Path):
    path = write_mcap(tmp_path / "bag.mcap", [info(), colours(0), depths(0)])
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(RecordingError, match=r"depth_scale_m is .*, expected a positive number"):
            open_recording(path, depth_scale_m=scale)
    with pytest.raises(RecordingError, match="is for a folder or video, and this is an MCAP file"):
        open_recording(path, depth=tmp_path)
    found = read_recording(path, depth_scale_m=1e-4)
    assert found.depth_m is not None
    np.testing.assert_allclose(found.depth_m[0], DEPTH_MM[0] / 10_000, atol=1e-6)
    other = Camera(50.0, 50.0, 16.0, 12.0, 32, 24)
    assert open_recording(write_mcap(tmp_path / "bare.mcap", [colours(0)]), camera=other).camera == other


@pytest.mark.parametrize("d", [(0.0,) * 5, (-0.1, 0.02, 0.0, 0.0, 0.0)])
def test_a_camera_file_overrules_the_camera_of_registered_depth(d: tuple[float, ...], tmp_path: Path):
    other = Camera(50.0, 50.0, 16.0, 12.0, 32, 24)
    aligned = "/camera/aligned_depth_to_color"
    own = (f"{aligned}/camera_info", INFO, camera_info(CAMERA, BEGIN, d=d), BEGIN)
    sent = [info(d=d), own, colours(0), depths(0, topic=f"{aligned}/image_raw")]
    found = read_recording(write_mcap(tmp_path / "bag.mcap", sent), camera=other)
    assert found.depth_m is not None
    np.testing.assert_allclose(found.depth_m[0], DEPTH_MM[0] / 1000, atol=1e-6)
    sent[1] = (f"{aligned}/camera_info", INFO, camera_info(Camera(20.0, 20.0, 16, 12, 32, 24), BEGIN), BEGIN)
    found = read_recording(write_mcap(tmp_path / "bag.mcap", sent), camera=other)
    assert found.depth_m is not None
    assert (found.depth_m[0] != DEPTH_MM[0] / np.float32(1000)).any(), "depth of another lens is registered"
