"""Readers of formats with boxes in images: COCO, Ultralytics, Roboflow, YOLO, Label Studio, CVAT.

A function ``..._parts`` returns the data of each image by its id. A function ``read_...`` converts
the data of one image. All other exceptions than `MessageError` mean a value of a wrong type.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final
from xml.etree.ElementTree import Element

from scene_client.ros_fields import MessageError, number, text
from scene_client.sightings import Message, box_between, detection, excluded, image_box

Parts = dict[str, Any]


class Lines(list[list[str]]):
    """Numbers of each line of a YOLO file, as text."""


def are_dicts(data: Any, *names: str) -> bool:
    """Return whether a value is a non-empty list of dictionaries that have all these names."""
    return (
        isinstance(data, list)
        and bool(data)
        and all(isinstance(one, dict) and all(name in one for name in names) for one in data)
    )


def has_list(data: Any, name: str) -> bool:
    """Return whether a value is a dictionary with a list of this name."""
    return isinstance(data, dict) and isinstance(data.get(name), list)


# ---------------------------------------------------------------------------------------- COCO


def is_coco(data: Any) -> bool:
    """Return whether the data is a list of COCO's results, or a file with annotations."""
    is_file = has_list(data, "annotations") and ("images" in data or "categories" in data)
    return is_file or are_dicts(data, "category_id")


def coco_parts(data: Any) -> Parts:
    """Return the entries of each image, and the names of the categories."""
    entries, names = data, {}
    if isinstance(data, dict):
        entries = data["annotations"]
        names = {str(one["id"]): one["name"] for one in data.get("categories") or ()}
    parts: Parts = {}
    for entry in entries:
        parts.setdefault(str(entry.get("image_id", "")), ([], names))[0].append(entry)
    return parts


def read_coco(part: Any) -> Message:
    """Convert the entries of one image. A box around a crowd stands for several objects."""
    entries, names = part
    if not all("category_id" in entry for entry in entries):
        raise MessageError(
            "COCO captions and panoptic segments have no boxes: use the file instances_….json"
        )
    single = [entry for entry in entries if entry.get("iscrowd") not in (1, True)]
    return Message(
        [
            detection(
                names.get(str(entry["category_id"]), entry["category_id"]),
                entry.get("score", 1.0),
                **_corner_box(*(entry.get("bbox") or [None] * 4)),
            )
            for entry in single
        ],
        notes=excluded(len(entries) - len(single), "boxes around crowds"),
    )


def _corner_box(x: Any, y: Any, width: Any, height: Any) -> dict[str, Any]:
    left, top, across, down = (
        math.nan if (value := number(part)) is None else value for part in (x, y, width, height)
    )
    return image_box(left + across / 2, top + down / 2, across, down)


# ------------------------------------------------------------------------------------ detectors


def is_ultralytics(data: Any) -> bool:
    """Return whether the data is a list from `tojson()`, or a list of such lists, one an image."""
    is_batch = isinstance(data, list) and all(isinstance(one, list) for one in data)
    results = [one for one in data if one] if is_batch else [data]
    return bool(results) and all(are_dicts(one, "name", "class", "confidence") for one in results)


def ultralytics_parts(data: Any) -> Parts:
    """Return the results of each image, by their number from 1."""
    if isinstance(data[0], dict):
        return {"1": data}
    return {str(number): results for number, results in enumerate(data, 1)}


def read_ultralytics(part: Any) -> Message:
    """Convert results of Ultralytics. A result without a box is a class of the whole image."""
    if any("box" not in entry for entry in part):
        raise MessageError("the results of a classifier list no objects: use a detection model")
    return Message(
        [
            detection(
                entry["name"] or entry["class"],
                entry["confidence"],
                _tracked(entry["name"], entry.get("track_id")),
                **box_between(*_corners(entry["box"])),
            )
            for entry in part
        ]
    )


def _tracked(label: Any, track: Any) -> str:
    return f"{text(label)}_{text(track)}" if text(track) else ""


def _corners(box: Mapping[str, Any]) -> tuple[list[Any], list[Any]]:
    xs, ys = ([box[name] for name in sorted(box) if name[0] == axis] for axis in "xy")
    return xs, ys


def is_roboflow(data: Any) -> bool:
    """Return whether the data is an answer of Roboflow, or a list of answers."""
    answers = data if isinstance(data, list) else [data]
    return bool(answers) and all(map(_is_roboflow_answer, answers))


def _is_roboflow_answer(data: Any) -> bool:
    entries = data.get("predictions") if isinstance(data, dict) else None
    if isinstance(entries, dict):  # the output of a workflow
        entries = entries.get("predictions")
    return are_dicts(entries, "x", "width", "class") or (entries == [] and "image" in data)


def roboflow_parts(data: Any) -> Parts:
    """Return the predictions of each image, by their number from 1."""
    answers = data if isinstance(data, list) else [data]
    predictions = [answer["predictions"] for answer in answers]
    return {
        str(number): one["predictions"] if isinstance(one, dict) else one
        for number, one in enumerate(predictions, 1)
    }


def read_roboflow(part: Any) -> Message:
    """Convert the predictions of one image."""
    return Message(
        [
            detection(
                entry["class"],
                entry.get("confidence", 1.0),
                _tracked(entry["class"], entry.get("tracker_id")),
                **image_box(*(entry.get(name) for name in ("x", "y", "width", "height"))),
            )
            for entry in part
        ]
    )


def read_yolo(lines: Lines) -> Message:
    """Convert lines of a YOLO file: class, box, confidence; or class and points of an outline.

    Coordinates are parts of the width and height of the image, so the image counts as a square.
    """
    return Message([_yolo_line(line) for line in lines])


def _yolo_line(line: list[str]) -> dict[str, Any]:
    label, values = line[0], [float(value) for value in line[1:]]
    score = values.pop() if len(values) % 2 else 1.0
    if len(values) == 4:
        return detection(label, score, **image_box(*values))
    return detection(label, score, **box_between(values[::2], values[1::2]))


# --------------------------------------------------------------------------------- label studio


def is_label_studio(data: Any) -> bool:
    """Return whether the data is an export of Label Studio: one task, or a list of tasks."""
    tasks = data if isinstance(data, list) else [data]
    return bool(tasks) and all(map(_is_task, tasks))


def _is_task(data: Any) -> bool:
    if not isinstance(data, dict):
        return False
    is_task = "data" in data and ("annotations" in data or "predictions" in data)
    is_annotation = has_list(data, "result") and "task" in data
    return is_task or is_annotation or any(map(_is_result, _short_results(data)))


def label_studio_parts(data: Any) -> Parts:
    """Return the tasks by their ids."""
    tasks = data if isinstance(data, list) else [data]
    return {str(task.get("id", number)): task for number, task in enumerate(tasks, 1)}


def read_label_studio(task: Any) -> Message:
    """Convert a task: the first annotation that is not cancelled, or else the first prediction."""
    results = task.get("result")
    if results is None:
        choices = [
            *(one for one in task.get("annotations") or () if one.get("was_cancelled") is not True),
            *(task.get("predictions") or ()),
        ]
        results = choices[0]["result"] if choices else _short_results(task)
    return Message(
        [
            detection(_label_of(value)[0], result.get("score", 1.0), **_percent_box(result, value))
            for result in results
            if _label_of(value := result.get("value", result))
        ]
    )


def _short_results(task: Mapping[str, Any]) -> list[Any]:
    """Return the results of a task in the short export, JSON-MIN."""
    return [one for field in task.values() if isinstance(field, list) for one in field]


def _is_result(value: Any) -> bool:
    return isinstance(value, dict) and bool(_label_of(value))


def _label_of(value: Mapping[str, Any]) -> list[Any]:
    """Return the labels of a region, such as those in the field `rectanglelabels`."""
    fields = (labels for name, labels in value.items() if name.endswith("labels"))
    return next((labels for labels in fields if isinstance(labels, list) and labels), [])


def _percent_box(result: Mapping[str, Any], value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the box of a region, whose coordinates are in percent of the image."""
    across, down = (result.get(f"original_{side}", 100) / 100 for side in ("width", "height"))
    if "points" in value:
        xs, ys = zip(*value["points"], strict=True)
        return box_between([x * across for x in xs], [y * down for y in ys])
    if "width" not in value and "radiusX" not in value:  # brush strokes or a key point
        return {}
    x, y = value["x"] * across, value["y"] * down
    theta = math.radians(value.get("rotation") or 0)
    if "radiusX" in value:
        return image_box(x, y, 2 * value["radiusX"] * across, 2 * value["radiusY"] * down, theta)
    width, height = value["width"] * across, value["height"] * down
    # The rotation is about the upper left corner.
    cos, sin = math.cos(theta) / 2, math.sin(theta) / 2
    return image_box(
        x + cos * width - sin * height, y + sin * width + cos * height, width, height, theta
    )


# ---------------------------------------------------------------------------------------- CVAT

_SHAPES: Final = ("box", "polygon", "polyline", "ellipse", "mask", "cuboid")


def is_cvat(data: Any) -> bool:
    """Return whether the data is the XML of an export of CVAT, for images or for videos."""
    return isinstance(data, Element) and data.tag == "annotations"


def cvat_parts(data: Element) -> Parts:
    """Return pairs (id, shape) of each image by its id, or of each frame of a video."""
    parts: Parts = {
        image.get("id", ""): [("", image.get, shape) for shape in image]
        for image in data.iter("image")
    }
    for track in data.iter("track"):
        name = f"{track.get('label')}_{track.get('id')}"
        for shape in track:
            if shape.get("frame") is not None and shape.get("outside") != "1":
                parts.setdefault(shape.get("frame", ""), []).append((name, track.get, shape))
    return parts


def read_cvat(part: Any) -> Message:
    """Convert the shapes of one image. Tags, points and skeletons are not objects with boxes."""
    shapes = [entry for entry in part if entry[2].tag in _SHAPES]
    return Message(
        [
            detection(shape.get("label") or owner("label"), 1.0, name, **_shape_box(shape))
            for name, owner, shape in shapes
        ],
        notes=excluded(len(part) - len(shapes), "tags, points and skeletons"),
    )


def _shape_box(shape: Element) -> dict[str, Any]:
    if shape.tag in ("box", "cuboid"):
        values = {name: float(value) for name, value in shape.items() if name[:3] in _EDGES}
        xs = [value for name, value in values.items() if name.startswith("x")]
        ys = [value for name, value in values.items() if name.startswith("y")]
        return box_between(xs, ys, math.radians(float(shape.get("rotation", "0"))))
    if shape.tag == "mask":
        left, top, width, height = (float(shape.attrib[name]) for name in _MASK)
        return image_box(left + width / 2, top + height / 2, width, height)
    if shape.tag == "ellipse":
        x, y, across, down = (float(shape.attrib[name]) for name in ("cx", "cy", "rx", "ry"))
        theta = math.radians(float(shape.get("rotation", "0")))
        return image_box(x, y, 2 * across, 2 * down, theta)
    points = [point.split(",") for point in shape.attrib["points"].split(";")]
    return box_between([float(point[0]) for point in points], [float(point[1]) for point in points])


_EDGES: Final = ("xtl", "ytl", "xtr", "ytr", "xbl", "ybl", "xbr", "ybr")
_MASK: Final = ("left", "top", "width", "height")
