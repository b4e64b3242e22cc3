"""The node: topics, services, parameters and threads of ROS around :class:`quest_ros.tracking.Tracking`."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from quest_msgs.msg import Tracks
from quest_msgs.srv import AddQuery, AnswerAlarm, RenameQuery, RetireQuery
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from quest.errors import QuestError
from quest.track import load
from quest_ros.settings import RAW, Settings
from quest_ros.tracking import Tracking

TELL_S = 1.0
"""Time between diagnostics without news."""


def message_class(name: str) -> Any:
    """Class of messages of a name such as ``sensor_msgs/msg/Image``."""
    package, kind, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), message)


class QuestNode(Node):
    """Tracks the pictures of one camera.

    Raises:
        QuestError: parameters are not as expected, or the weights cannot be loaded.
    """

    def __init__(self) -> None:
        super().__init__("quest")
        settings = self._settings()
        monitor = Path(settings.monitor) if settings.monitor else True
        tracker = load(settings.weights, device=settings.device, monitor=monitor)
        image = self.resolve_topic_name("image")
        self.tracking = Tracking(tracker, settings, message_class, name=self.get_name(), topic=image)
        self._arrived, self._closing = threading.Event(), threading.Event()
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._tracks = self.create_publisher(Tracks, "~/tracks", 10)
        self._markers = self.create_publisher(MarkerArray, "~/markers", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._subscribe(settings, image)
        # Requests and diagnostics wait for the picture that is being tracked; those that come must not wait for them.
        slow = MutuallyExclusiveCallbackGroup()
        for kind, name, answer in (
            (AddQuery, "~/add", self.tracking.add),
            (RetireQuery, "~/retire", self.tracking.retire),
            (RenameQuery, "~/rename", self.tracking.rename),
            (AnswerAlarm, "~/answer_alarm", self.tracking.answer_alarm),
            (Trigger, "~/reset", self.tracking.reset),
        ):
            self.create_service(kind, name, answer, callback_group=slow)
        self.create_timer(TELL_S, self._tell, callback_group=slow)
        self.get_logger().info(f"tracking {image} with {tracker!r}")

    def _settings(self) -> Settings:
        values = {}
        for field in fields(Settings):
            default = [""] if isinstance(field.default, tuple) else field.default
            # Whole numbers are numbers too; and what is read once is not to be set later.
            descriptor = ParameterDescriptor(read_only=True, dynamic_typing=isinstance(default, float))
            values[field.name] = self.declare_parameter(field.name, default, descriptor).value
        return Settings.from_parameters(values)

    def _subscribe(self, settings: Settings, image: str) -> None:
        tracking, newest = self.tracking, qos_profile_sensor_data
        topics = [(image, settings.image_transport, tracking.take_colours)]
        if settings.use_depth:
            topics.append((self.resolve_topic_name("depth"), settings.depth_transport, tracking.take_depth))
        for topic, transport, take in topics:
            kind, topic = (Image, topic) if transport == RAW else (CompressedImage, f"{topic}/{transport}")
            self.create_subscription(kind, topic, lambda message, take=take: self._take(take, message), newest)
        self.create_subscription(CameraInfo, "camera_info", tracking.take_info, newest)
        if settings.world_frame:
            latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            for topic, static, profile in (("/tf", False, QoSProfile(depth=100)), ("/tf_static", True, latched)):
                self.create_subscription(
                    TFMessage, topic, lambda message, static=static: self._take_transforms(message, static), profile
                )

    def _now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def _take(self, take: Any, message: Any) -> None:
        take(message, self._now_ns())
        self._arrived.set()

    def _take_transforms(self, message: Any, static: bool) -> None:
        self.tracking.take_transforms(message, self._now_ns(), static=static)
        self._arrived.set()

    def start(self) -> None:
        """Begin to track what comes, in a thread of its own."""
        self._worker.start()

    def _work(self) -> None:
        while not self._closing.is_set():
            self._arrived.wait()
            self._arrived.clear()
            try:
                self.track()
            except Exception as error:  # nothing can be published once ROS is shut down
                if not rclpy.ok():
                    return
                self.get_logger().error(f"publishing failed: {error}")

    def track(self) -> None:
        """Track the newest picture, if there is one, and publish what is said of it."""
        answer = self.tracking.step()
        if answer is not None:
            self._tracks.publish(answer.tracks)
            self._markers.publish(answer.markers)
        self._tell(news=True)

    def _tell(self, *, news: bool = False) -> None:
        """Log and publish what there is to say."""
        logger = self.get_logger()
        log = {"INFO": logger.info, "WARN": logger.warning, "ERROR": logger.error}
        for notice in self.tracking.notices():
            log[notice.level](notice.text)
        told = self.tracking.diagnostics(self._now_ns(), news=news)
        if told is not None:
            self._diagnostics.publish(told)

    def stop(self) -> None:
        """End the thread, after the picture that is being tracked."""
        self._closing.set()
        self._arrived.set()
        if self._worker.is_alive():
            self._worker.join()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is shut down; returns 1 if it cannot begin."""
    rclpy.init(args=arguments)
    try:
        node = QuestNode()
    except QuestError as error:
        rclpy.logging.get_logger("quest").fatal(str(error))
        rclpy.try_shutdown()
        return 1
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    node.start()
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
