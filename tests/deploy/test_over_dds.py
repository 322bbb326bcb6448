"""The bridge without rclpy: its messages are those of ROS 2, and it answers over a real DDS."""

import dataclasses
import json
import os
from collections.abc import Iterator
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from tests.client.ros_messages import blank, filled, to_json
from tests.deploy.ros import STORE
from tests.services import LiveService, wait_until

pytest.importorskip("cyclonedds", reason="there is no wheel for this processor")

from benchmarks.dds import Robot, bridge, ros

over_dds = import_module("over_dds")  # benchmarks.dds adds its folder to the path

ARRAY = "vision_msgs/msg/Detection3DArray"


def written(message: Any) -> bytes:
    """The bytes on the wire, according to the parser of ROS's own message definitions."""
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def test_the_definitions_are_those_of_ros() -> None:
    names = {ros.Detection3DArray: ARRAY, ros.String: "std_msgs/msg/String"}
    assert {kind: STORE.hash_rihs01(name) for kind, name in names.items()} == ros.TYPE_HASHES


@pytest.mark.parametrize("length", [0, 1, 3])
def test_every_field_has_the_bytes_of_ros(length: int) -> None:
    message = filled(STORE, ARRAY, (number / 8 for number in count()), length)
    read = ros.Detection3DArray.deserialize(written(message))
    assert dataclasses.asdict(read) == to_json(message)
    assert read.serialize() == written(message)
    answer = STORE.types["std_msgs/msg/String"](data='{"é": 1}')
    assert ros.String(answer.data).serialize() == written(answer)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["/boxes", "--domain", "300"], "--domain: '300' is not a number from 0 to 232"),
        ([""], "detections: '' is not the name of a topic"),
        (["/boxes", "--answers", "boxes"], "the answers need another topic"),
        (["/boxes", "--service", "robot:8000"], "the URL must start with http:// or https://"),
    ],
)
def test_invalid_options_give_status_2(options, error, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["over_dds.py", *options])
    with pytest.raises(SystemExit, match="2"):
        over_dds.main()
    assert error in capsys.readouterr().err.splitlines()[-1]


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bridge") / "errors"


@pytest.fixture(scope="module")
def robot(live: LiveService, errors: Path) -> Iterator[Robot]:
    """A robot beside a running bridge. All traffic stays on the loopback interface."""
    topic = f"detections_{os.getpid()}"
    with errors.open("w") as stream, bridge(topic, live.url, stream):
        yield Robot(topic)


def send(robot: Robot, message: Any, second: int = 0, *, reliable: bool = True) -> None:
    message.header.stamp.sec = second
    robot.send(ros.Detection3DArray.deserialize(written(message)), reliable=reliable)


def hear(robot: Robot) -> Any:
    """The next answer, read by ROS's own definition of a String."""
    raw = robot.hear().serialize()
    return json.loads(STORE.deserialize_cdr(raw, "std_msgs/msg/String").data)


def wait_for(error: str, errors: Path) -> None:
    wait_until(lambda: error in errors.read_text(), errors)


@pytest.mark.system
def test_detections_are_answered_as_by_the_node(robot: Robot, recorded: Any) -> None:
    send(robot, recorded, 5)
    answer = hear(robot)
    assert (answer["frame_id"], answer["stamp"]["sec"]) == ("base_link", 5)
    assert answer["missing"]["missing"]
    assert {entry["object"] for entry in answer["outliers"]["outliers"]} >= {"track_3", "toilet_1"}
    assert [note["reason"] for note in answer["notes"]] == ["no-hypothesis"]


@pytest.mark.system
def test_invalid_messages_are_reported(robot: Robot, recorded: Any, errors: Path) -> None:
    latin = ros.Detection3DArray.deserialize(written(recorded))
    latin.serialize = lambda **_: written(recorded).replace(b"desk", b"d\xffsk")
    robot.send(latin)
    wait_for("'utf-8' codec can't decode byte", errors)
    for detection in recorded.detections:
        for result in detection.results:
            result.hypothesis.class_id = "7"
    send(robot, recorded)
    wait_for("MessageError: the class ids are numbers", errors)
    send(robot, blank(STORE, ARRAY), 3)
    assert hear(robot) == {"frame_id": None, "stamp": {"sec": 3, "nanosec": 0}, "notes": []}
