"""The node between a fake rclpy and the tracker: topics, transports, parameters, services, threads."""

from __future__ import annotations

import importlib
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quest.track import Tracker
from quest.types import Clip
from tests.data.bags import COLOUR, COLOUR_FRAME, COLOUR_INFO, DEPTH, png
from tests.ros.fake_rclpy import Network, install
from tests.ros.played import START_NS, bag_of, play
from tests.ros.ros_types import types_of

REMAPPED = {"image": COLOUR, "depth": DEPTH, "camera_info": COLOUR_INFO}


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch, tracker: Tracker) -> Network:
    network = install(monkeypatch, types_of("jazzy"))
    network.remapped, network.now_ns = REMAPPED, START_NS
    network.parameters = {"points": ["20,30,mine"]}
    monkeypatch.setattr("quest.track.load", lambda *_, **__: tracker)
    return network


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, Any, int]]:
    """Noise that moves, small and quick to track."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (64, 96, 3), np.uint8)
    clip = Clip.from_arrays(
        np.stack([np.roll(picture, t, axis=1) for t in range(4)]), np.full((4, 64, 96), 1.5), fov_deg=60
    )
    return list(play(bag_of(clip, 4, tmp_path_factory.mktemp("node") / "bag")))


def make_node() -> Any:
    return importlib.import_module("quest_ros.node").QuestNode()


def test_topics_services_and_quality_of_service(network: Network):
    network.parameters["world_frame"] = "map"
    node = make_node()
    profiles = {topic: each.profile for topic, each in network.subscriptions.items()}
    assert profiles.keys() == {COLOUR, DEPTH, COLOUR_INFO, "/tf", "/tf_static"}
    assert {profiles[topic] for topic in (COLOUR, DEPTH, COLOUR_INFO)} == {"sensor data"}
    assert profiles["/tf_static"].durability == "transient local"
    services = ("add", "answer_alarm", "rename", "reset", "retire")
    assert network.services.keys() == {f"/quest/{name}" for name in services}
    assert all(descriptor.read_only for descriptor in node.declared.values())
    # What waits for the tracker must not keep pictures waiting.
    groups = {id(group) for _, _, group in network.services.values()} | {id(timer.group) for timer in network.timers}
    assert len(groups) == 1


def test_messages_become_tracks_markers_and_diagnostics(network: Network, messages: Any):
    node = make_node()
    for topic, message, _ in messages[:3]:
        network.send(topic, message)
    node.track()
    tracks = network.last("/quest/tracks")
    assert [(track.name, track.x_px, track.y_px) for track in tracks.tracks] == [("mine", 20.0, 30.0)]
    assert tracks.header.frame_id == COLOUR_FRAME
    assert len(network.last("/quest/markers").markers) == 2
    told = [status.name for status in network.last("/diagnostics").status]
    assert told == ["quest: input", "quest: tracker", "quest: mine"]
    assert any(level == "info" and "stream 0 begins" in text for level, text in network.logged)
    published = len(network.published)
    node.track()
    assert len(network.published) == published  # nothing came, and there is no news
    network.timers[0].callback()
    assert network.published[published:][0][0] == "/diagnostics"
    assert network.call("/quest/retire", query=-1, name="mine").success
    assert network.call("/quest/reset").success


def test_compressed_topics_are_beside_the_raw_ones(network: Network, messages: Any):
    network.parameters |= {"image_transport": "compressed", "depth_transport": "compressedDepth", "online_s": 0}
    node, types = make_node(), types_of("jazzy")
    assert network.subscriptions.keys() == {f"{COLOUR}/compressed", f"{DEPTH}/compressedDepth", COLOUR_INFO}
    pixels = np.frombuffer(messages[1][1].data, np.uint8).reshape(64, 96, 3)
    units = np.full((64, 96), 1500, np.uint16)
    network.send(COLOUR_INFO, messages[0][1])
    for topic, form, data in (
        (f"{COLOUR}/compressed", "rgb8; png compressed bgr8", png(pixels[..., ::-1])),
        (f"{DEPTH}/compressedDepth", "16UC1; compressedDepth png", bytes(12) + png(units)),
    ):
        message = types("sensor_msgs/msg/CompressedImage")(format=form)
        message.data.frombytes(data)
        message.header.frame_id, message.header.stamp.sec = COLOUR_FRAME, START_NS // 10**9
        network.send(topic, message)
    node.track()
    assert network.last("/quest/tracks").has_depth
    assert network.last("/quest/tracks").tracks[0].point.z == pytest.approx(1.5)


def test_main_tracks_in_a_thread_until_shut_down(network: Network, messages: Any):
    tracked = threading.Event()

    def spin() -> None:
        for topic, message, _ in messages:
            network.send(topic, message)
        for _ in range(200):
            if any(topic == "/quest/tracks" for topic, _ in network.published):
                tracked.set()
                break
            threading.Event().wait(0.05)
        raise KeyboardInterrupt

    network.spin = spin
    assert importlib.import_module("quest_ros.node").main([]) == 0
    assert tracked.is_set()
    assert not network.alive


@pytest.mark.parametrize(("name", "value"), [("alpha", 2.0), ("weights", "none.safetensors")])
def test_main_says_what_is_wrong_with_a_parameter(tmp_path: Path, name: str, value: Any):
    with pytest.MonkeyPatch.context() as patch:
        network = install(patch, types_of("humble"))
        network.parameters[name] = str(tmp_path / value) if name == "weights" else value
        assert importlib.import_module("quest_ros.node").main([]) == 1
    assert [level for level, _ in network.logged] == ["fatal"]
    assert str(value if name == "weights" else name) in network.logged[0][1]
    assert not network.alive
