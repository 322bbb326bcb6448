"""Reading of the files that the command ``scene`` accepts in place of labels."""

from __future__ import annotations

import json
import os
import re
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from scene_client.ros_fields import WELL_KNOWN, MessageError, read_label_map
from scene_client.vision_msgs import from_message, is_message

MAX_FILE: Final = 64 * 2**20
"""Maximum size of a scene file in bytes. The service has the same upper limit for a body."""

# A file with one scene per line, and the number of a line.
_LINES: Final = re.compile(r"(?P<file>.+\.jsonl)(:(?P<line>[0-9]{1,9}))?$")

# Fields that objects of training scenes and of requests have in common.
_COPIED: Final = ("label", "position", "size", "yaw")

LabelMap = Mapping[str, str | None]


def is_file(thing: str) -> bool:
    """Return whether an argument is a file. Labels do not end in .json or contain a slash."""
    return thing == "-" or thing.endswith(".json") or bool(_LINES.match(thing)) or os.sep in thing


def label_map_of(option: str) -> LabelMap:
    """Return the labels of the class ids that the option `--label-map` names.

    Raises:
        MessageError: the file cannot be read or does not contain labels.
    """
    if option in WELL_KNOWN:
        return read_label_map(option)
    text = _bytes(option)
    try:
        try:
            names: Any = json.loads(text.decode())
        except json.JSONDecodeError:
            names = text.decode().splitlines()
        names = names.get("categories", names) if isinstance(names, dict) else names
        if isinstance(names, list) and isinstance(names[0], dict):
            names = {entry["id"]: entry["name"] for entry in names}
        return read_label_map(names)
    except (LookupError, TypeError, ValueError):
        raise MessageError(f"--label-map: {option} does not contain labels") from None


def read_scene(argument: str, labels: LabelMap) -> dict[str, Any]:
    """Return the fields of the request in a file. Print the notes about a ROS message.

    Args:
        argument: name of a file with a request, a list of objects, a ROS message, results of COCO
            or a scene of the training format; ``NAME.jsonl:LINE``; or ``-`` for standard input.
        labels: labels of the class ids in a ROS message.

    Raises:
        MessageError: the file cannot be read or does not contain a scene.
    """
    lines = _LINES.match(argument)
    name = lines["file"] if lines else argument
    text = _bytes(name)
    try:
        scene = json.loads(_line(name, text, lines["line"]) if lines else text)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"{argument} is not JSON: {error}") from None
    if is_message(scene):
        return _of_message(name, scene, labels)
    if isinstance(scene, list):
        return {"objects": _of_coco(name, scene)}
    if not isinstance(scene, dict):
        raise MessageError(f"{name} must contain a request or a list of objects")
    if "scene_id" not in scene:
        return scene
    try:
        return _of_training(scene)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise MessageError(f"{argument} is not a scene of the training format") from None


def with_labels(scene: dict[str, Any], labels: LabelMap) -> dict[str, Any]:
    """Replace the labels of objects that are class ids.

    Raises:
        MessageError: a class id has no label.
    """
    if not isinstance(scene.get("objects"), list):
        return scene
    objects = []
    for thing in scene["objects"]:
        label = thing.get("label") if isinstance(thing, dict) else thing
        if str(label).isdecimal():
            label = labels.get(str(label))
            if label is None:
                remedy = "set --label-map to coco80, coco91 or a file with the labels of the ids"
                raise MessageError(f"an object has a class id instead of a label: {remedy}")
            thing = {**thing, "label": label} if isinstance(thing, dict) else label
        objects.append(thing)
    return scene | {"objects": objects}


def _bytes(name: str) -> bytes:
    """Return the contents of a file, or of standard input for the name ``-``."""
    try:
        if name == "-":
            text = sys.stdin.buffer.read(MAX_FILE + 1)
        else:
            with Path(name).open("rb") as file:
                text = file.read(MAX_FILE + 1)
    except OSError as error:
        raise MessageError(f"cannot read {name}: {error.strerror}") from None
    if len(text) > MAX_FILE:
        raise MessageError(f"{name} is too large: it has more than {MAX_FILE} bytes")
    return text


def _line(name: str, text: bytes, line: str | None) -> bytes:
    """Return one line of a file with one scene per line."""
    lines = text.splitlines()
    if line is None and len(lines) != 1:
        raise MessageError(f"{name} has {len(lines)} lines: choose one, such as {name}:1")
    number = int(line or 1)
    if not 1 <= number <= len(lines):
        raise MessageError(f"{name} has {len(lines)} lines; it has no line {number}")
    return lines[number - 1]


def _of_message(name: str, message: Any, labels: LabelMap) -> dict[str, Any]:
    """Return the request fields for a ROS message with detections, as JSON from rosbridge."""
    try:
        fields = from_message(message, labels or None)
    except MessageError as error:
        raise MessageError(f"{name}: {error}") from None
    for note in fields.notes:
        which = "" if note.detection is None else f"detection {note.detection}: "
        print(f"{name}: {which}{note.detail}", file=sys.stderr)
    return fields


def _of_coco(name: str, entries: list[Any]) -> list[Any]:
    """Return the objects of a list, which may be a file of COCO's results for one image."""
    if not all(isinstance(entry, dict) and "category_id" in entry for entry in entries):
        return entries
    if len({str(entry.get("image_id")) for entry in entries}) > 1:
        raise MessageError(f"{name} has several images: keep the results of one image_id")
    return [
        {"label": entry["category_id"], "confidence": entry.get("score", 1.0)} for entry in entries
    ]


def _of_training(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return the request fields for a scene of the training format.

    The service accepts this format too, but its answers would name an object by its number. Here,
    the id of an object is its label, followed by its number if several objects have the label.
    """
    objects = scene["objects"]
    counts = Counter(thing["label"] for thing in objects)
    ids = {
        thing["id"]: thing["label"] + (f"_{thing['id']}" if counts[thing["label"]] > 1 else "")
        for thing in objects
    }
    if len(set(ids.values())) < len(objects):
        raise ValueError("two objects have the same id")
    detections = [
        {name: thing[name] for name in _COPIED if thing.get(name) is not None}
        | {name: ids[thing[name]] for name in ("id", "supported_by") if thing.get(name) is not None}
        for thing in objects
    ]
    fields: dict[str, Any] = {"objects": detections}
    if any("position" not in detection for detection in detections) and scene.get("relations"):
        fields["relations"] = [
            [ids[subject], relation, ids[other]] for subject, relation, other in scene["relations"]
        ]
    if not scene.get("viewer_frame"):
        fields["frame_id"] = "map"
    if scene.get("room_type") is not None:
        fields["room_type"] = scene["room_type"]
    return fields
