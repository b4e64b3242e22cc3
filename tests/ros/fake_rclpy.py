"""As much of rclpy, launch and the generated packages as the node and its launch file use, without a middleware."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.ros.ros_types import Types

HALVES = ("Request", "Response")
SERVICES = {"quest_msgs": ("AddQuery", "AnswerAlarm", "RenameQuery", "RetireQuery"), "std_srvs": ("Trigger",)}


class Network:
    """What a node sees of the world: parameters that it is given, and what it makes."""

    def __init__(self, types: Types) -> None:
        self.types = types
        self.parameters: dict[str, Any] = {}
        self.remapped: dict[str, str] = {}
        self.now_ns = 0
        self.published: list[tuple[str, Any]] = []
        self.subscriptions: dict[str, SimpleNamespace] = {}
        self.services: dict[str, tuple[Any, Callable[[Any, Any], Any], Any]] = {}
        self.timers: list[SimpleNamespace] = []
        self.logged: list[tuple[str, str]] = []
        self.alive = False
        self.spin: Callable[[], None] = lambda: None

    def send(self, topic: str, message: Any) -> None:
        self.subscriptions[topic].callback(message)

    def call(self, service: str, **fields: Any) -> Any:
        kind, callback, _ = self.services[service]
        request = kind.Request()
        for name, value in fields.items():
            setattr(request, name, value)
        return callback(request, kind.Response())

    def last(self, topic: str) -> Any:
        """What another node would receive last."""
        return self.types.again([message for at, message in self.published if at == topic][-1])


class Node:
    network: Network

    def __init__(self, name: str) -> None:
        self.name, self.declared = name, {}

    def declare_parameter(self, name: str, default: Any, descriptor: Any) -> Any:
        assert name not in self.declared
        assert not isinstance(default, tuple)
        value = self.network.parameters.get(name, default)
        if not descriptor.dynamic_typing:
            assert type(value) is type(default), f"{name}: rclpy refuses {value!r}"
        self.declared[name] = descriptor
        return SimpleNamespace(value=value)

    def get_name(self) -> str:
        return self.name

    def resolve_topic_name(self, topic: str) -> str:
        topic = self.network.remapped.get(topic, topic)
        return topic if topic.startswith("/") else topic.replace("~", f"/{self.name}") if "~" in topic else f"/{topic}"

    def create_publisher(self, kind: Any, topic: str, profile: Any) -> Any:
        at = self.resolve_topic_name(topic)

        def publish(message: Any) -> None:
            assert type(message) is kind
            self.network.types.serialise(message)
            self.network.published.append((at, message))

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind: Any, topic: str, callback: Any, profile: Any) -> None:
        at = self.resolve_topic_name(topic)
        self.network.subscriptions[at] = SimpleNamespace(kind=kind, callback=callback, profile=profile)

    def create_service(self, kind: Any, name: str, callback: Any, *, callback_group: Any) -> None:
        self.network.services[self.resolve_topic_name(name)] = (kind, callback, callback_group)

    def create_timer(self, period_s: float, callback: Any, *, callback_group: Any) -> None:
        self.network.timers.append(SimpleNamespace(period_s=period_s, callback=callback, group=callback_group))

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.network.now_ns))

    def get_logger(self) -> Any:
        return _logger(self.network)

    def destroy_node(self) -> None:
        pass


def _logger(network: Network) -> Any:
    levels = ("info", "warning", "error", "fatal")
    return SimpleNamespace(
        **{level: lambda text, level=level: network.logged.append((level, text)) for level in levels}
    )


class ExternalShutdownException(Exception):  # noqa: N818 - its name in rclpy
    pass


class MultiThreadedExecutor:
    network: Network

    def __init__(self, num_threads: int) -> None:
        assert num_threads >= 2

    def add_node(self, node: Any) -> None:
        self.node = node

    def spin(self) -> None:
        self.network.spin()


def install(monkeypatch: pytest.MonkeyPatch, types: Types) -> Network:
    """Put the modules where Python finds them."""
    network = Network(types)
    bound = {"network": network}

    def begin(args: Any = None) -> None:
        network.alive = True

    def end() -> None:
        network.alive = False

    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": begin, "try_shutdown": end, "ok": lambda: network.alive},
        "rclpy.logging": {"get_logger": lambda _: _logger(network)},
        "rclpy.node": {"Node": type("Node", (Node,), bound)},
        "rclpy.callback_groups": {"MutuallyExclusiveCallbackGroup": type("Group", (), {})},
        "rclpy.executors": {
            "ExternalShutdownException": ExternalShutdownException,
            "MultiThreadedExecutor": type("MultiThreadedExecutor", (MultiThreadedExecutor,), bound),
        },
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="transient local"),
            "qos_profile_sensor_data": "sensor data",
        },
        "rcl_interfaces.msg": {"ParameterDescriptor": SimpleNamespace},
    }
    for name in types.store.fielddefs:
        package, kind, message = name.split("/")
        if not message.endswith(("_Request", "_Response")):
            modules.setdefault(f"{package}.{kind}", {})[message] = types(name)
    for package, services in SERVICES.items():
        halves = {name: {half: types(f"{package}/srv/{name}_{half}") for half in HALVES} for name in services}
        modules[f"{package}.srv"] = {name: SimpleNamespace(**half) for name, half in halves.items()}
    _put(monkeypatch, modules)
    monkeypatch.delitem(sys.modules, "quest_ros.node", raising=False)
    return network


def install_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules of launch whose classes remember what they were made with."""

    def made(name: str) -> Any:
        def begin(self: Any, *args: Any, **fields: Any) -> None:
            self.args = args
            self.__dict__.update(fields)

        return type(name, (), {"__init__": begin})

    class LaunchConfiguration:
        def __init__(self, name: str) -> None:
            self.name = name

        def perform(self, context: dict[str, str]) -> str:
            return context[self.name]

    _put(
        monkeypatch,
        {
            "launch": {"LaunchContext": dict, "LaunchDescription": made("LaunchDescription")},
            "launch.actions": {name: made(name) for name in ("DeclareLaunchArgument", "OpaqueFunction")},
            "launch.substitutions": {
                "LaunchConfiguration": LaunchConfiguration,
                "PathJoinSubstitution": made("PathJoinSubstitution"),
            },
            "launch_ros": {},
            "launch_ros.actions": {"Node": made("Node")},
            "launch_ros.substitutions": {"FindPackageShare": made("FindPackageShare")},
        },
    )


def _put(monkeypatch: pytest.MonkeyPatch, modules: dict[str, dict[str, Any]]) -> None:
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, last = name.rpartition(".")
        if parent:
            if parent not in sys.modules:
                monkeypatch.setitem(sys.modules, parent, ModuleType(parent))
            setattr(sys.modules[parent], last, module)
