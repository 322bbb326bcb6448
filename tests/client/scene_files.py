"""Small files in the layouts of detectors, annotation tools and simulators, with their scenes.

The command and the Python functions (tests/client/test_files.py) and the service
(tests/http/test_scenes.py) read the same files.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Example:
    """A file.

    Attributes:
        text: its content.
        objects: expected (id, label, confidence) or (id, label, confidence, position, size) of each
            object, rounded to centimetres.
        left: expected pairs of ids with the relation left.
        fields: other expected fields of the request.
        notes: expected reasons of notes.
        labels: name of the label map.
        scene: name of the scene to read, if the file has several.
        raw: expected fields of a request that is not converted, in place of all others.
    """

    text: str
    objects: tuple[tuple[Any, ...], ...] = ()
    left: tuple[tuple[str, str], ...] | None = None
    fields: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    labels: str | None = None
    scene: str | None = None
    raw: dict[str, Any] | None = None

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


def _pose(x: float, y: float, z: float, w: float = 1.0, turn: float = 0.0) -> dict[str, Any]:
    return {
        "position": {"x": x, "y": y, "z": z},
        "orientation": {"x": 0, "y": 0, "z": turn, "w": w},
    }


_HEADER = {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "camera_color_optical_frame"}


def _vision(class_id: Any, score: Any = 0.8, **fields: Any) -> dict[str, Any]:
    return {"results": [{"hypothesis": {"class_id": class_id, "score": score}}], **fields}


def _yolo_ros(name: str, x: float, **solid: Any) -> dict[str, Any]:
    return {
        "class_id": 56,
        "class_name": name,
        "score": 0.8,
        "id": "2" if name == "chair" else "3",
        "bbox": {
            "center": {"position": {"x": x, "y": 90.0}, "theta": 0.0},
            "size": {"x": 60.0, "y": 80.0},
        },
        "bbox3d": {"center": _pose(0, 0, 0), "size": {"x": 0, "y": 0, "z": 0}, "frame_id": ""}
        | solid,
        "mask": {"height": 0, "width": 0, "data": []},
    }


def _solid(x: float, size: tuple[float, float, float], frame: str) -> dict[str, Any]:
    return {
        "center": _pose(x, 0.5, 0.4),
        "size": dict(zip("xyz", size, strict=True)),
        "frame_id": frame,
    }


_COCO = {
    "images": [{"id": 7, "file_name": "a.jpg"}, {"id": 9, "file_name": "b.jpg"}],
    "categories": [{"id": 3, "name": "chair"}, {"id": 5, "name": "dining table"}],
    "annotations": [
        {"id": 1, "image_id": 7, "category_id": 3, "bbox": [10, 10, 50, 80], "iscrowd": 0},
        {"id": 2, "image_id": 7, "category_id": 5, "bbox": [70, 10, 200, 80], "iscrowd": 0},
        {"id": 3, "image_id": 7, "category_id": 3, "bbox": [0, 0, 300, 90], "iscrowd": 1},
        {"id": 4, "image_id": 9, "category_id": 5, "bbox": [70, 10, 200, 80], "iscrowd": 0},
    ],
}

_RESULTS = [
    {"image_id": 42, "category_id": 62, "bbox": [258.15, 41.29, 60.0, 90.0], "score": 0.25},
    {"image_id": 42, "category_id": 67, "bbox": [61, 22.75, 120, 110], "score": 0.5},
]

_ULTRALYTICS = [
    {
        "name": "dining table", "class": 60, "confidence": 0.91,
        "box": {"x1": 12.1, "y1": 200.4, "x2": 420.0, "y2": 470.2}, "track_id": 4,
    },
    {
        "name": "chair", "class": 56, "confidence": 0.88,
        "box": {
            "x1": 430.0, "y1": 300.0, "x2": 500.0, "y2": 310.0,
            "x3": 490.0, "y3": 400.0, "x4": 420.0, "y4": 390.0,
        },
    },
]  # fmt: skip

_ROBOFLOW = {
    "predictions": [
        {
            "x": 320.5, "y": 180, "width": 120, "height": 90, "confidence": 0.92,
            "class": "chair", "class_id": 0, "detection_id": "9a1f",
        },
        {
            "x": 100, "y": 200, "width": 220, "height": 190, "confidence": 0.81,
            "class": "couch", "class_id": 1, "detection_id": "9a2f",
        },
    ],
    "image": {"width": 640, "height": 480},
}  # fmt: skip


def _region(label: str, **value: Any) -> dict[str, Any]:
    kind = next((name for name in ("polygon", "ellipse") if f"{name}labels" in value), "rectangle")
    return {
        "id": "x",
        "type": f"{kind}labels",
        "original_width": 640,
        "original_height": 480,
        "value": {"rotation": 0, f"{kind}labels": [label]} | value,
    }


_LABEL_STUDIO = [
    {
        "id": 11,
        "data": {"image": "/data/upload/1/a.jpg"},
        "annotations": [
            {"was_cancelled": True, "result": []},
            {
                "result": [
                    # Turned by a quarter about its upper left corner, the box lies at its left.
                    _region("chair", x=30, y=20, width=40, height=10, rotation=90),
                    _region("lamp", x=40, y=30, width=10, height=20),
                    _region("rug", polygonlabels=["rug"], points=[[60, 20], [80, 20], [70, 60]]),
                    _region("bowl", ellipselabels=["bowl"], x=92, y=40, radiusX=3, radiusY=9),
                    {"type": "choices", "value": {"choices": ["indoor"]}},
                ]
            },
        ],
        "predictions": [],
    }
]

_CVAT = """<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta><task><name>flat</name><labels><label><name>chair</name></label></labels></task></meta>
  <image id="0" name="a.jpg" width="640" height="480">
    <box label="chair" source="manual" occluded="0" xtl="10.0" ytl="20.5" xbr="110" ybr="220"
      z_order="0"><attribute name="colour">red</attribute></box>
    <polygon label="dining table" points="150.0,100.0;300.5,100.0;300.0,210.0" z_order="0"/>
    <ellipse label="bowl" cx="340" cy="150" rx="20" ry="40" z_order="0"/>
    <mask label="cup" left="400" top="120" width="30" height="60" rle="1, 2" z_order="0"/>
    <tag label="indoor"/>
  </image>
</annotations>
"""

_CVAT_VIDEO = """<annotations><version>1.1</version>
  <track id="0" label="chair" source="manual">
    <box frame="0" keyframe="1" outside="0" xtl="10" ytl="20" xbr="110" ybr="220"/>
    <box frame="1" keyframe="1" outside="1" xtl="10" ytl="20" xbr="110" ybr="220"/>
  </track>
  <track id="1" label="lamp" source="manual">
    <box frame="0" keyframe="1" outside="0" xtl="120" ytl="20" xbr="210" ybr="220"/>
    <box frame="1" keyframe="0" outside="0" xtl="120" ytl="20" xbr="210" ybr="220"/>
  </track>
</annotations>"""

_THOR = {
    "sceneName": "FloorPlan301_physics",
    "agent": {
        "position": {"x": 0.5, "y": 0.9, "z": -1.0},
        "rotation": {"x": 0, "y": 90.0, "z": 0},
        "cameraHorizon": 30.0,
    },
    "objects": [
        {
            "name": "Bed_3f", "objectId": "Bed|-01.00|+00.00|+02.00", "objectType": "Bed",
            "position": {"x": -1.0, "y": 0.0, "z": 2.0}, "rotation": {"x": 0, "y": 90, "z": 0},
            "axisAlignedBoundingBox": {
                "center": {"x": -1.0, "y": 0.3, "z": 2.0}, "size": {"x": 1.5, "y": 0.6, "z": 2.0},
            },
            "visible": True,
        },
        {
            "name": "Mug_1", "objectId": "Mug|+00.10|+00.70|+00.20", "objectType": "Mug",
            "position": {"x": 0.1, "y": 0.7, "z": 0.2}, "rotation": {"x": 0, "y": 0, "z": 0},
            "axisAlignedBoundingBox": None, "visible": True,
        },
        {
            "name": "Desk_1", "objectId": "Desk|1|0|1", "objectType": "Desk",
            "position": {"x": 1, "y": 0, "z": 1}, "visible": False,
        },
    ],
}  # fmt: skip


def _symbol(letter: str, number: int) -> int:
    """The id of a node of Spark-DSG, which needs 64 bits."""
    return (ord(letter) << 56) + number


def _hydra_object(number: int, label: int, **box: Any) -> dict[str, Any]:
    return {
        "id": _symbol("O", number),
        "layer": 2,
        "attributes": {
            "type": "ObjectNodeAttributes",
            "position": [2.0 + number, 0.5, 0.4],
            "name": f"O({number})",
            "semantic_label": label,
            "bounding_box": {
                "type": "RAABB",
                "dimensions": [0.6, 0.4, 0.8],
                "world_P_center": [2.0 + number, 0.5, 0.5],
                "world_R_center": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0},
            }
            | box,
        },
    }


_UNBOXED = {
    "type": "INVALID", "dimensions": [0, 0, 0], "world_P_center": [0, 0, 0],
    "world_R_center": {"w": 1.0, "x": 0, "y": 0, "z": 0},
}  # fmt: skip

_HYDRA = {
    "SPARK_DSG_header": {"project_name": "main", "version": {"major": 1, "minor": 1, "patch": 0}},
    "directed": False,
    "layer_ids": [2, 3, 4, 5],
    "nodes": [
        _hydra_object(0, 3),
        _hydra_object(1, 5, **_UNBOXED),
        _hydra_object(2, 3),
        *(
            {"id": _symbol("p", n), "layer": 3, "attributes": {"type": "PlaceNodeAttributes"}}
            for n in range(2)
        ),
        *(
            {
                "id": _symbol("R", n),
                "layer": 4,
                "attributes": {"type": "RoomNodeAttributes", "name": f"R({n})"},
            }
            for n in range(2)
        ),
    ],
    "edges": [
        {"source": _symbol("p", 0), "target": _symbol("O", 0), "info": {}},
        {"source": _symbol("O", 1), "target": _symbol("p", 0), "info": {}},
        {"source": _symbol("p", 1), "target": _symbol("O", 2), "info": {}},
        {"source": _symbol("R", 0), "target": _symbol("p", 0), "info": {}},
        {"source": _symbol("R", 1), "target": _symbol("p", 1), "info": {}},
        {"source": _symbol("p", 0), "target": _symbol("p", 1), "info": {}},
    ],
    "metadata": {"labelspaces": {"_l2p0": [[3, "chair"], [5, "desk"]]}},
}

_SCANNET = {
    "scan_id": "x",
    "segGroups": [
        {
            "id": 1, "objectId": 1, "label": "trash can", "segments": [1, 2],
            "obb": {
                "centroid": [0.1, 0.2, 0.3], "axesLengths": [0.3, 0.8, 0.5],
                "normalizedAxes": [0, 1, 0, 0, 0, 1, 1, 0, 0],
            },
        },
        {"id": 2, "label": "office chair", "segments": [3]},
    ],
}  # fmt: skip


def _collision(
    name: str, kind: int, dimensions: list[float], z: float, **fields: Any
) -> dict[str, Any]:
    return {
        "id": name,
        "type": {"key": "", "db": ""},
        "header": {"frame_id": "panda_link0"},
        "pose": _pose(0.5, 0.0, z),
        "primitives": [{"type": kind, "dimensions": dimensions}],
        "primitive_poses": [],
        "operation": 0,
    } | fields


_LEGS = {
    "primitives": [
        {"type": 1, "dimensions": [0.8, 1.2, 0.04]},
        {"type": 3, "dimensions": [0.7, 0.05]},
    ],
    "primitive_poses": [_pose(0, 0, 0.35), _pose(0, 0, 0)],
}
_WEDGE = {
    "primitives": [],
    "meshes": [
        {
            "triangles": [{"vertex_indices": [0, 1, 2]}],
            "vertices": [
                {"x": 0, "y": 0, "z": 0}, {"x": 0.2, "y": 0, "z": 0}, {"x": 0, "y": 0.1, "z": 0.3},
            ],
        }
    ],
    "mesh_poses": [_pose(0, 0, 0, w=0.5**0.5, turn=0.5**0.5)],
}  # fmt: skip
_MOVEIT = {
    "name": "(noname)",
    "world": {
        "collision_objects": [
            _collision("table", 1, [], 0.35, **_LEGS),
            _collision("cup_1", 3, [0.1, 0.04], 0.79),
            _collision("ball", 2, [0.1], 0.1),
            _collision("book", 1, [], 1.0, **_WEDGE),
            _collision("old", 1, [1, 1, 1], 0, operation=1),
        ]
    },
    "robot_state": {
        "attached_collision_objects": [
            {
                "link_name": "hand",
                "object": _collision("bowl", 3, [0.1, 0.1], 0) | {"header": {"frame_id": "hand"}},
            }
        ]
    },
}

_TRAINING = {
    "scene_id": "one", "group": "home", "room_type": "bedroom", "confirmed": True,
    "stamp": {"sec": 3, "nanosec": 4}, "counts": {"lamp": 2}, "false_relations": [],
    "objects": [
        {"id": 0, "label": "bed"},
        {"id": 1, "label": "lamp", "supported_by": 0},
        {"id": 2, "label": "lamp", "position": None},
    ],
    "relations": [[1, "left", 2]],
}  # fmt: skip
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
_REQUEST = {
    "objects": [
        {"id": "bed", "label": "bed", "position": {"x": 2, "y": 0, "z": 0.2}},
        {"id": "lamp", "label": "lamp", "position": [2, 1, 0.2], "yaw": 0.5},
        "rug",
    ],
    "relations": [["lamp", "on-top", "bed"]],
    "top_k": 3,
}
_RECORDED = {
    "scene_id": "2026-11-27T02-1f", "group": "2026-11-27T02", "viewer_frame": True,
    "objects": [
        {"id": "track_1", "label": "desk", "position": [2.0, 0.1, 0.37], "size": [0.8, 1.6, 0.74]},
        {"id": "mug", "label": "mug", "supported_by": "track_1"},
    ],
    "stamp": {"sec": 3, "nanosec": 4},
    "confirmed": True,
}  # fmt: skip
_BOXES2D = {
    "objects": [
        {"id": 0, "label": "bed", "box2d": [0, 0, 40, 40]},
        {"id": 1, "label": "lamp", "box2d": [50, 0, 70, 40]},
    ],
}


def _json(value: Any) -> str:
    return json.dumps(value)


EXAMPLES: dict[str, Example] = {
    "detection3d.json": Example(
        '{"header": {"frame_id": "base_link", "stamp": {"sec": 1, "nanosec": 0}}, "detections": [{'
        '"results": [{"hypothesis": {"class_id": "rug", "score": 0.9}, "pose": {"pose": {'
        '"position": {"x": NaN, "y": null, "z": -Infinity}}, "covariance": [NaN, 1e999]}}],'
        '"bbox": {"center": {"position": {"x": 2, "y": 0, "z": 0}}, "size": '
        '{"x": 2, "y": 3, "z": 0}}}]}',
        (("rug_1", "rug", 0.9, (2, 0, 0), (2, 3, 0)),),
        fields={"frame_id": "base_link", "stamp": {"sec": 1, "nanosec": 0}},
    ),
    "rosbridge.json": Example(
        _json({"op": "publish", "msg": {"detections": [_vision("56"), _vision("x" * 101)]}}),
        (("chair_1", "chair", 0.8),),
        notes=("no-label",),
        labels="coco80",
    ),
    "yolo_ros_3d.json": Example(
        _json(
            {
                "header": _HEADER,
                "detections": [
                    _yolo_ros("chair", 500, **_solid(2.0, (0.5, 0.5, 0.9), "camera_link")),
                    _yolo_ros("dining table", 300, **_solid(3.0, (1.4, 0.8, 0.7), "camera_link")),
                    _yolo_ros("cup", 300, **_solid(3.0, (0.1, 0.1, 0.1), "map")),
                ],
            }
        ),
        (
            ("2", "chair", 0.8, (2, 0.5, 0.4), (0.5, 0.5, 0.9)),
            ("3", "dining table", 0.8, (3, 0.5, 0.4), (1.4, 0.8, 0.7)),
            ("cup_1", "cup", 0.8),
        ),
        fields={"frame_id": "camera_link", "stamp": {"sec": 3, "nanosec": 4}},
        notes=("renamed", "no-position"),
    ),
    "yolo_ros_2d.json": Example(
        _json(
            {
                "header": _HEADER,
                "detections": [_yolo_ros("chair", 300), _yolo_ros("dining table", 200)],
            }
        ),
        (("2", "chair", 0.8), ("3", "dining table", 0.8)),
        (("3", "2"),),
        fields={
            "frame_id": "camera_color_optical_frame",
            "stamp": {"sec": 3, "nanosec": 4},
        },
    ),
    "coco_instances.json": Example(
        _json(_COCO),
        (("chair_1", "chair", 1.0), ("dining table_1", "dining table", 1.0)),
        (("chair_1", "dining table_1"),),
        notes=("excluded",),
        scene="7",
    ),
    "coco_results.json": Example(
        _json(_RESULTS),
        (("chair_1", "chair", 0.25), ("dining table_1", "dining table", 0.5)),
        (("dining table_1", "chair_1"),),
        labels="coco91",
    ),
    "ultralytics.json": Example(
        _json(_ULTRALYTICS),
        (("dining table_4", "dining table", 0.91), ("chair_1", "chair", 0.88)),
        (("dining table_4", "chair_1"),),
    ),
    "ultralytics_batch.json": Example(
        _json([[], _ULTRALYTICS[:1]]),
        (("dining table_4", "dining table", 0.91),),
        (),
        scene="2",
    ),
    "roboflow.json": Example(
        _json(_ROBOFLOW),
        (("chair_1", "chair", 0.92), ("couch_1", "couch", 0.81)),
        (("couch_1", "chair_1"),),
    ),
    "roboflow_workflow.json": Example(
        _json(
            [{"predictions": {"image": {"width": 640}, "predictions": _ROBOFLOW["predictions"]}}]
        ),
        (("chair_1", "chair", 0.92), ("couch_1", "couch", 0.81)),
        (("couch_1", "chair_1"),),
    ),
    "yolo.txt": Example(
        "56 0.5 0.5 0.2 0.4\n60 0.3 0.6 0.1 0.3 0.75\n74 0.7 0.4 0.8 0.4 0.8 0.6\n",
        (
            ("chair_1", "chair", 1.0),
            ("dining table_1", "dining table", 0.75),
            ("clock_1", "clock", 1),
        ),
        (("chair_1", "clock_1"), ("dining table_1", "chair_1")),
        labels="coco80",
    ),
    "label_studio.json": Example(
        _json(_LABEL_STUDIO),
        (
            ("chair_1", "chair", 1.0),
            ("lamp_1", "lamp", 1.0),
            ("rug_1", "rug", 1.0),
            ("bowl_1", "bowl", 1.0),
        ),
        (("chair_1", "lamp_1"), ("chair_1", "rug_1"), ("lamp_1", "rug_1"), ("rug_1", "bowl_1")),
    ),
    "label_studio_min.json": Example(
        _json(
            [
                {
                    "image": "a.jpg",
                    "id": 11,
                    "label": [
                        {
                            "x": 10,
                            "y": 20,
                            "width": 30,
                            "height": 40,
                            "rotation": 0,
                            "rectanglelabels": ["chair"],
                        }
                    ],
                }
            ]
        ),
        (("chair_1", "chair", 1.0),),
        (),
    ),
    "cvat.xml": Example(
        _CVAT,
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
        _CVAT_VIDEO,
        (("chair_0", "chair", 1.0), ("lamp_1", "lamp", 1.0)),
        (("chair_0", "lamp_1"),),
        scene="0",
    ),
    "detections.csv": Example(
        "label,x,y,z,sx,sy,sz,id,confidence\ndesk,2.0,0.0,0.37,.8,1.6,0.74,desk_1,0.93\n"
        '\n"monitor, big",2.2,0,9.9e-1,,,,,\n',
        (
            ("desk_1", "desk", 0.93, (2, 0, 0.37), (0.8, 1.6, 0.74)),
            ("monitor, big_1", "monitor, big", 1.0, (2.2, 0, 0.99)),
        ),
    ),
    "boxes.csv": Example(
        "xmin;ymin;xmax;ymax;confidence;class;name\n1;2;40;60;0.9;56;chair\n50;2;90;60;0.8;60;table\n",
        (("chair_1", "chair", 0.9), ("table_1", "table", 0.8)),
        (("chair_1", "table_1"),),
    ),
    "ai2thor.json": Example(
        _json(_THOR),
        (
            ("Bed|-01.00|+00.00|+02.00", "Bed", 1.0, (2, 1, 0.3), (2, 1.5, 0.6)),
            ("Mug|+00.10|+00.70|+00.20", "Mug", 1.0, (0.2, -0.1, 0.7)),
        ),
        fields={"frame_id": "map", "viewpoint": {"x": -1.0, "y": -0.5, "yaw": -1.57}},
        notes=("excluded",),
    ),
    "hydra.json": Example(
        _json(_HYDRA),
        (
            ("O(0)", "chair", 1.0, (2, 0.5, 0.5), (0.6, 0.4, 0.8)),
            ("O(1)", "desk", 1.0, (3, 0.5, 0.4)),
        ),
        fields={"frame_id": "map"},
        scene="R(0)",
    ),
    "scannet.json": Example(
        _json(_SCANNET),
        (
            ("trash can_1", "trash can", 1.0, (0.1, 0.2, 0.3), (0.3, 0.5, 0.8)),
            ("office chair_2", "office chair", 1.0),
        ),
        fields={"frame_id": "map"},
    ),
    "moveit.json": Example(
        _json(_MOVEIT),
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
    "training.json": Example(_json(_TRAINING), raw=_TRAINING_FIELDS),
    "training.jsonl": Example(
        _json(_REQUEST) + "\n\n" + _json(_TRAINING) + "\n", raw=_TRAINING_FIELDS, scene="3"
    ),
    "bare_training.json": Example(
        _json({k: v for k, v in _TRAINING.items() if k not in ("scene_id", "confirmed")}),
        raw={k: v for k, v in _TRAINING_FIELDS.items() if k != "frame_id"},
    ),
    "recorded.jsonl": Example(
        _json(_RECORDED) + "\n",
        raw={"objects": _RECORDED["objects"], "stamp": {"sec": 3, "nanosec": 4}},
    ),
    "boxes2d.json": Example(
        _json(_BOXES2D),
        raw={
            "objects": [{"id": "bed", "label": "bed"}, {"id": "lamp", "label": "lamp"}],
            "relations": [["bed", "left", "lamp"]],
        },
    ),
    "request.json": Example(_json(_REQUEST), raw=_REQUEST),
    "numbers.json": Example(
        '[{"label": "56", "confidence": 0.8}, "59"]',
        raw={"objects": [{"label": "chair", "confidence": 0.8}, "bed"]},
        labels="coco80",
    ),
    "labels.txt": Example("bed, lamp\nmug\n", raw={"objects": ["bed", "lamp", "mug"]}),
    "thousands.json": Example(
        _json([{"image_id": 1, "category_id": 62, "score": 1 - n / 1e4} for n in range(3000)]),
        tuple((f"chair_{n + 1}", "chair", 1 - n / 1e4) for n in range(256)),
        (),
        labels="coco91",
        notes=("no-box",) * 256 + ("too-many",) * 2744,
    ),
}

_IDS = "class ids are numbers"

REFUSED: dict[str, tuple[str, str]] = {
    "results.json": (_json(_RESULTS), _IDS),
    "yolo.txt": (EXAMPLES["yolo.txt"].text, _IDS),
    "numeric.json": (_json({"detections": [_vision("56")]}), _IDS),
    "numbers.json": ('["56"]', "class id instead of a label"),
    "coco.json": (_json(_COCO), "2 scenes (7, 9): choose one"),
    "rooms.json": (_json(_HYDRA), "2 scenes (R(0), R(1)): choose one"),
    "lines.jsonl": ('{"objects": []}\n{"objects": []}', "2 scenes (1, 2): choose one"),
    "captions.json": (
        _json({"images": [], "annotations": [{"id": 1, "image_id": 1, "caption": "A bed."}]}),
        "instances_",
    ),
    "classes.json": (
        _json([{"name": "bed", "class": 1, "confidence": 0.9}]),
        "classifier",
    ),
    "truncated.json": (_json(_HYDRA)[:-200], "not JSON"),
    "truncated.xml": (_CVAT[:-30], "not XML"),
    "deep.json": ("[" * 200_000 + "]" * 200_000, ""),
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
    "twins.json": (
        _json({"objects": [{"id": 1, "label": "bed"}] * 2}),
        "training format",
    ),
    "no_type.json": (
        _json({"objects": [{"objectType": "Bed", "position": {"x": 1}}]}),
        "looks like AI2-THOR",
    ),
    "empty.csv": ("label,x,y,z\n", "no objects"),
}
"""Files without a scene, or with several: the content and words of the error."""
