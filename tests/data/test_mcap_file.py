"""MCAP: what is exported comes back; files that are torn, empty, not indexed, or of others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.mcap_export import export_mcap
from quest.data.recording import open_recording, read_recording
from quest.errors import InputError, RecordingError
from quest.types import Clip, State, Tracks
from tests.data.bags import write_mcap
from tests.synthetic import make_take

FRAMES = 6


@pytest.fixture(scope="module")
def clip() -> Clip:
    return replace(make_take(frames=FRAMES, views=2, size=(64, 48)).views[1].clip, name="clip")


def moving(clip: Clip) -> Clip:
    poses = clip.cam_from_world.copy()
    angle = np.linspace(0, 0.5, FRAMES)
    turn = np.tile(np.eye(4), (FRAMES, 1, 1))
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(angle)
    turn[:, 0, 2], turn[:, 2, 0] = np.sin(angle), -np.sin(angle)
    return replace(clip, cam_from_world=turn @ poses, stamp_s=clip.stamp_s + 1.7e9)


@pytest.mark.parametrize(("rgb", "depth", "still"), [("jpeg", "16UC1", True), ("raw", "32FC1", False)])
def test_round_trip(clip: Clip, rgb: str, depth: str, still: bool, tmp_path: Path):
    clip = clip if still else moving(clip)
    export_mcap(clip, tmp_path / "clip.mcap", rgb=rgb, depth=depth)  # type: ignore[arg-type]
    source = open_recording(tmp_path / "clip.mcap")
    assert (source.length, source.flags) == (FRAMES, ())
    found = source.clip()
    assert found.name == "clip"
    assert found.camera == clip.camera
    np.testing.assert_allclose(found.stamp_s, clip.stamp_s, atol=1e-6)
    np.testing.assert_allclose(found.cam_from_world, clip.cam_from_world, atol=1e-9)
    assert found.depth_m is not None
    assert clip.depth_m is not None
    if depth == "32FC1":
        np.testing.assert_array_equal(found.depth_m, clip.depth_m)
    else:
        np.testing.assert_allclose(found.depth_m, clip.depth_m, atol=0.51e-3)
    if rgb == "raw":
        np.testing.assert_array_equal(found.rgb, clip.rgb)
    else:
        assert np.abs(found.rgb.astype(int) - clip.rgb).mean() < 6
    assert source.flags == ()


def test_tracks_are_markers_in_the_world(clip: Clip, tmp_path: Path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    points = np.random.default_rng(0).normal(size=(FRAMES, 2, 3)).astype(np.float32)
    points[0, 1] = np.nan
    ones, pixels = np.ones((FRAMES, 2), np.float32), np.zeros((FRAMES, 2, 2), np.float32)
    state = np.full((FRAMES, 2), State.TRACKING.value)
    tracks = Tracks(("left", "right"), ("handle", None), pixels, points, ones, ones > 0, state, clip.stamp_s)
    export_mcap(clip, tmp_path / "clip.mcap", tracks=tracks)
    with (tmp_path / "clip.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        arrays = [found.decoded_message for found in reader.iter_decoded_messages(topics=["/quest/tracks"])]
    assert len(arrays) == FRAMES
    balls = [marker for marker in arrays[3].markers if marker.ns == "points"]
    np.testing.assert_allclose([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in balls], points[3])
    assert {marker.text for marker in arrays[3].markers} == {"", "left tracking", "right tracking"}
    assert [marker.action for marker in arrays[0].markers] == [0, 0, 2, 2]
    assert all(marker.header.frame_id == "world" for marker in arrays[0].markers)
    assert read_recording(tmp_path / "clip.mcap").camera == clip.camera
    short = replace(
        clip, rgb=clip.rgb[:4], depth_m=None, stamp_s=clip.stamp_s[:4], cam_from_world=clip.cam_from_world[:4]
    )
    with pytest.raises(InputError, match=f"tracks of {FRAMES} frames for a clip of 4"):
        export_mcap(short, tmp_path / "short.mcap", tracks=tracks)
    assert not (tmp_path / "short.mcap").exists()
    export_mcap(short, tmp_path / "short.mcap")
    assert read_recording(tmp_path / "short.mcap").depth_m is None
    with pytest.raises(InputError, match="no times before 0"):
        export_mcap(replace(clip, stamp_s=clip.stamp_s - 1), tmp_path / "early.mcap")


def test_the_rosbags_library_reads_it_too(clip: Clip, tmp_path: Path):
    """Another reader than the one that the importer uses."""
    from rosbags.highlevel import AnyReader

    export_mcap(clip, tmp_path / "clip.mcap", rgb="raw")
    with AnyReader([tmp_path / "clip.mcap"]) as reader:
        kinds = {name: topic.msgtype for name, topic in reader.topics.items()}
        assert kinds["/camera/color/image_raw"] == "sensor_msgs/msg/Image"
        assert kinds["/tf_static"] == "tf2_msgs/msg/TFMessage"
        wanted = [c for c in reader.connections if c.topic == "/camera/color/image_raw"]
        _, _, raw = next(iter(reader.messages(connections=wanted)))
        message = reader.deserialize(raw, wanted[0].msgtype)
    np.testing.assert_array_equal(message.data.reshape(48, 64, 3), clip.rgb[0])  # type: ignore[attr-defined]


def test_torn_files(clip: Clip, tmp_path: Path):
    path = tmp_path / "clip.mcap"
    export_mcap(clip, path)
    whole = path.read_bytes()
    spoiled = [whole[: int(len(whole) * keep)] for keep in (0.0, 0.001, 0.3, 0.9, 0.999)]
    for data in (*spoiled, whole[:3000] + b"\xff" * 100 + whole[3100:]):
        path.write_bytes(data)
        with pytest.raises(RecordingError, match=r"clip.mcap.*(mcap recover|record it again)"):
            read_recording(path)


def test_other_files(tmp_path: Path):
    (tmp_path / "words.mcap").write_text("not a recording at all" * 10)
    with pytest.raises(RecordingError, match="not an MCAP file"):
        open_recording(tmp_path / "words.mcap")
    with pytest.raises(RecordingError, match="no messages"):
        open_recording(write_mcap(tmp_path / "empty.mcap", []))


def test_without_an_index(clip: Clip, tmp_path: Path):
    """Recorders may leave out the summary; the file is then read from its beginning to its end."""
    from mcap.reader import make_reader
    from mcap.writer import IndexType, Writer

    export_mcap(clip, tmp_path / "clip.mcap")
    with (tmp_path / "clip.mcap").open("rb") as source, (tmp_path / "bare.mcap").open("wb") as target:
        writer = Writer(
            target,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start("ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schemas[schema.id])
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    bare, whole = (read_recording(tmp_path / name) for name in ("bare.mcap", "clip.mcap"))
    np.testing.assert_array_equal(bare.rgb, whole.rgb)
    np.testing.assert_array_equal(bare.depth_m, whole.depth_m)


@pytest.mark.parametrize(("encoding", "schema"), [("json", "jsonschema"), ("protobuf", "protobuf")])
def test_messages_of_others_are_named(encoding: str, schema: str, tmp_path: Path):
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        kind = writer.register_schema("foxglove.CompressedImage", schema, b"{}")
        channel = writer.register_channel("/camera", encoding, kind)
        writer.add_message(channel, 0, json.dumps({}).encode(), 0)
        writer.finish()
    message = rf"messages are {encoding} with {schema} schemas, expected ROS 2.*/camera \(foxglove.CompressedImage\)"
    with pytest.raises(RecordingError, match=message):
        open_recording(tmp_path / "other.mcap")
