"""Conversion of ROS detections to requests, from JSON and from ROS messages."""

import json
import math
from contextlib import suppress
from itertools import count, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rosbags.typesys.store import Typestore

from app.registry import Store
from scene_client import from_data
from scene_client.ros_fields import COCO, MessageError
from scene_client.schemas import SceneRequest
from scene_client.sightings import MAX_OBJECTS, SceneFields
from scene_client.vision_msgs import (
    from_detection2d_array,
    from_detection3d_array,
    from_message,
)
from tests.chaos.corpus import places, replaced
from tests.client.ros_messages import Layout, blank, filled, through_cdr, to_json
from tests.client.scene_files import EXAMPLES

UNTURNED = (0.0, 0.0, 0.0, 1.0)


def pose(position: Any = (0.0, 0.0, 0.0), turn: Any = UNTURNED) -> dict[str, Any]:
    axes, quaternion = zip("xyz", position, strict=True), zip("xyzw", turn, strict=True)
    return {"position": dict(axes), "orientation": dict(quaternion)}


def result(class_id: Any, score: Any = 0.9, where: Any = None) -> dict[str, Any]:
    return {
        "hypothesis": {"class_id": class_id, "score": score},
        "pose": {"pose": where or pose(), "covariance": [0.0] * 36},
    }


def seen(
    *results: dict[str, Any],
    at: Any = (1.0, 0.0, 0.5),
    size: Any = (0.5, 0.5, 0.5),
    turn: Any = UNTURNED,
    name: str = "",
    frame: str = "",
) -> dict[str, Any]:
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame},
        "results": list(results),
        "bbox": {"center": pose(at, turn), "size": dict(zip("xyz", size, strict=True))},
        "id": name,
    }


def array(*detections: dict[str, Any], frame: str = "base_link", **header: Any) -> dict[str, Any]:
    stamp = {"sec": 3, "nanosec": 4}
    return {"header": {"stamp": stamp, "frame_id": frame, **header}, "detections": list(detections)}


def in_space(
    *detections: Any, label_map: Any = None, frame: str = "base_link", **options: Any
) -> Any:
    return from_detection3d_array(array(*detections, frame=frame), label_map, **options)


def in_image(*detections: Any, frame: str = "base_link") -> SceneFields:
    return from_detection2d_array(array(*detections, frame=frame))


def only(fields: SceneFields) -> dict[str, Any]:
    (thing,) = fields["objects"]
    assert isinstance(thing, dict)
    return thing


def reasons(fields: SceneFields) -> list[tuple[int | None, str]]:
    return [(note.detection, note.reason) for note in fields.notes]


def as_objects(value: Any) -> Any:
    """A message with attributes, as rclpy returns it."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: as_objects(part) for name, part in value.items()})
    return [as_objects(part) for part in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", ["yolo_ros_3d.json", "yolo_ros_2d.json", "moveit.json"])
def test_messages_of_other_packages_may_be_objects(name: str) -> None:
    message = json.loads(EXAMPLES[name].text)
    expected = from_data(message)
    if name == "moveit.json":
        message["world"]["collision_objects"][4]["operation"] = b"\x01"
    else:
        assert from_message(as_objects(message)) == from_message(message) == expected
    fields = from_data(as_objects(message))
    assert fields == expected
    assert fields.notes == expected.notes


BED = {"label": "bed", "confidence": 0.9, "position": {"x": 1.0, "y": 0.0, "z": 0.5}}
SIZED = BED | {"size": {"x": 0.5, "y": 0.5, "z": 0.5}}
UPRIGHT = {"orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
TURNED = {"orientation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}}
SCORES = (0.2, 0.9, math.nan, None)


def bed(**fields: Any) -> dict[str, Any]:
    return seen(result("bed"), **fields)


@pytest.mark.parametrize(
    ("detection", "expected", "reason"),
    [
        # The hypothesis of the highest score counts, wherever it stands in the list.
        (seen(*map(result, ("cat", "bed", "cow", "ant"), SCORES)), SIZED | UPRIGHT, None),
        (seen(result("bed", 120.0)), SIZED | UPRIGHT | {"confidence": 1.0}, "high-score"),
        # A flat box has a size.
        (bed(size=(2, 3, 0)), BED | UPRIGHT | {"size": {"x": 2, "y": 3, "z": 0}}, None),
        (bed(size=(0, 1, 1)), BED | UPRIGHT | {"size": {"x": 0, "y": 1, "z": 1}}, None),
        *[
            (bed(size=size), BED | UPRIGHT, None)
            for size in ((0, 0, 0), (1, -1, 1), (1, 1, math.nan), (1, 1, 1e8))
        ],
        # Quaternions get the length 1.
        (bed(turn=(0, 0, 0, 2)), SIZED | UPRIGHT, None),
        (bed(turn=(0, 0, 3, 4)), SIZED | TURNED, None),
        *[
            (bed(turn=turn), SIZED, None)
            for turn in ((0, 0, 0, 0), (1e-9, 0, 0, 0), (0, 0, 0, math.nan), (1e308,) * 4)
        ],
        *[
            (bed(at=at), {"label": "bed", "confidence": 0.9}, "no-position")
            for at in ((math.nan, 0, 0), (0, math.inf, 1), (None, 1, 2), (1e9, 0, 0))
        ],
    ],
)
def test_detection_values(detection: Any, expected: dict[str, Any], reason: str | None) -> None:
    fields = in_space(detection)
    assert only(fields) == expected | {"id": "bed_1"}
    assert reasons(fields) == ([(0, reason)] if reason else [])


@pytest.mark.parametrize(
    ("results", "reason"),
    [
        ([], "no-hypothesis"),
        *[([result("bed", score)], "no-hypothesis") for score in (math.nan, None)],
        *[([result("bed", score)], "low-score") for score in (0.0, -1.0, 0.29)],
        *[([result(name)], "no-label") for name in ("", "a\nb", "x" * 101, "12")],
        ([result("7")], "unwanted"),
    ],
)
def test_detections_without_a_label_are_left_out(results: Any, reason: str) -> None:
    lamp = seen(result("lamp"))
    fields = in_space(seen(*results), lamp, label_map={"7": None}, min_score=0.3)
    assert only(fields)["label"] == "lamp"
    assert reasons(fields) == [(0, reason)]


def test_an_empty_box_has_the_pose_of_the_hypothesis() -> None:
    where = pose((1, 2, 3))
    empty = {"at": (0, 0, 0), "size": (0, 0, 0)}
    fields = in_space(
        seen(result("cup", 0.1, pose((9, 9, 9))), result("bed", 0.8, where), **empty),
        seen(result("bed"), **empty),
        seen(result("bed", 0.8, where), at=(0, 0, 0)),
    )
    positions = [thing.get("position") for thing in fields["objects"]]
    # A box with a size was filled in, wherever it lies.
    assert positions == [where["position"], None, {"x": 0.0, "y": 0.0, "z": 0.0}]
    assert reasons(fields) == [(1, "no-position")]


def test_ids_of_detections() -> None:
    labels = ("chair", "lamp", "chair", "lamp", "bed", "bed")
    names = ("", "chair_1", "", "chair_1", " \n ", "a\nb")
    detections = (seen(result(label), name=name) for label, name in zip(labels, names, strict=True))
    fields = in_space(*detections)
    ids = [thing["id"] for thing in fields["objects"]]
    assert ids == ["chair_2", "chair_1", "chair_3", "lamp_1", "bed_1", "bed_2"]
    assert reasons(fields) == [(3, "renamed"), (5, "renamed")]


def test_the_most_confident_objects_are_kept() -> None:
    n = MAX_OBJECTS + 40
    scores = [0.1 + 0.8 * (k * 101 % n) / n for k in range(n)]
    cups = (seen(result("cup", score), name=str(k)) for k, score in enumerate(scores))
    fields = in_space(*cups)
    kept = [int(thing["id"]) for thing in fields["objects"]]
    floor = sorted(scores)[-MAX_OBJECTS]
    assert kept == [k for k in range(n) if scores[k] >= floor]
    assert reasons(fields) == [(None, "too-many")]
    SceneRequest(**fields)


@pytest.mark.parametrize(
    ("header", "field", "sent"),
    [
        ({"frame": "base_link"}, "frame_id", "base_link"),
        ({"frame": "/camera_optical_frame"}, "frame_id", "camera_optical_frame"),
        ({"frame": "//robot/map"}, "frame_id", "robot/map"),
        ({"frame": ""}, "frame_id", None),
        ({"frame": "/"}, "frame_id", None),
        ({"stamp": {"sec": 5, "nanosec": 6}}, "stamp", {"sec": 5, "nanosec": 6}),
        ({"stamp": {"secs": 5, "nsecs": 6}}, "stamp", {"sec": 5, "nanosec": 6}),  # ROS 1
        ({"stamp": {"sec": 5, "nanosec": 1_000_000_000}}, "stamp", None),
        ({"stamp": {"sec": None, "nanosec": 0}}, "stamp", None),
    ],
)
def test_frame_and_stamp_of_the_header(header: dict[str, Any], field: str, sent: Any) -> None:
    fields = from_detection3d_array(array(bed(), **header))
    assert fields.get(field) == sent
    assert reasons(fields) == ([(None, "no-stamp")] if field == "stamp" and sent is None else [])


def test_the_frame_of_the_detections() -> None:
    detections = (bed(frame="/odom"), bed(), bed(frame="base_link"))
    fields = in_space(*detections, frame="")
    assert fields["frame_id"] == "odom"
    assert ["position" in thing for thing in fields["objects"]] == [True, True, False]
    assert reasons(fields) == [(2, "no-position")]


@pytest.mark.parametrize(
    "wrong",
    [
        {"viewpoint": (1.0, 2.0)},
        {"viewpoint": (1.0, 2.0, math.nan)},
        {"min_score": math.nan},
        {"unknown_labels": "maybe"},
        {"label_map": "imagenet"},
        {"label_map": {"1": 2}},
    ],
)
def test_wrong_arguments_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(MessageError):
        in_space(seen(result("bed")), **wrong)


@pytest.mark.parametrize(
    "message",
    [
        None,
        [],
        "bed",
        {},
        {"objects": ["bed"]},
        {"detections": "bed"},
        {"detections": [{"results": {}}]},
        {"header": {"frame_id": "a\nb"}, "detections": []},
    ],
)
def test_other_values_are_refused(message: Any) -> None:
    with pytest.raises(MessageError):
        from_message(message)


CHAIR = {"class_id": 56, "class_name": "chair"}


@pytest.mark.parametrize(
    "label_map",
    [
        {"56": "chair", "0": None},
        {56: "chair", 0: None},
        [*(["thing"] * 56), "chair"],
        "coco",
        {"class_map": [CHAIR]},
        blank(
            Layout.current,
            "vision_msgs/msg/LabelInfo",
            class_map=[blank(Layout.current, "vision_msgs/msg/VisionClass", **CHAIR)],
        ),
    ],
)
@pytest.mark.parametrize("class_id", ["56", 56, " 56 "])
def test_numbers_become_labels(label_map: Any, class_id: Any) -> None:
    fields = from_detection3d_array(array(seen(result(class_id)), seen(result("lamp"))), label_map)
    assert [thing["label"] for thing in fields["objects"]] == ["chair", "lamp"]


def test_numbers_without_a_label_map_are_an_error() -> None:
    with pytest.raises(MessageError, match="label_map"):
        from_detection3d_array(array(seen(result("56")), seen(), seen(result("3", 0.0))))
    # With one, a class that it lacks is left out.
    fields = from_detection3d_array(array(seen(result("57")), seen(result("56"))), {"56": "chair"})
    assert reasons(fields) == [(0, "no-label")]


def test_the_default_model_has_indoor_classes_of_coco(repository: Path) -> None:
    store = Store(repository / "model_store")
    vocabulary = store.load(*store.resolve("default")).model.vocabulary
    known = {label for label in COCO if vocabulary.index(label) is not None}
    assert len(COCO) == len(set(COCO)) == 80
    assert {"chair", "couch", "dining table", "cell phone", "refrigerator", "potted plant"} <= known


def flat(
    class_id: str, u: float, v: float, width: float = 40.0, height: float = 40.0, **rest: Any
) -> dict[str, Any]:
    entry = seen(result(class_id, rest.pop("score", 0.9)), **rest)
    centre = {"position": {"x": u, "y": v}, "theta": 0.0}
    return entry | {"bbox": {"center": centre, "size_x": width, "size_y": height}}


def lefts(fields: SceneFields) -> set[tuple[str, str]]:
    assert {entry["relation"] for entry in fields["relations"]} <= {"left"}
    return {(entry["subject"], entry["object"]) for entry in fields["relations"]}


def test_image_boxes_give_left_and_right_of_neighbours() -> None:
    fields = in_image(
        flat("cup", 100, 100),
        flat("bed", 160, 110),  # right of the cup
        flat("lamp", 165, 30),  # above both: no relation
        flat("door", 900, 100),  # far away
        flat("rug", 102, 101),  # at the place of the cup
        frame="camera_optical_frame",
    )
    assert lefts(fields) == {("cup_1", "bed_1"), ("rug_1", "bed_1")}
    assert fields["frame_id"] == "camera_optical_frame"
    assert "relations_complete" not in fields
    assert all(set(thing) == {"id", "label", "confidence"} for thing in fields["objects"])


def test_invalid_boxes_are_reported() -> None:
    fields = in_image(
        flat("cup", 100, 100),
        flat("bed", math.nan, 100),
        flat("lamp", 120, 100, 0, 0),
        flat("rug", 150, 100, frame="other_camera"),
    )
    assert lefts(fields) == set()
    assert reasons(fields) == [(1, "no-box"), (2, "no-box"), (3, "no-box")]


@pytest.mark.parametrize("store", [Layout.current, Layout.former], ids=["current", "former"])
@pytest.mark.parametrize("kind", ["3D", "2D"])
@pytest.mark.parametrize("number", [7.25, -1.0, 0.0, math.nan, math.inf, 1e300])
def test_rosbridge_and_cdr_give_one_scene(store: Typestore, kind: str, number: float) -> None:
    """The first of two detections has this number in every field of a floating-point type."""
    message = filled(store, f"vision_msgs/msg/Detection{kind}Array", repeat(number), 2)
    other = (number / 8 for number in count())
    message.detections[1] = filled(store, f"vision_msgs/msg/Detection{kind}", other, 2)
    convert = from_detection2d_array if kind == "2D" else from_detection3d_array
    by_wire = convert(through_cdr(store, message), "coco")
    bridged = json.loads(json.dumps({"op": "publish", "msg": to_json(message)}))
    by_bridge = from_message(bridged, "coco")
    assert (by_bridge, by_bridge.notes) == (by_wire, by_wire.notes)
    SceneRequest(**by_wire)
    json.dumps(by_wire, allow_nan=False)


@pytest.mark.parametrize("text", [b"null", b"3", b'"x"', b"[]", b"{}", b"[{}]"])
def test_any_message_is_a_request_or_an_error(text: bytes) -> None:
    for message in (array(seen(result("56"), name="t1")), array(flat("chair", 1.0, 2.0))):
        for place in places(message):
            changed = json.loads(replaced(message, place, text))
            for convert in (from_message, from_detection3d_array, from_detection2d_array):
                with suppress(MessageError):
                    SceneRequest(**convert(changed, "coco"))
