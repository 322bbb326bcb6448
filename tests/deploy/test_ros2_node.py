"""The ROS 2 node against a running service and against a stand-in of it, and its parts alone."""

import importlib
import math
import threading
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from scene_client import InvalidRequestError, UnreachableError
from scene_client.frames import Conventions
from scene_client.home_state import Kind
from scene_client.schemas import MissingAnswer
from tests.client.homes import COMMON, FakeClient
from tests.client.peers import Peer, answering
from tests.client.ros_messages import blank, through_cdr
from tests.deploy.ros import PACKAGE, STORE, Ros, load_package
from tests.services import PATIENCE, LiveService, in_thread, wait_until

Run = Callable[..., "Running"]
HOUSE = "kitchen: [[0, 0], [4, 0], [4, 4], [0, 4]]\noffice: [[4, 0], [8, 0], [8, 4], [4, 4]]\n"
POSE = blank(STORE, "geometry_msgs/msg/PoseWithCovarianceStamped")
POSE.header.frame_id = "map"
POSE.pose.pose.position.x, POSE.pose.pose.position.y = 1.0, 2.0


def new(name: str, **fields: Any) -> Any:
    return blank(STORE, f"vision_msgs/msg/{name}", **fields)


class Running:
    """The running node: its subscriptions, publications and services."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> None:
        self.ros = Ros(parameters)
        load_package(monkeypatch, self.ros)
        self.node = importlib.import_module("scene_reasoning.node").SceneNode()

    def hear(self, topic: str, message: Any) -> None:
        kind, callback = self.ros.subscriptions[topic]
        assert message.__msgtype__ == kind.ros_name
        callback(message)

    def see(self, message: Any, *seconds: float) -> None:
        """Send one message of detections at these times, and wait for the home each time."""
        for second in seconds:
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = int(second), int(second % 1 * 1e9)
            self.hear("detections", message)
            self.node.home.ask(lambda home: home).result(PATIENCE)

    def published(self, topic: str) -> list[Any]:
        return self.ros.publishers[topic].sent

    def events(self) -> list[tuple[int, str]]:
        return [(event.kind, event.label) for event in self.published("~/events")]

    def call(self, name: str, **fields: Any) -> Any:
        kind, callback = self.ros.services[name]
        request = through_cdr(STORE, kind.Request(**fields))
        return through_cdr(STORE, callback(request, kind.Response()))

    def status(self) -> Any:
        ((_, callback),) = self.ros.timers
        callback()
        (status,) = self.published("/diagnostics")[-1].status
        return status

    def value(self, key: str) -> str:
        return {entry.key: entry.value for entry in self.status().values}[key]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    started: list[Running] = []

    def start(**parameters: Any) -> Running:
        started.append(Running(monkeypatch, **parameters))
        return started[-1]

    yield start
    for running in started:
        if running.ros.destroyed:
            continue
        running.node.destroy_node()
        assert running.ros.destroyed


@pytest.fixture
def rooms(tmp_path: Path) -> str:
    (tmp_path / "rooms.yaml").write_text(HOUSE)
    return str(tmp_path / "rooms.yaml")


def pretend(running: Running) -> FakeClient:
    """Replace the service by a stand-in."""
    client = FakeClient()
    running.node.counted._client = client
    return client


def detection(label: str, x: float, y: float = 0.0) -> Any:
    hypothesis = new("ObjectHypothesis", class_id=label, score=0.9)
    one = new("Detection3D", results=[new("ObjectHypothesisWithPose", hypothesis=hypothesis)])
    one.bbox.center.position.x, one.bbox.center.position.y = x, y
    one.bbox.size.x, one.bbox.size.y, one.bbox.size.z = 0.4, 0.6, 0.8
    return one


def array(*detections: Any, frame: str = "base_link") -> Any:
    message = new("Detection3DArray", detections=list(detections))
    message.header.frame_id = frame
    return message


def test_a_patrol(run: Run, rooms: str, tmp_path: Path) -> None:
    """A wrong thing is one event, confirmed by a service, and known after a restart."""
    files = {"home_file": str(tmp_path / "home.json"), "record": str(tmp_path / "scenes.jsonl")}
    running = run(rooms=rooms, **files)
    pretend(running).odd = {"toilet"}
    running.hear("pose", POSE)
    running.see(array(detection("oven", 1.0), detection("toilet", 2.0, 1.0)), *range(1, 13))
    constants = running.ros.modules()["scene_reasoning_msgs.msg"].SceneEvent
    assert running.events() == [
        (constants.APPEARED, "oven"),
        (constants.APPEARED, "toilet"),
        (constants.OUT_OF_PLACE, "toilet"),
    ]
    alarm = running.published("~/events")[-1]
    assert (alarm.room, alarm.probability, alarm.since.sec) == ("kitchen", 0.9, 2)
    things = running.published("~/things")[-1]
    assert things.header.frame_id == "map"
    toilet = next(one for one in things.things if one.label == "toilet")
    assert (toilet.id, toilet.room, toilet.alarm) == (alarm.id, "kitchen", constants.OUT_OF_PLACE)
    position = toilet.pose.position  # of the robot, plus that in its frame
    assert (position.x, position.y) == pytest.approx((3.0, 3.0))
    assert (toilet.size.x, toilet.size.y, toilet.size.z) == (0.4, 0.6, 0.8)
    assert running.status().message == "up to date"
    assert (running.value("things"), running.value("alarms")) == ("2", "1")

    assert running.call("~/confirm", id=alarm.id).success
    assert running.events()[-1] == (constants.CLEARED, "toilet")
    refused = running.call("~/confirm", id="t99")
    assert (refused.success, refused.message) == (
        False,
        "the home has no thing 't99', or it is gone",
    )
    running.node.destroy_node()
    assert "toilet" in (tmp_path / "scenes.jsonl").read_text()
    again = run(rooms=rooms, **files)
    assert again.node.home.ask(lambda home: home.confirmed).result() == {("toilet", "kitchen")}
    pretend(again)
    again.hear("pose", POSE)
    again.see(array(detection("oven", 1.0)), 13)
    assert {one.label for one in again.published("~/things")[-1].things} == {"oven", "toilet"}


def test_questions_to_the_service(run: Run, live: LiveService, recorded: Any, rooms: str) -> None:
    parameters = {"view_angle": 3.0, "view_range": 9.0, "settings.timeout": 60.0}
    running = run(url=live.url, rooms=rooms, **parameters)
    running.hear("pose", POSE)
    running.see(recorded, *range(1, 7))
    assert running.status().message == "up to date"
    assert float(running.value("answers/s")) >= 0
    # The machine of this test knows five of the eight things.
    seen = {one.label for one in running.published("~/things")[-1].things}
    assert {"desk", "keyboard", "chair", "toilet", "cup"} <= seen
    missing = MissingAnswer.model_validate_json(running.published("~/missing")[-1].data)
    assert missing.missing
    clear, *shown = running.published("~/ghosts")[-1].markers
    assert clear.action == 3
    assert {marker.header.frame_id for marker in shown} <= {"map"}
    texts = [marker.text for marker in shown if marker.text]
    assert 1 <= len(texts) <= 3

    searched = [blank(STORE, "scene_reasoning_msgs/msg/Searched", room="office")]
    found = running.call("~/where_is", label="lamp", searched=searched)
    assert (found.success, found.message, found.header.frame_id) == (True, "", "map")
    assert {one.room for one in found.rooms} == {"kitchen", "office"}
    assert sum(one.probability for one in found.rooms) + found.not_here == pytest.approx(1)
    placed = [one for one in found.places if one.object]
    assert placed
    assert all(math.isfinite(one.position.x) for one in placed)
    probabilities = [one.probability for one in found.places]
    assert probabilities == sorted(probabilities, reverse=True)
    unknown = running.call("~/where_is", label="qwzx")
    assert not unknown.success
    assert unknown.message.startswith("ProblemError: ")
    assert not unknown.places


def test_positions_are_in_the_frame_of_the_map(run: Run, rooms: str) -> None:
    def seen(*detections: Any, frame: str) -> list[Any]:
        running.see(array(*detections, frame=frame), *(next(times) for _ in range(4)))
        return list(running.node.home.ask(lambda home: home.scene()["objects"]).result())

    running, times = run(rooms=rooms, units="cm"), count(1)
    pretend(running)
    oven = detection("oven", 100.0, 50.0)
    for side in "xyz":
        setattr(oven.bbox.size, side, 40.0)
    (label,) = seen(oven, frame="map")  # the pose is unknown
    assert set(label) == {"id", "label", "confidence"}

    pose = blank(STORE, "geometry_msgs/msg/PoseWithCovarianceStamped")
    pose.header.frame_id = "map"
    pose.pose.pose.position.x, pose.pose.pose.position.y = 2.0, 1.0
    pose.pose.pose.orientation.z = pose.pose.pose.orientation.w = math.sqrt(0.5)  # looks along y
    running.hear("pose", pose)
    (placed,) = seen(oven, frame="base_link")
    assert placed["position"] == pytest.approx([1.5, 2.0, 0.0])
    assert (placed["size"], placed["yaw"]) == ([0.4] * 3, pytest.approx(math.pi / 2, abs=1e-3))

    optical = detection("sink", 0.0, 0.0)
    optical.bbox.center.position.z = 120.0  # straight ahead
    for side in "xyz":
        setattr(optical.bbox.size, side, 40.0)
    by_label = {one["label"]: one for one in seen(optical, frame="camera_color_optical_frame")}
    assert by_label["sink"]["position"] == pytest.approx([2.0, 2.2, 0.0])

    by_label = {one["label"]: one for one in seen(detection("lamp", 300.0, 300.0), frame="map")}
    assert by_label["lamp"]["position"] == pytest.approx([3.0, 3.0, 0.0])
    other = {one["label"]: one for one in seen(detection("cup", 300.0), frame="odom")}
    assert "position" not in other["cup"]


def test_tf2_has_the_poses_of_robot_and_camera(run: Run, rooms: str) -> None:
    """A camera 1 m above the floor, 0.2 m ahead of a robot that looks along y, 30 degrees down."""
    running = run(rooms=rooms)
    pretend(running)
    half, turn = math.sqrt(0.5), importlib.import_module("scene_reasoning.detections").product
    yaw, pitch = (0.0, 0.0, half, half), (0.0, math.sin(math.pi / 12), 0.0, math.cos(math.pi / 12))
    camera = turn(turn(yaw, pitch), (-0.5, 0.5, -0.5, 0.5))
    for frame, place, q in (("base_link", (2, 1, 0), yaw), ("camera_optical", (2, 1.2, 1), camera)):
        transform = blank(STORE, "geometry_msgs/msg/Transform")
        for vector, names, values in (
            (transform.translation, "xyz", place),
            (transform.rotation, "xyzw", q),
        ):
            for name, value in zip(names, values, strict=True):
                setattr(vector, name, float(value))
        running.ros.transforms[frame] = transform
    cup = detection("cup", 0.0)
    cup.bbox.center.position.z = 1.0  # metres ahead of the camera, in its middle
    # The box stands upright in the map: its axes in the frame of the camera.
    x, y, z, w = camera
    o = turn((-x, -y, -z, w), (0.0, 0.0, 0.0, 1.0))
    for name, value in zip("xyzw", o, strict=True):
        setattr(cup.bbox.center.orientation, name, value)
    running.see(array(cup, frame="camera_optical"), 1, 2, 3)
    scene = running.node.home.ask(lambda home: home.scene()).result()
    assert scene["viewpoint"] == pytest.approx({"x": 2.0, "y": 1.0, "yaw": math.pi / 2})
    (placed,) = scene["objects"]
    ahead = math.cos(math.pi / 6)
    assert placed["position"] == pytest.approx([2.0, 1.2 + ahead, 0.5], abs=1e-3)
    assert placed["size"] == [0.4, 0.6, 0.8]
    assert placed["yaw"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("up", ["z", "y", "-y"])
def test_a_transform_is_that_of_the_conventions(monkeypatch: pytest.MonkeyPatch, up: Any) -> None:
    """Rotations to body axes, as `scene_client` knows them."""
    load_package(monkeypatch)
    package = importlib.import_module("scene_reasoning.detections")
    frame = {"z": "base_link", "y": "base_link", "-y": "camera_optical"}[up]
    message = array(detection("cup", 1.0, 2.0), frame=frame)
    box = message.detections[0].bbox
    box.center.position.z = 3.0
    converter = package.Converter(conventions={"up": "y"} if up == "y" else {})
    transform = package.Transform.of((0.0, 0.0, 0.0), "map", frame)
    (moved,) = converter.detections(message, transform)
    q = box.center.orientation
    position, size, _ = Conventions(up).box((1.0, 2.0, 3.0), (0.4, 0.6, 0.8), (q.x, q.y, q.z, q.w))
    assert moved["position"] == pytest.approx(position)
    assert moved["size"] == size


def test_a_room_is_named_by_a_topic(run: Run) -> None:
    running = run(kind="2d")
    client = pretend(running)
    hypothesis = new("ObjectHypothesis", class_id="bed", score=0.9)
    found = new("Detection2D", results=[new("ObjectHypothesisWithPose", hypothesis=hypothesis)])
    found.bbox.size_x = found.bbox.size_y = 50.0
    running.hear("room", blank(STORE, "std_msgs/msg/String", data="bedroom"))
    running.see(new("Detection2DArray", detections=[found]), *range(1, 6))
    (bed,) = running.published("~/things")[-1].things
    assert (bed.label, bed.room) == ("bed", "bedroom")
    assert math.isnan(bed.pose.position.x)
    assert math.isnan(bed.size.z)
    assert client.questions("outliers")[0]["room_type"] == "bedroom"


def test_the_api_key_comes_from_a_file(run: Run, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("incorrect-zebra-capacitor-nail\n")
    for file in (str(tmp_path / "key"), ""):
        heads: list[bytes] = []
        with in_thread(Peer(answering(heads=heads))) as peer:
            running = run(url=peer.url, api_key_file=file)
            running.see(array(detection("bed", 1.0)), 1, 2)
        key = b"x-api-key: incorrect-zebra-capacitor-nail\r\n"
        assert (key in heads[0].lower()) is bool(file)


def test_callbacks_do_not_wait_and_the_newest_frame_counts(run: Run) -> None:
    running = run()
    client = pretend(running)
    started, answering = threading.Event(), threading.Event()

    def slow(*_: Any, **__: Any) -> Any:
        started.set()
        assert answering.wait(PATIENCE)
        raise UnreachableError("gone")

    client.rooms = slow  # type: ignore[method-assign]
    message = array(detection("bed", 1.0))
    for second in range(1, 6):
        message = array(detection("bed", 1.0))
        message.header.stamp.sec = second
        running.hear("detections", message)  # returns though nobody answers
        if second == 1:
            assert started.wait(PATIENCE)
    assert running.node.home.replaced == 3
    assert running.status().message == "no detections"
    answering.set()
    wait_until(lambda: running.node.frames == 2)
    assert running.events()[0] == (8, "lost")
    status = running.status()
    assert (status.level, status.message) == (2, "gone")
    del client.rooms
    running.see(array(detection("bed", 1.0)), 60, 61, 62)
    assert (8, "back") in running.events()
    assert running.status().level == 0
    assert float(running.value("age of the last answer in s")) < PATIENCE


def test_class_ids_need_a_label_map(run: Run) -> None:
    running = run()
    pretend(running)
    message = array(detection("0", 1.0), detection("1", 2.0))
    running.see(message, 1)
    status = running.status()
    assert (status.level, status.message[:40]) == (2, "MessageError: the class ids are numbers:")
    pairs = enumerate(["desk", "chair"])
    classes = [new("VisionClass", class_id=number, class_name=name) for number, name in pairs]
    running.hear("label_info", new("LabelInfo", class_map=classes))
    running.see(message, 2, 3, 4)
    assert {label for _, label in running.events()} >= {"desk", "chair"}
    assert running.status().level == 0


def test_the_program_spins_the_node_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    ros = Ros({})
    load_package(monkeypatch, ros)
    importlib.import_module("scene_reasoning.node").main()
    assert len(ros.spun) == 1
    assert ros.destroyed


def test_an_unexpected_error_ends_the_node(run: Run) -> None:
    running = run()
    pretend(running).rooms = lambda *_, **__: 1 / 0  # type: ignore[method-assign,assignment]
    running.see(array(detection("bed", 1.0)), 1)
    with pytest.raises(ZeroDivisionError):
        running.see(array(detection("bed", 1.0)), 2)
    running.node.home._frame = None


def test_every_kind_of_event_has_a_number_of_its_own(run: Run) -> None:
    run()
    kind_of = importlib.import_module("scene_reasoning.messages").kind_of
    assert sorted(map(kind_of, get_args(Kind))) == list(range(1, len(get_args(Kind)) + 1))


def test_a_home_without_things_has_no_places(run: Run) -> None:
    refused = run().call("~/where_is", label="cup")
    assert not refused.success
    assert refused.message.startswith(InvalidRequestError.__name__)


def test_ghosts_stand_at_the_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    load_package(monkeypatch, Ros({}))
    messages = importlib.import_module("scene_reasoning.messages")
    desk = {"id": "d", "label": "desk", "position": [1.0, 2.0, 0.4]}
    objects = {"d": ("office", desk), "c": ("office", {"id": "c", "label": "chair"})}
    mean, std = {"x": 0.1, "y": -0.2, "z": 0.5}, {"x": 0.2, "y": 0.0, "z": 9.0}
    nowhere = {"relation": "front", "object": "c", "probability": 0.5}
    there = {"relation": "on-top", "object": "d", "probability": 0.5}
    offset = {"offset": {"mean": mean, "std": std, "scenes": 3}}
    placements: dict[str, list[Any]] = {
        "milk": [],
        "lamp": [nowhere, there | offset],
        "bed": [nowhere],
        "cup": [there],
        "pen": [there],
        "book": [there],
    }
    listed = [
        {"label": label, "probability": 0.5, "log_odds": 0.0, "placements": places}
        for label, places in placements.items()
    ]
    listed[3]["listed_as"] = "mug"
    answer = MissingAnswer.model_validate(COMMON | {"missing": listed})
    header = blank(STORE, "std_msgs/msg/Header", frame_id="map")
    clear, *shown = messages.markers_of(answer, objects, header, 3).markers
    assert clear.action == 3
    texts = [marker.text for marker in shown if marker.text]
    assert texts == ["lamp? on-top desk", "mug? on-top desk", "pen? on-top desk"]
    (sphere,) = (marker for marker in shown if not marker.text)
    at, scale = sphere.pose.position, sphere.scale
    assert (at.x, at.y, at.z) == pytest.approx((1.1, 1.8, 0.9))
    assert (scale.x, scale.y, scale.z) == (0.4, 0.05, 1.5)
    at = shown[2].pose.position
    assert (at.x, at.y, at.z) == (1.0, 2.0, 0.4)
    assert len({marker.id for marker in shown}) == 4


def test_the_parameter_file_has_the_defaults(run: Run) -> None:
    given = yaml.safe_load((PACKAGE / "config" / "scene.yaml").read_text())
    parameters = given["scene"]["ros__parameters"]
    parameters |= {f"settings.{key}": value for key, value in parameters.pop("settings").items()}
    assert set(run(**parameters).ros.declared) == set(parameters)
    defaults = run().ros.declared
    for name, value in defaults.items():
        assert str(parameters[name]) == str(value), name
