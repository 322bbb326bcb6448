"""The example node against a running service, and its parts alone."""

import copy
import importlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from scene_client import UnreachableError
from scene_client.vision_msgs import SceneFields
from tests.client.peers import Peer, answering
from tests.client.ros_messages import blank
from tests.deploy.ros import PACKAGE, STORE, Ros, Slow, load_package
from tests.services import PATIENCE, LiveService, in_thread, wait_until

Run = Callable[..., "Running"]


def new(name: str, **fields: Any) -> Any:
    return blank(STORE, f"vision_msgs/msg/{name}", **fields)


class Running:
    """The running node: its subscriptions and publications."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> None:
        self.ros = Ros(parameters)
        load_package(monkeypatch, self.ros)
        self.node = importlib.import_module("scene_reasoning.node").SceneNode()

    def hear(self, topic: str, message: Any) -> None:
        kind, callback = self.ros.subscriptions[topic]
        assert message.__msgtype__ == kind.ros_name
        callback(message)

    def tick(self) -> None:
        ((_, callback),) = self.ros.timers
        callback()

    def published(self, topic: str) -> list[Any]:
        return self.ros.publishers[topic].sent

    def wait_for(self, topic: str, count: int = 1) -> Any:
        """Tick until so many messages are published, and return the last one."""

        def ticked() -> bool:
            self.tick()
            return len(self.published(topic)) == count

        wait_until(ticked)
        return self.published(topic)[-1]

    def answer(self, message: Any) -> Any:
        count = len(self.published("~/answers")) + 1
        self.hear("detections", message)
        return json.loads(self.wait_for("~/answers", count).data)

    def status(self) -> Any:
        (status,) = self.published("/diagnostics")[-1].status
        return status


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    started: list[Running] = []

    def start(**parameters: Any) -> Running:
        started.append(Running(monkeypatch, **parameters))
        return started[-1]

    yield start
    for running in started:
        running.node.destroy_node()
        assert running.ros.destroyed


def test_detections_are_answered(run: Run, live: LiveService, recorded: Any) -> None:
    running = run(url=live.url, timeout=60.0)
    answer = running.answer(recorded)
    assert answer["frame_id"] == "base_link"
    assert answer["stamp"] == {"sec": 1751450412, "nanosec": 183000000}
    # The machine of this test knows five of the eight things.
    seen = {entry["object"] for entry in answer["outliers"]["outliers"]}
    assert seen == {"track_3", "track_5", "track_7", "toilet_1", "book_1"}
    assert set(answer["missing"]["ignored"]) == {"track_4", "mouse_1", "cup_1"}
    assert answer["missing"]["observed_relations"]
    assert [note["reason"] for note in answer["notes"]] == ["no-hypothesis"]
    (status,) = running.published("/diagnostics")[0].status
    assert (status.level, status.message) == (0, "answered")
    clear, *shown = running.published("~/ghosts")[0].markers
    assert clear.action == 3
    texts = [marker.text for marker in shown if marker.text]
    best = answer["missing"]["missing"][0]
    assert len(texts) == 3
    assert texts[0].startswith(f"{best['label']}? {best['placements'][0]['relation']} ")
    assert {marker.header.frame_id for marker in shown} == {"base_link"}


def test_parameters_declare_conventions(run: Run, live: LiveService, recorded: Any) -> None:
    running = run(url=live.url, timeout=60.0, units="cm", up="y")
    assert running.node.advisor.conventions == {"units": "cm", "up": "y"}
    for entry in recorded.detections:
        for vector in (entry.bbox.center.position, entry.bbox.size):
            for axis in "xyz":
                setattr(vector, axis, 100 * getattr(vector, axis))
    assert running.answer(recorded)["missing"]


def test_the_api_key_comes_from_a_file(run: Run, recorded: Any, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("incorrect-zebra-capacitor-nail\n")
    for file in (str(tmp_path / "key"), ""):
        heads: list[bytes] = []
        with in_thread(Peer(answering(heads=heads))) as peer:
            running = run(url=peer.url, api_key_file=file)
            running.hear("detections", recorded)
            running.wait_for("/diagnostics")
        key = b"x-api-key: incorrect-zebra-capacitor-nail\r\n"
        assert (key in heads[0].lower()) is bool(file)


def test_only_the_newest_detections_are_sent(run: Run, recorded: Any) -> None:
    running = run()
    client = running.node.advisor.client = Slow(UnreachableError("gone"))
    for second in range(4):
        message = copy.deepcopy(recorded)
        message.header.stamp.sec = second
        running.hear("detections", message)
        running.tick()  # returns though nobody answers
        if second == 0:
            assert client.started.acquire(timeout=PATIENCE)
    assert running.published("/diagnostics") == []
    client.answering.set()
    running.wait_for("/diagnostics", 2)
    assert [fields["stamp"]["sec"] for fields in client.requests] == [0, 3]
    first, second_one = (report.status[0] for report in running.published("/diagnostics"))
    assert first.level == second_one.level == 2
    assert first.message == "UnreachableError: gone"
    assert [entry.value for entry in first.values] == ["2"]
    assert running.published("~/answers") == []


def test_class_ids_need_a_label_map(run: Run, live: LiveService, recorded: Any) -> None:
    numbers = {"desk": "0", "chair": "1"}
    for detection in recorded.detections:
        for result in detection.results:
            name = result.hypothesis.class_id
            result.hypothesis.class_id = numbers.get(name, "9")
    running = run(url=live.url, timeout=60.0)
    running.hear("detections", recorded)
    running.wait_for("/diagnostics")
    assert running.status().message.startswith("MessageError: the class ids are numbers")
    pairs = numbers.items()
    classes = [new("VisionClass", class_id=int(n), class_name=name) for name, n in pairs]
    running.hear("label_info", new("LabelInfo", class_map=classes))
    answer = running.answer(recorded)
    assert {entry["label"] for entry in answer["outliers"]["outliers"]} == {"desk", "chair"}


def test_a_pose_is_the_viewpoint(run: Run, live: LiveService, recorded: Any) -> None:
    def horizontal() -> list[dict[str, str]]:
        relations = running.answer(recorded)["missing"]["observed_relations"]
        return [entry for entry in relations if entry["relation"] in {"left", "front"}]

    running = run(url=live.url, timeout=60.0)
    for message in (recorded, *recorded.detections):
        message.header.frame_id = "map"
    assert horizontal() == []

    pose = blank(STORE, "geometry_msgs/msg/PoseWithCovarianceStamped")
    pose.header.frame_id = "map"
    pose.pose.pose.position.x = 5.0
    pose.pose.pose.orientation.z, pose.pose.pose.orientation.w = 1.0, 0.0
    running.hear("pose", pose)
    # From the other side of the desk the chair stands behind it.
    assert {"subject": "track_3", "relation": "front", "object": "track_7"} in horizontal()

    pose.header.frame_id = "odom"
    running.hear("pose", pose)
    assert horizontal() == []


def test_detections_in_images_are_answered(run: Run, live: LiveService) -> None:
    def detection(name: str, x: float) -> Any:
        hypothesis = new("ObjectHypothesis", class_id=name, score=0.9)
        found = new("Detection2D", results=[new("ObjectHypothesisWithPose", hypothesis=hypothesis)])
        found.bbox.center.position.x = x
        found.bbox.size_x = found.bbox.size_y = 50.0
        return found

    running = run(url=live.url, timeout=60.0, kind="2d", questions=["outliers"])
    detections = [detection("bed", 100.0), detection("lamp", 160.0)]
    answer = running.answer(new("Detection2DArray", detections=detections))
    (entry,) = answer["outliers"]["misplaced"]
    assert [*entry.values()][:3] == ["bed_1", "left", "lamp_1"]


def test_ghosts_stand_at_the_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    load_package(monkeypatch)
    advisor = importlib.import_module("scene_reasoning.advisor")
    ghosts = importlib.import_module("scene_reasoning.ghosts").ghosts
    desk = {"id": "d", "label": "desk", "position": {"x": 1.0, "y": 2.0, "z": 0.4}}
    fields = SceneFields({"objects": [desk, {"id": "c", "label": "chair"}]})
    offset = {"mean": {"x": 0.1, "y": -0.2, "z": 0.5}, "std": {"x": 0.2, "y": 0.0, "z": 9.0}}
    nowhere = {"relation": "front", "object": "c"}
    there = {"relation": "on-top", "object": "d"}
    inside = {"relation": "inside", "object": "d", "offset": None}
    placements: dict[str, list[Any]] = {
        "milk": [],
        "lamp": [nowhere, there | {"offset": offset}],
        "bed": [nowhere],
        "cup": [there],
        "pen": [inside],
        "book": [there],
    }
    missing = [{"label": label, "placements": places} for label, places in placements.items()]
    missing[3] |= {"listed_as": "mug"}
    lamp, cup, pen = ghosts(advisor.Advice(fields, {"missing": {"missing": missing}}), 3)
    assert lamp.text == "lamp? on-top desk"
    assert lamp.position == pytest.approx((1.1, 1.8, 0.9))
    assert lamp.extent == (0.4, 0.05, 1.5)
    assert (cup.text, cup.position, cup.extent) == ("mug? on-top desk", (1.0, 2.0, 0.4), None)
    assert (pen.text, pen.position, pen.extent) == ("pen? inside desk", (1.0, 2.0, 0.4), None)


def test_the_parameter_file_has_the_defaults(run: Run) -> None:
    given = yaml.safe_load((PACKAGE / "config" / "scene.yaml").read_text())
    parameters = given["scene"]["ros__parameters"]
    assert set(run(**parameters).ros.declared) == set(parameters)
    defaults = run().ros.declared
    for name, value in defaults.items():
        assert str(parameters[name]) == str(value), name
