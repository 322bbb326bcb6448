"""Small files in the layouts of detectors, annotation tools and simulators, with their scenes.

The command and the Python functions (tests/client/test_files.py) and the service
(tests/http/test_scenes.py) read the same files.
"""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Example:
    """A file.

    Attributes:
        objects: expected (id, label, confidence) or (id, label, confidence, position, size) of each
            object, rounded to centimetres.
        left: expected pairs of ids with the relation left.
        fields: other expected fields of the request.
        notes: expected reasons of notes.
        labels: name of the label map.
        scene: name of the scene to read, if the file has several.
        raw: expected fields of a request that is not converted, in place of all others.
        text: its content. By default, this folder has a file of the same name.
    """

    objects: tuple[tuple[Any, ...], ...] = ()
    left: tuple[tuple[str, str], ...] | None = None
    fields: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    labels: str | None = None
    scene: str | None = None
    raw: dict[str, Any] | None = None
    text: str = ""

    @property
    def expected(self) -> dict[str, Any]:
        """The fields of the request."""
        if self.raw is not None:
            return self.raw
        names = ("id", "label", "confidence", "position", "size")
        objects = [dict(zip(names, thing, strict=False)) for thing in self.objects]
        for thing in objects:
            for name in ("position", "size"):
                if thing.get(name):
                    thing[name] = dict(zip("xyz", thing[name], strict=True))
                else:
                    thing.pop(name, None)
        fields = {"objects": objects, "unknown_labels": "nearest-or-ignore"} | self.fields
        if self.left is not None:
            pairs = [{"subject": a, "relation": "left", "object": b} for a, b in self.left]
            fields["relations"] = pairs
        return fields


FOLDER = Path(__file__).parent / "files"


def content(name: str) -> str:
    """The content of a file of this folder."""
    return (FOLDER / name).read_text("utf-8")


_TRAINING_FIELDS = {
    "room_type": "bedroom",
    "stamp": {"sec": 3, "nanosec": 4},
    "objects": [
        {"id": "bed", "label": "bed"},
        {"id": "lamp_1", "label": "lamp", "supported_by": "bed"},
        {"id": "lamp_2", "label": "lamp"},
    ],
    "relations": [["lamp_1", "left", "lamp_2"]],
    "frame_id": "map",
}

_EXPECTED: dict[str, Example] = {
    "detection3d.json": Example(
        (("rug_1", "rug", 0.9, (2, 0, 0), (2, 3, 0)),),
        fields={"frame_id": "base_link", "stamp": {"sec": 1, "nanosec": 0}},
    ),
    "rosbridge.json": Example((("chair_1", "chair", 0.8),), notes=("no-label",), labels="coco80"),
    "yolo_ros_3d.json": Example(
        (
            ("2", "chair", 0.8, (2, 0.5, 0.4), (0.5, 0.5, 0.9)),
            ("3", "dining table", 0.8, (3, 0.5, 0.4), (1.4, 0.8, 0.7)),
            ("cup_1", "cup", 0.8),
        ),
        fields={"frame_id": "camera_link", "stamp": {"sec": 3, "nanosec": 4}},
        notes=("renamed", "no-position"),
    ),
    "yolo_ros_2d.json": Example(
        (("2", "chair", 0.8), ("3", "dining table", 0.8)),
        (("3", "2"),),
        fields={"frame_id": "camera_color_optical_frame", "stamp": {"sec": 3, "nanosec": 4}},
    ),
    "coco_instances.json": Example(
        (("chair_1", "chair", 1.0), ("dining table_1", "dining table", 1.0)),
        (("chair_1", "dining table_1"),),
        notes=("excluded",),
        scene="7",
    ),
    "coco_results.json": Example(
        (("chair_1", "chair", 0.25), ("dining table_1", "dining table", 0.5)),
        (("dining table_1", "chair_1"),),
        labels="coco91",
    ),
    "ultralytics.json": Example(
        (("dining table_4", "dining table", 0.91), ("chair_1", "chair", 0.88)),
        (("dining table_4", "chair_1"),),
    ),
    "ultralytics_batch.json": Example((("dining table_4", "dining table", 0.91),), (), scene="2"),
    "roboflow.json": Example(
        (("chair_1", "chair", 0.92), ("couch_1", "couch", 0.81)), (("couch_1", "chair_1"),)
    ),
    "roboflow_workflow.json": Example(
        (("chair_1", "chair", 0.92), ("couch_1", "couch", 0.81)), (("couch_1", "chair_1"),)
    ),
    "yolo.txt": Example(
        (
            ("chair_1", "chair", 1.0),
            ("dining table_1", "dining table", 0.75),
            ("clock_1", "clock", 1),
        ),
        (("chair_1", "clock_1"), ("dining table_1", "chair_1")),
        labels="coco80",
    ),
    "label_studio.json": Example(
        (
            ("chair_1", "chair", 1.0),
            ("lamp_1", "lamp", 1.0),
            ("rug_1", "rug", 1.0),
            ("bowl_1", "bowl", 1.0),
        ),
        (("chair_1", "lamp_1"), ("chair_1", "rug_1"), ("lamp_1", "rug_1"), ("rug_1", "bowl_1")),
    ),
    "label_studio_min.json": Example((("chair_1", "chair", 1.0),), ()),
    "cvat.xml": Example(
        (
            ("chair_1", "chair", 1.0),
            ("dining table_1", "dining table", 1.0),
            ("bowl_1", "bowl", 1.0),
            ("cup_1", "cup", 1.0),
        ),
        (
            ("chair_1", "dining table_1"),
            ("dining table_1", "bowl_1"),
            ("dining table_1", "cup_1"),
            ("bowl_1", "cup_1"),
        ),
        notes=("excluded",),
    ),
    "cvat_video.xml": Example(
        (("chair_0", "chair", 1.0), ("lamp_1", "lamp", 1.0)), (("chair_0", "lamp_1"),), scene="0"
    ),
    "detections.csv": Example(
        (
            ("desk_1", "desk", 0.93, (2, 0, 0.37), (0.8, 1.6, 0.74)),
            ("monitor, big_1", "monitor, big", 1.0, (2.2, 0, 0.99)),
        )
    ),
    "boxes.csv": Example(
        (("chair_1", "chair", 0.9), ("table_1", "table", 0.8)), (("chair_1", "table_1"),)
    ),
    "ai2thor.json": Example(
        (
            ("Bed|-01.00|+00.00|+02.00", "Bed", 1.0, (2, 1, 0.3), (2, 1.5, 0.6)),
            ("Mug|+00.10|+00.70|+00.20", "Mug", 1.0, (0.2, -0.1, 0.7)),
        ),
        fields={"frame_id": "map", "viewpoint": {"x": -1.0, "y": -0.5, "yaw": -1.57}},
        notes=("excluded",),
    ),
    "hydra.json": Example(
        (
            ("O(0)", "chair", 1.0, (2, 0.5, 0.5), (0.6, 0.4, 0.8)),
            ("O(1)", "desk", 1.0, (3, 0.5, 0.4)),
        ),
        fields={"frame_id": "map"},
        scene="R(0)",
    ),
    "scannet.json": Example(
        (
            ("trash can_1", "trash can", 1.0, (0.1, 0.2, 0.3), (0.3, 0.5, 0.8)),
            ("office chair_2", "office chair", 1.0),
        ),
        fields={"frame_id": "map"},
    ),
    "moveit.json": Example(
        (
            ("table", "table", 1.0, (0.5, 0, 0.36), (0.8, 1.2, 0.72)),
            ("cup_1", "cup_1", 1.0, (0.5, 0, 0.79), (0.08, 0.08, 0.1)),
            ("ball", "ball", 1.0, (0.5, 0, 0.1), (0.2, 0.2, 0.2)),
            ("book", "book", 1.0, (0.45, 0.1, 1.15), (0.2, 0.1, 0.3)),
            ("bowl", "bowl", 1.0),
        ),
        fields={"frame_id": "panda_link0"},
        notes=("excluded", "no-position"),
    ),
    "training.json": Example(raw=_TRAINING_FIELDS),
    "training.jsonl": Example(raw=_TRAINING_FIELDS, scene="3"),
    "bare_training.json": Example(
        raw={k: v for k, v in _TRAINING_FIELDS.items() if k != "frame_id"}
    ),
    "recorded.jsonl": Example(
        raw={name: json.loads(content("recorded.jsonl"))[name] for name in ("objects", "stamp")}
    ),
    "boxes2d.json": Example(
        raw={
            "objects": [{"id": "bed", "label": "bed"}, {"id": "lamp", "label": "lamp"}],
            "relations": [["bed", "left", "lamp"]],
        }
    ),
    "request.json": Example(raw=json.loads(content("request.json"))),
    "numbers.json": Example(
        raw={"objects": [{"label": "chair", "confidence": 0.8}, "bed"]}, labels="coco80"
    ),
    "labels.txt": Example(raw={"objects": ["bed", "lamp", "mug"]}),
    "thousands.json": Example(
        tuple((f"chair_{n + 1}", "chair", 1 - n / 1e4) for n in range(256)),
        (),
        labels="coco91",
        notes=("no-box",) * 256 + ("too-many",) * 2744,
        text=json.dumps(
            [{"image_id": 1, "category_id": 62, "score": 1 - n / 1e4} for n in range(3000)]
        ),
    ),
}
EXAMPLES = {name: replace(one, text=one.text or content(name)) for name, one in _EXPECTED.items()}

_IDS = "class ids are numbers"

REFUSED: dict[str, tuple[str, str]] = {
    "results.json": (content("coco_results.json"), _IDS),
    "yolo.txt": (content("yolo.txt"), _IDS),
    "numeric.json": (
        '{"detections": [{"results": [{"hypothesis": {"class_id": "56", "score": 0.8}}]}]}',
        _IDS,
    ),
    "numbers.json": ('["56"]', "class id instead of a label"),
    "coco.json": (content("coco_instances.json"), "2 scenes (7, 9): choose one"),
    "rooms.json": (content("hydra.json"), "2 scenes (R(0), R(1)): choose one"),
    "lines.jsonl": ('{"objects": []}\n{"objects": []}', "2 scenes (1, 2): choose one"),
    "captions.json": (
        json.dumps({"images": [], "annotations": [{"id": 1, "image_id": 1, "caption": "A bed."}]}),
        "instances_",
    ),
    "classes.json": (json.dumps([{"name": "bed", "class": 1, "confidence": 0.9}]), "classifier"),
    "truncated.json": (content("hydra.json")[:-200], "not JSON"),
    "truncated.xml": (content("cvat.xml")[:-30], "not XML"),
    "deep.json": ("[" * 5_000 + "]" * 5_000, "nesting is too deep"),
    "bomb.xml": (
        '<!DOCTYPE a [<!ENTITY b "bbbbbbbbbb">]><annotations>&b;</annotations>',
        "document type",
    ),
    "page.xml": ("<html><body/></html>", "root <html>"),
    "echo.txt": ("header:\n  stamp:\n    sec: 1\ndetections: []\n", "YAML"),
    "no_header.csv": ("desk,2.0,0.0,0.37\n", "not JSON"),
    "words.csv": ("label,x,y,z\ndesk,two,0,0\n", "line 2, column x: 'two'"),
    "unknown.json": ('{"shapes": [], "version": "5.0"}', "shapes, version"),
    "value.json": ("3", "a JSON value"),
    "empty.json": ("", "not JSON"),
    "twins.json": (json.dumps({"objects": [{"id": 1, "label": "bed"}] * 2}), "training format"),
    "no_type.json": (
        json.dumps({"objects": [{"objectType": "Bed", "position": {"x": 1}}]}),
        "looks like AI2-THOR",
    ),
    "empty.csv": ("label,x,y,z\n", "no objects"),
}
"""Files without a scene, or with several: the content and words of the error."""
