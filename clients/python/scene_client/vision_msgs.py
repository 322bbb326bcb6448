"""Conversion of ROS detections (vision_msgs) to the fields of a request.

    fields = from_detection3d_array(message, label_map="coco")
    answer = client.missing(**fields, top_k=5)

A message may be JSON (from rosbridge, with or without its envelope) or a Python object (from rclpy
or bags). The message may have the layout of ROS Galactic and later (fields
``results[].hypothesis.class_id`` and ``id``) or the earlier layout (``results[].id`` and
``tracking_id``). The request does not contain unknown and unset values of the message, and
`SceneFields.notes` lists these values. The module never guesses a value.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, get_args

from scene_client.image_plane import Box, left_pairs, upright_box
from scene_client.ros_fields import (
    REMEDY,
    LabelMap,
    MessageError,
    as_vision_msgs,
    frame_of,
    has,
    is_plain,
    items,
    number,
    numbers,
    read_label_map,
    take,
    text,
    time_of,
    unwrapped,
)
from scene_client.schemas import UnknownLabels

MAX_OBJECTS: Final = 256
MAX_RELATIONS: Final = 4096
"""Default limits of the service for one scene."""

_MAX_LABEL, _MAX_ID, _MAX_FRAME = 100, 128, 256
_MAX_METRES, _MAX_EXTENT, _MAX_YAW = 1e8, 1e7, 1e3
# A quaternion shorter than this length counts as unset.
_MIN_NORM: Final = 1e-6

Reason = Literal[
    "no-hypothesis",  # the detection has no class with a score
    "low-score",  # the score is 0, negative or below min_score
    "high-score",  # the score is above 1 and counts as 1
    "no-label",  # the class id is a number without a label, or is not plain text
    "unwanted",  # the label map maps the class to None
    "too-many",  # the message has too many detections or relations for a request
    "no-position",  # the position is unset, not finite, or in another frame
    "no-box",  # the box in the image is empty, not finite, or in another frame
    "renamed",  # the id is a duplicate, or is not plain text
    "no-stamp",  # the stamp is not a valid time
    "excluded",  # the file marks entries as invisible, removed, or a crowd
]


class Note(NamedTuple):
    """A note that the conversion omitted or changed a value of the message, with the reason.

    Attributes:
        detection: index of the detection in the message. None if the note concerns the whole
            message.
        reason: stable code of the reason.
        detail: the reason in words.
    """

    detection: int | None
    reason: Reason
    detail: str


class SceneFields(dict[str, Any]):
    """The fields of a request, for `Client.missing(**fields)` or `SceneRequest(**fields)`.

    Attributes:
        notes: notes on omitted and changed values. The notes have the order of the detections.
    """

    def __init__(self, fields: Mapping[str, Any], notes: tuple[Note, ...] = ()) -> None:
        super().__init__(fields)
        self.notes = notes


Viewpoint = tuple[float, float, float] | Mapping[str, float]


def from_detection3d_array(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    boxes: bool = True,
    viewpoint: Viewpoint | None = None,
    unknown_labels: UnknownLabels = "nearest-or-ignore",
) -> SceneFields:
    """Convert objects with poses. The service derives their relations in the axes of ``frame_id``.

    If the box of a detection is unset, the pose of the best hypothesis replaces the box. Extents
    count as unknown if one is negative or not finite, or if all are 0. An all-zero quaternion means
    no rotation. An object without a finite position has no position in the request.

    Args:
        message: a vision_msgs/Detection3DArray.
        label_map: labels of the class ids (see `read_label_map`). A class id that the label map
            does not contain is itself the label.
        min_score: minimum score of the detections in the request.
        boxes: whether the boxes are in metres. False means that the boxes are in pixels. Positions
            then come from the hypotheses, and extents are unknown.
        viewpoint: position and viewing direction (x, y, yaw) of the robot in the frame of the
            detections. In a map, odom or world frame, the relations left and front need the
            viewpoint. By default, the robot is at the origin of the frame and looks along x.
        unknown_labels: field of the request. With the default, the service leaves out classes
            that the model lacks.

    Raises:
        MessageError: the message does not contain a valid scene, or an argument is invalid.
    """
    reader = _Reader(message, label_map, min_score)
    objects = [reader.object(entry) | reader.pose(entry, boxes) for entry in reader.sightings]
    fields: dict[str, Any] = {"objects": objects}
    if viewpoint is not None:
        fields["viewpoint"] = _viewpoint(viewpoint)
    return reader.finish(fields, unknown_labels)


def from_detection2d_array(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    unknown_labels: UnknownLabels = "nearest-or-ignore",
) -> SceneFields:
    """Convert objects without poses. The relation left comes from neighbouring boxes in the image.

    An image does not show depth or support, so the relations front, on-top, above and inside stay
    unobserved. ``message`` is a vision_msgs/Detection2DArray. `from_detection3d_array` describes
    the other arguments and the errors.
    """
    reader = _Reader(message, label_map, min_score)
    fields = {"objects": [reader.object(sighting) for sighting in reader.sightings]}
    fields["relations"] = reader.image_relations([entry["id"] for entry in fields["objects"]])
    return reader.finish(fields, unknown_labels)


def from_message(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    boxes: bool = True,
    viewpoint: Viewpoint | None = None,
    unknown_labels: UnknownLabels = "nearest-or-ignore",
) -> SceneFields:
    """Convert a Detection3DArray, a Detection2DArray, or a DetectionArray of yolo_ros.

    The fields of the message show its type. `from_detection3d_array` describes the arguments and
    the errors.
    """
    message = as_vision_msgs(unwrapped(message))
    options: Any = {"min_score": min_score, "unknown_labels": unknown_labels}
    if _is_flat(message):
        return from_detection2d_array(message, label_map, **options)
    return from_detection3d_array(message, label_map, boxes=boxes, viewpoint=viewpoint, **options)


def is_message(value: Any) -> bool:
    """Return whether a value is a ROS message with detections."""
    return take(unwrapped(value), "detections") is not None


# ------------------------------------------------------------------------------------ reading


@dataclass(slots=True)
class _Sighting:
    index: int
    detection: Any
    label: str
    confidence: float
    pose: Any  # pose of the best hypothesis


class _Reader:
    def __init__(self, message: Any, label_map: LabelMap | None, min_score: float) -> None:
        if not is_message(message):
            raise MessageError("the message must have a list of detections")
        message = unwrapped(message)
        self.notes: list[Note] = []
        self.header = take(message, "header")
        self.detections = items(take(message, "detections"), "detections")
        self.labels = read_label_map(label_map)
        if number(min_score) is None:
            raise MessageError("min_score must be a finite number")
        sightings = [
            sighting
            for index, detection in enumerate(self.detections)
            if (sighting := self._sight(index, detection, min_score)) is not None
        ]
        if not sightings and label_map is None and self._only_numbers():
            raise MessageError(f"the class ids are numbers: {REMEDY}")
        self.sightings = self._most_confident(sightings)
        self.ids = self._ids()
        self.frame = self._frame()

    def note(self, index: int | None, reason: Reason, detail: str) -> None:
        self.notes.append(Note(index, reason, detail))

    def _sight(self, index: int, detection: Any, min_score: float) -> _Sighting | None:
        """Return the sighting by the best hypothesis. On failure, add a note and return None."""
        best_result, class_id, score = None, "", -math.inf
        for result in items(take(detection, "results"), "results"):
            hypothesis = take(result, "hypothesis") or result
            result_score = number(take(hypothesis, "score"))
            if result_score is not None and result_score > score:
                best_result, score = result, result_score
                class_id = _class_id(hypothesis)
        if best_result is None:
            self.note(index, "no-hypothesis", "the detection has no hypothesis with a score")
            return None
        if not score > 0 or score < min_score:
            self.note(
                index, "low-score", f"the score {score:g} is not positive or is below min_score"
            )
            return None
        label = self.labels.get(class_id, class_id)
        if label is None:
            self.note(index, "unwanted", f"the label map excludes class {class_id!r}")
            return None
        if _is_number(label) or not is_plain(label.strip(), _MAX_LABEL):
            self.note(index, "no-label", f"class {class_id[:_MAX_LABEL]!r} has no label")
            return None
        if score > 1:
            self.note(index, "high-score", f"the score {score:g} is above 1 and counts as 1")
        pose = take(best_result, "pose")
        return _Sighting(
            index, detection, label.strip(), min(score, 1.0), take(pose, "pose") or pose
        )

    def _only_numbers(self) -> bool:
        """Return whether all class ids are numbers and at least one has no label."""
        return any(note.reason == "no-label" for note in self.notes) and all(
            _is_number(_class_id(take(result, "hypothesis") or result))
            for detection in self.detections
            for result in items(take(detection, "results"), "results")
        )

    def _most_confident(self, sightings: list[_Sighting]) -> list[_Sighting]:
        """Return at most `MAX_OBJECTS` sightings, those of highest confidence, in message order."""
        if len(sightings) <= MAX_OBJECTS:
            return sightings
        ranked = sorted(sightings, key=lambda sighting: -sighting.confidence)
        detail = f"{MAX_OBJECTS} other detections have equal or higher scores"
        for sighting in ranked[MAX_OBJECTS:]:
            self.note(sighting.index, "too-many", detail)
        return sorted(ranked[:MAX_OBJECTS], key=lambda sighting: sighting.index)

    def _ids(self) -> dict[int, str]:
        """Return the id of each detection: that of the detector, or its label and a number."""
        index_of_id: dict[str, int] = {}
        for sighting in self.sightings:
            detection = sighting.detection
            name = text(take(detection, "id")) or text(take(detection, "tracking_id"))
            if name and not is_plain(name, _MAX_ID):
                self.note(sighting.index, "renamed", "the id is not plain text")
            elif name in index_of_id:
                detail = f"detection {index_of_id[name]} has the same id"
                self.note(sighting.index, "renamed", detail)
            elif name:
                index_of_id[name] = sighting.index
        ids = {index: name for name, index in index_of_id.items()}
        last_number: Counter[str] = Counter()
        for sighting in self.sightings:
            while sighting.index not in ids:
                last_number[sighting.label] += 1
                name = f"{sighting.label}_{last_number[sighting.label]}"
                if name not in index_of_id:
                    ids[sighting.index] = name
        return ids

    def _frame(self) -> str | None:
        headers = [take(sighting.detection, "header") for sighting in self.sightings]
        for header in (self.header, *headers):
            if frame := frame_of(header):
                if not is_plain(frame, _MAX_FRAME):
                    raise MessageError("frame_id is not plain text")
                return frame
        return None

    def _has_other_frame(self, sighting: _Sighting) -> bool:
        return frame_of(take(sighting.detection, "header")) not in ("", self.frame)

    def object(self, sighting: _Sighting) -> dict[str, Any]:
        return {
            "id": self.ids[sighting.index],
            "label": sighting.label,
            "confidence": sighting.confidence,
        }

    def pose(self, sighting: _Sighting, boxes: bool) -> dict[str, Any]:
        """Return the fields position, size and orientation of a detection, as far as known."""
        if self._has_other_frame(sighting):
            detail = "the detection has another frame than the message"
            self.note(sighting.index, "no-position", detail)
            return {}
        box = take(sighting.detection, "bbox") if boxes else None
        pose, size = take(box, "center"), numbers(take(box, "size"), "xyz")
        if size and not (any(size.values()) and all(0 <= s <= _MAX_EXTENT for s in size.values())):
            size = None
        if size is None and _is_unset(pose):
            pose = sighting.pose
            if _is_unset(pose):
                # Files with labels alone have neither field.
                if box is not None or pose is not None:
                    self.note(sighting.index, "no-position", "the box and the pose are unset")
                return {}
        position = numbers(take(pose, "position"), "xyz")
        if position is None or any(abs(value) > _MAX_METRES for value in position.values()):
            self.note(sighting.index, "no-position", "the position is not finite or out of range")
            return {}
        fields = {"position": position} | ({"size": size} if size else {})
        if (yaw := number(take(pose, "yaw"))) is not None:  # of a file, not of a message
            return fields | {"yaw": math.remainder(yaw, math.tau)}
        turn = numbers(take(pose, "orientation"), "xyzw") or {}
        length = math.hypot(*turn.values())
        if _MIN_NORM < length < math.inf:
            fields["orientation"] = {axis: value / length for axis, value in turn.items()}
        return fields

    def image_relations(self, ids: list[str]) -> list[dict[str, str]]:
        """Return the relations left between neighbouring boxes in the image."""
        boxes = [self._image_box(sighting) for sighting in self.sightings]
        # If there are too many relations, the request contains those of the most confident objects.
        order = sorted(range(len(ids)), key=lambda i: -self.sightings[i].confidence)
        pairs = left_pairs(boxes, order)
        if (extra := len(pairs) - MAX_RELATIONS) > 0:
            self.note(None, "too-many", f"the request leaves out {extra} relations")
        return [
            {"subject": ids[i], "relation": "left", "object": ids[j]}
            for i, j in sorted(pairs[:MAX_RELATIONS])
        ]

    def _image_box(self, sighting: _Sighting) -> Box | None:
        """Return the smallest upright box around the box of a detection, which may be rotated."""
        if self._has_other_frame(sighting):
            self.note(sighting.index, "no-box", "the detection has another frame than the message")
            return None
        box = take(sighting.detection, "bbox")
        centre = take(box, "center")
        middle = numbers(take(centre, "position") or centre, "xy")
        theta = number(take(centre, "theta"))
        width, height = number(take(box, "size_x")), number(take(box, "size_y"))
        if middle is None or not (width is not None and height is not None):
            self.note(sighting.index, "no-box", "the box is not finite")
            return None
        if not (width > 0 and height > 0):
            self.note(sighting.index, "no-box", "the box must have a positive width and height")
            return None
        return upright_box((middle["x"], middle["y"]), (width, height), theta or 0.0)

    def finish(self, fields: dict[str, Any], unknown_labels: str) -> SceneFields:
        """Add the frame and the time of the message to the fields. Return them with the notes."""
        if unknown_labels not in get_args(UnknownLabels):
            choices = ", ".join(map(repr, get_args(UnknownLabels)))
            raise MessageError(f"unknown_labels must be one of {choices}")
        fields["unknown_labels"] = unknown_labels
        if self.frame is not None:
            fields["frame_id"] = self.frame
        stamp = take(self.header, "stamp")
        if (time := time_of(stamp)) is not None:
            fields["stamp"] = time
        elif stamp is not None:
            self.note(None, "no-stamp", "the stamp of the message is not a valid time")
        self.notes.sort(key=lambda note: -1 if note.detection is None else note.detection)
        return SceneFields(fields, tuple(self.notes))


def _is_flat(message: Any) -> bool:
    detections = take(unwrapped(message), "detections")
    return any(has(take(entry, "bbox"), "size_x") for entry in items(detections, "detections"))


def _class_id(hypothesis: Any) -> str:
    return text(take(hypothesis, "class_id")) or text(take(hypothesis, "id"))


def _is_number(label: str) -> bool:
    return label.removeprefix("-").isdecimal()


def _is_unset(pose: Any) -> bool:
    position = take(pose, "position")
    return position is None or numbers(position, "xyz") == {"x": 0.0, "y": 0.0, "z": 0.0}


def _viewpoint(viewpoint: Viewpoint) -> dict[str, float]:
    values: Any = viewpoint
    if not isinstance(values, list | tuple):
        values = [take(values, name) for name in ("x", "y", "yaw")]
    x, y, yaw = map(number, values) if len(values) == 3 else (None,) * 3
    if x is None or y is None or yaw is None:
        raise MessageError("viewpoint must be three finite numbers: x, y, yaw")
    if max(abs(x), abs(y)) > _MAX_METRES or abs(yaw) > _MAX_YAW:
        raise MessageError(
            f"viewpoint is out of range: x and y must be within ±{_MAX_METRES:g} m, and yaw within "
            f"±{_MAX_YAW:g} radians"
        )
    return {"x": x, "y": y, "yaw": yaw}
