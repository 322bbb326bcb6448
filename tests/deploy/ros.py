"""A stand-in for rclpy, as far as the example node needs it.

A publisher writes each message in CDR and reads it back: a message must fit its type, as in ROS.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.client.ros_messages import OWN, Layout, blank, through_cdr

STORE = Layout.current
PACKAGE = Path(__file__).resolve().parents[2] / "clients" / "ros2" / "scene_reasoning"


def message_type(name: str) -> Any:
    """A class as rclpy has it: called without arguments it is filled with defaults."""
    constants = {key: value for key, _, value in STORE.fielddefs[name][0]}
    if name.endswith("DiagnosticStatus"):
        # rclpy has a type `byte` as bytes of length one.
        constants = {key: bytes([value]) for key, value in constants.items()}

    def new(_: type, **values: Any) -> Any:
        return blank(STORE, name, **values)

    return type(name.rpartition("/")[2], (), {**constants, "__new__": new, "ros_name": name})


def service_type(name: str) -> Any:
    """A service as rclpy has it: a class with the classes of its request and its response."""
    parts = {part: message_type(f"{name}_{part}") for part in ("Request", "Response")}
    return type(name.rpartition("/")[2], (), parts)


@dataclass
class Publisher:
    """A publisher that keeps its messages as they arrive over the wire."""

    kind: Any
    sent: list[Any] = field(default_factory=list)

    def publish(self, message: Any) -> None:
        assert message.__msgtype__ == self.kind.ros_name
        for status in getattr(message, "status", ()):
            assert isinstance(status.level, bytes)
            status.level = status.level[0]
        self.sent.append(through_cdr(STORE, message))


@dataclass
class Ros:
    """One process with one node. `given` are parameters, as from a file."""

    given: dict[str, Any]
    declared: dict[str, Any] = field(default_factory=dict)
    subscriptions: dict[str, tuple[Any, Callable[[Any], None]]] = field(default_factory=dict)
    publishers: dict[str, Publisher] = field(default_factory=dict)
    services: dict[str, tuple[Any, Callable[[Any, Any], Any]]] = field(default_factory=dict)
    timers: list[tuple[float, Callable[[], None]]] = field(default_factory=list)
    spun: list[Any] = field(default_factory=list)
    warned: list[str] = field(default_factory=list)
    transforms: dict[str, Any] = field(default_factory=dict)  # from these frames to the map
    destroyed: bool = False

    def node_type(self) -> type:
        ros = self

        class Node:
            def __init__(self, name: str) -> None:
                self.get_name = lambda: name

            def declare_parameter(self, name: str, default: Any) -> Any:
                value = ros.declared[name] = ros.given.get(name, default)
                assert type(value) is type(default), f"{name} changed its type"
                return SimpleNamespace(value=value)

            def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
                ros.subscriptions[topic] = kind, callback

            def create_publisher(self, kind: Any, topic: str, qos: Any) -> Publisher:
                return ros.publishers.setdefault(topic, Publisher(kind))

            def create_service(
                self, kind: Any, name: str, callback: Any, callback_group: Any
            ) -> None:
                ros.services[name] = kind, callback

            def create_timer(self, period: float, callback: Callable[[], None]) -> None:
                ros.timers.append((period, callback))

            def get_logger(self) -> Any:
                return SimpleNamespace(warning=ros.warned.append)

            def get_clock(self) -> Any:
                stamp = blank(STORE, "builtin_interfaces/msg/Time", sec=77)
                return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: stamp))

            def destroy_node(self) -> None:
                ros.destroyed = True

        return Node

    def _look_up(self, target: str, source: str, at: Any, timeout: Any) -> Any:
        assert target == "map"
        return SimpleNamespace(transform=self.transforms[source])

    def modules(self) -> dict[str, Any]:
        names = {
            "builtin_interfaces": ["Time"],
            "std_msgs": ["Header", "String"],
            "geometry_msgs": [
                "Point",
                "Pose",
                "PoseWithCovarianceStamped",
                "Quaternion",
                "Vector3",
            ],
            "scene_reasoning_msgs": [
                "Place",
                "RoomProbability",
                "SceneEvent",
                "Thing",
                "ThingArray",
            ],
            "vision_msgs": ["Detection3DArray", "Detection2DArray", "LabelInfo"],
            "visualization_msgs": ["Marker", "MarkerArray"],
            "diagnostic_msgs": ["DiagnosticArray", "DiagnosticStatus", "KeyValue"],
        }
        members: dict[str, dict[str, Any]] = {
            f"{package}.msg": {name: message_type(f"{package}/msg/{name}") for name in types}
            for package, types in names.items()
        }
        members |= {package: {} for package in names}
        members["scene_reasoning_msgs.srv"] = {
            name: service_type(f"{OWN.name}/msg/{name}") for name in ("Confirm", "WhereIs")
        }
        members["rclpy"] = dict.fromkeys(("init", "try_shutdown"), lambda: None)
        members["rclpy"]["spin"] = lambda node, executor=None: self.spun.append(node)
        members["rclpy.duration"] = {"Duration": dict}
        members["rclpy.time"] = {"Time": SimpleNamespace(from_msg=lambda stamp: stamp)}
        members["tf2_ros"] = {
            "Buffer": lambda: SimpleNamespace(lookup_transform=self._look_up),
            "TransformException": KeyError,
            "TransformListener": lambda buffer, node: None,
        }
        members["rclpy.callback_groups"] = {"MutuallyExclusiveCallbackGroup": object}
        members["rclpy.node"] = {"Node": self.node_type()}
        shutdown = type("ExternalShutdownException", (Exception,), {})
        members["rclpy.executors"] = {
            "ExternalShutdownException": shutdown,
            "MultiThreadedExecutor": lambda num_threads: None,
        }
        members["rclpy.qos"] = {
            "qos_profile_sensor_data": object(),
            "QoSProfile": lambda **settings: settings,
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1, VOLATILE=2),
        }
        return {name: SimpleNamespace(**content) for name, content in members.items()}


def load_package(monkeypatch: pytest.MonkeyPatch, ros: Ros | None = None) -> None:
    """Make a new copy of the example package importable, with this ROS."""
    monkeypatch.syspath_prepend(str(PACKAGE))
    for name in [name for name in sys.modules if name.split(".")[0] == "scene_reasoning"]:
        monkeypatch.delitem(sys.modules, name)
    for name, module in (ros.modules() if ros else {}).items():
        monkeypatch.setitem(sys.modules, name, module)


def from_json(name: str, values: Any) -> Any:
    fields: dict[str, Any] = {}
    for field_name, (kind, detail) in STORE.fielddefs[name][1]:
        value = values[field_name]
        if int(kind) == 2:
            value = from_json(detail, value)
        elif int(kind) == 4 and int(detail[0][0]) == 2:
            value = [from_json(detail[0][1], entry) for entry in value]
        elif int(kind) == 3:
            value = np.asarray(value, dtype=detail[0][1][0])
        fields[field_name] = value
    return STORE.types[name](**fields)
