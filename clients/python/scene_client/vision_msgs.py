"""Convert detections of ROS (vision_msgs) to the fields of a request.

    fields = from_detection3d_array(message, label_map="coco")
    answer = client.missing(**fields, top_k=5)

A message may be JSON (rosbridge, with or without its envelope) or an object (rclpy, bags). It may
have the layout since Galactic (``results[].hypothesis.class_id``, ``id``) or the earlier one
(``results[].id``, ``tracking_id``). Values that a detector does not know or did not fill in are
left out of the request, and `SceneFields.notes` lists them. Values are never guessed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, get_args

from scene_client.image_plane import Box, left_pairs, upright_box
from scene_client.ros_fields import (
    LabelMap,
    MessageError,
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
)
from scene_client.schemas import UnknownLabels

MAX_OBJECTS: Final = 256
MAX_RELATIONS: Final = 4096
"""Limits of the service for one scene, unless its operator chose others."""

_MAX_LABEL, _MAX_ID, _MAX_FRAME = 100, 128, 256
_MAX_METRES, _MAX_EXTENT, _MAX_YAW = 1e8, 1e4, 1e3
# A shorter quaternion is an unset message: its direction would come from rounding.
_MIN_NORM: Final = 1e-6

Reason = Literal[
    "no-hypothesis",  # the detection has no class with a score
    "low-score",  # the score is not above 0, or is under min_score
    "high-score",  # the score is above 1 and counts as 1
    "no-label",  # the class is a number without a label, or not plain text
    "unwanted",  # the label map maps the class to None
    "too-many",  # the request is full; the least confident ones are left out
    "no-position",  # the position is not finite, unset, or in another frame
    "no-box",  # the same for a box in an image: no left and right
    "renamed",  # the id is a duplicate or not plain text
    "no-stamp",  # the stamp is not a valid time
]


class Note(NamedTuple):
    """A detection that was left out or changed, and the reason.

    Attributes:
        detection: position of the detection in the message; None for the whole message.
        reason: a stable code.
        detail: the reason in words.
    """

    detection: int | None
    reason: Reason
    detail: str


class SceneFields(dict[str, Any]):
    """The fields of a request, for `Client.missing(**fields)` or `SceneRequest(**fields)`.

    Attributes:
        notes: omissions and changes, in the order of the message.
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
    unknown_labels: UnknownLabels = "ignore",
) -> SceneFields:
    """Convert objects with poses; the service derives their relations in the axes of ``frame_id``.

    An unset box is replaced by the pose of the best hypothesis. Extents that are not positive are
    unknown. An all-zero quaternion means no rotation. An object without a finite position has no
    position in the request.

    Args:
        message: a vision_msgs/Detection3DArray.
        label_map: labels of the class ids, see `read_label_map`; other text is itself a label.
        min_score: detections with a lower score are left out.
        boxes: False for detectors whose boxes are in pixels, not in space. Positions then come from
            the hypotheses, and extents are unknown.
        viewpoint: position and direction of the robot in the frame of the detections, (x, y, yaw).
            Needed for left and front in map, odom or world. Default: the origin of the frame,
            looking along x.
        unknown_labels: as in a request; detectors often have classes that the model lacks.

    Raises:
        MessageError: no scene can be made of the message, or an argument is wrong.
    """
    reader = _Reader(message, label_map, min_score)
    objects = [reader.object(seen) | reader.pose(seen, boxes) for seen in reader.sightings]
    fields: dict[str, Any] = {"objects": objects}
    if viewpoint is not None:
        fields["viewpoint"] = _viewpoint(viewpoint)
    return reader.finish(fields, unknown_labels)


def from_detection2d_array(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    unknown_labels: UnknownLabels = "ignore",
) -> SceneFields:
    """Convert objects without poses; left follows from neighbours in the image.

    An image shows neither depth nor support: front, on-top and above stay unobserved.

    Args:
        message: a vision_msgs/Detection2DArray.
        label_map, min_score, unknown_labels: as in `from_detection3d_array`.

    Raises:
        MessageError: no scene can be made of the message, or an argument is wrong.
    """
    reader = _Reader(message, label_map, min_score)
    fields = {"objects": [reader.object(seen) for seen in reader.sightings]}
    fields["relations"] = reader.image_relations([entry["id"] for entry in fields["objects"]])
    return reader.finish(fields, unknown_labels)


def from_message(
    message: Any,
    label_map: LabelMap | None = None,
    *,
    min_score: float = 0.0,
    boxes: bool = True,
    viewpoint: Viewpoint | None = None,
    unknown_labels: UnknownLabels = "ignore",
) -> SceneFields:
    """Convert either kind of message; the boxes show which kind it is.

    Raises:
        MessageError: the message is of neither kind, or see `from_detection3d_array`.
    """
    if _is_flat(message):
        return from_detection2d_array(
            message, label_map, min_score=min_score, unknown_labels=unknown_labels
        )
    return from_detection3d_array(
        message,
        label_map,
        min_score=min_score,
        boxes=boxes,
        viewpoint=viewpoint,
        unknown_labels=unknown_labels,
    )


def is_message(value: Any) -> bool:
    """Return whether a value is a message with detections rather than, for example, a request."""
    return take(_unwrapped(value), "detections") is not None


# ------------------------------------------------------------------------------------ reading


@dataclass(slots=True)
class _Sighting:
    """A detection that becomes an object of the request."""

    place: int
    detection: Any
    label: str
    confidence: float
    pose: Any  # pose of the best hypothesis


class _Reader:
    """A reader of one message: it keeps the sightings and the notes."""

    def __init__(self, message: Any, label_map: LabelMap | None, min_score: float) -> None:
        if not is_message(message):
            raise MessageError("this is not a message with detections")
        message = _unwrapped(message)
        self.notes: list[Note] = []
        self.header = take(message, "header")
        self.detections = items(take(message, "detections"), "detections")
        self.labels = read_label_map(label_map)
        if number(min_score) is None:
            raise MessageError("min_score must be a finite number")
        sightings = [
            seen
            for place, detection in enumerate(self.detections)
            if (seen := self._sight(place, detection, min_score)) is not None
        ]
        if not sightings and label_map is None and self._only_numbers():
            raise MessageError(
                "the class ids are numbers: give their labels with label_map (a mapping, a list "
                "of labels in their order, a vision_msgs/LabelInfo, or 'coco')"
            )
        self.sightings = self._surest(sightings)
        self.ids = self._ids()
        self.frame = self._frame()

    def note(self, place: int | None, reason: Reason, detail: str) -> None:
        self.notes.append(Note(place, reason, detail))

    def _sight(self, place: int, detection: Any, min_score: float) -> _Sighting | None:
        best, class_id, score = None, "", -math.inf
        for result in items(take(detection, "results"), "results"):
            hypothesis = take(result, "hypothesis") or result
            rated = number(take(hypothesis, "score"))
            if rated is not None and rated > score:
                best, score = result, rated
                class_id = text(take(hypothesis, "class_id")) or text(take(hypothesis, "id"))
        if best is None:
            self.note(place, "no-hypothesis", "no hypothesis has a score")
            return None
        if not score > 0 or score < min_score:
            self.note(place, "low-score", f"its score is {score:g}")
            return None
        label = self.labels.get(class_id, class_id)
        if label is None:
            self.note(place, "unwanted", f"class {class_id!r} is not wanted")
            return None
        if _is_number(label) or not is_plain(label.strip(), _MAX_LABEL):
            self.note(place, "no-label", f"class {class_id[:_MAX_LABEL]!r} has no label")
            return None
        if score > 1:
            self.note(place, "high-score", f"its score is {score:g}; it counts as 1")
        pose = take(best, "pose")
        return _Sighting(
            place, detection, label.strip(), min(score, 1.0), take(pose, "pose") or pose
        )

    def _only_numbers(self) -> bool:
        return any(note.reason == "no-label" for note in self.notes) and all(
            _is_number(text(take(result, "hypothesis", "class_id")) or text(take(result, "id")))
            for detection in self.detections
            for result in items(take(detection, "results"), "results")
        )

    def _surest(self, sightings: list[_Sighting]) -> list[_Sighting]:
        """Return the most confident sightings that fit a request, in the order of the message."""
        if len(sightings) <= MAX_OBJECTS:
            return sightings
        ranked = sorted(sightings, key=lambda seen: -seen.confidence)
        for seen in ranked[MAX_OBJECTS:]:
            self.note(seen.place, "too-many", f"{MAX_OBJECTS} others have scores at least as high")
        return sorted(ranked[:MAX_OBJECTS], key=lambda seen: seen.place)

    def _ids(self) -> dict[int, str]:
        """Return ids by place: the detector's own id if it is unique, else the numbered label."""
        own: dict[str, int] = {}
        ids: dict[int, str] = {}
        for seen in self.sightings:
            name = text(take(seen.detection, "id")) or text(take(seen.detection, "tracking_id"))
            if not name:
                continue
            if not is_plain(name, _MAX_ID):
                self.note(seen.place, "renamed", "its id is not plain text")
            elif name in own:
                self.note(seen.place, "renamed", f"detection {own[name]} has the same id")
            else:
                own[name] = seen.place
                ids[seen.place] = name
        last: dict[str, int] = {}
        for seen in self.sightings:
            if seen.place in ids:
                continue
            while True:
                last[seen.label] = last.get(seen.label, 0) + 1
                name = f"{seen.label}_{last[seen.label]}"
                if name not in own:
                    break
            ids[seen.place] = name
        return ids

    def _frame(self) -> str | None:
        """Return the frame of the message, or of the first detection with a frame."""
        for header in (self.header, *(take(seen.detection, "header") for seen in self.sightings)):
            if frame := frame_of(header):
                if not is_plain(frame, _MAX_FRAME):
                    raise MessageError("frame_id is not plain text")
                return frame
        return None

    def _is_elsewhere(self, seen: _Sighting) -> bool:
        return frame_of(take(seen.detection, "header")) not in ("", self.frame)

    def object(self, seen: _Sighting) -> dict[str, Any]:
        return {
            "id": self.ids[seen.place],
            "label": seen.label,
            "confidence": seen.confidence,
        }

    def pose(self, seen: _Sighting, boxes: bool) -> dict[str, Any]:
        """Return the known parts of position, size and orientation."""
        if self._is_elsewhere(seen):
            self.note(seen.place, "no-position", "its frame differs from that of the message")
            return {}
        box = take(seen.detection, "bbox") if boxes else None
        pose, size = take(box, "center"), numbers(take(box, "size"), "xyz")
        sized = size is not None and all(0 < side <= _MAX_EXTENT for side in size)
        if not sized and _is_unset(pose):
            pose = seen.pose
            if _is_unset(pose):
                self.note(seen.place, "no-position", "its box and its pose are unset")
                return {}
        position = numbers(take(pose, "position"), "xyz")
        if position is None or any(abs(value) > _MAX_METRES for value in position):
            self.note(seen.place, "no-position", "its position is not finite")
            return {}
        found: dict[str, Any] = {"position": dict(zip("xyz", position, strict=True))}
        if size is not None and sized:
            found["size"] = dict(zip("xyz", size, strict=True))
        turn = numbers(take(pose, "orientation"), "xyzw")
        length = math.hypot(*turn) if turn else 0.0
        if turn and _MIN_NORM < length < math.inf:
            found["orientation"] = {
                axis: value / length for axis, value in zip("xyzw", turn, strict=True)
            }
        return found

    def image_relations(self, ids: list[str]) -> list[dict[str, str]]:
        """Return left and right between neighbours in the image."""
        boxes = [self._image_box(seen) for seen in self.sightings]
        # If a request cannot hold all relations, those of the most confident objects are kept.
        order = sorted(range(len(ids)), key=lambda i: -self.sightings[i].confidence)
        found = left_pairs(boxes, order)
        if len(found) > MAX_RELATIONS:
            self.note(None, "too-many", f"{len(found) - MAX_RELATIONS} relations were left out")
        return [
            {"subject": ids[i], "relation": "left", "object": ids[j]}
            for i, j in sorted(found[:MAX_RELATIONS])
        ]

    def _image_box(self, seen: _Sighting) -> Box | None:
        """Return the upright box around a box that may be rotated."""
        if self._is_elsewhere(seen):
            self.note(seen.place, "no-box", "its frame differs from that of the message")
            return None
        box = take(seen.detection, "bbox")
        centre = take(box, "center")
        middle = numbers(take(centre, "position") or centre, "xy")
        theta = number(take(centre, "theta"))
        width, height = number(take(box, "size_x")), number(take(box, "size_y"))
        if middle is None or not (width is not None and height is not None):
            self.note(seen.place, "no-box", "its box is not finite")
            return None
        if not (width > 0 and height > 0):
            self.note(seen.place, "no-box", "its box has no extent")
            return None
        return upright_box((middle[0], middle[1]), (width, height), theta or 0.0)

    def finish(self, fields: dict[str, Any], unknown_labels: str) -> SceneFields:
        """Add frame and time of the header."""
        if unknown_labels not in get_args(UnknownLabels):
            raise MessageError("unknown_labels must be 'error', 'ignore' or 'nearest'")
        fields["unknown_labels"] = unknown_labels
        if self.frame is not None:
            fields["frame_id"] = self.frame
        stamp = take(self.header, "stamp")
        if (time := time_of(stamp)) is not None:
            fields["stamp"] = time
        elif stamp is not None:
            self.note(None, "no-stamp", "its stamp is not a valid time")
        order = sorted(
            self.notes, key=lambda note: -1 if note.detection is None else note.detection
        )
        return SceneFields(fields, tuple(order))


def _unwrapped(message: Any) -> Any:
    """Return the message in rosbridge's envelope, or the message itself."""
    if isinstance(message, Mapping) and "detections" not in message:
        return message.get("msg", message)
    return message


def _is_flat(message: Any) -> bool:
    """Return whether the boxes are boxes in an image."""
    detections = take(_unwrapped(message), "detections")
    return any(
        has(take(detection, "bbox"), "size_x") for detection in items(detections, "detections")
    )


def _is_number(label: str) -> bool:
    return label.removeprefix("-").isdecimal()


def _is_unset(pose: Any) -> bool:
    """Return whether a pose is missing or unset."""
    position = take(pose, "position")
    return position is None or numbers(position, "xyz") == (0.0, 0.0, 0.0)


def _viewpoint(viewpoint: Viewpoint) -> dict[str, float]:
    given: Any = viewpoint
    if isinstance(given, list | tuple):
        given = dict(zip(("x", "y", "yaw"), given, strict=False)) if len(given) == 3 else None
    x, y, yaw = (number(take(given, name)) for name in ("x", "y", "yaw"))
    if x is None or y is None or yaw is None:
        raise MessageError("viewpoint must be three finite numbers: x, y, yaw")
    if max(abs(x), abs(y)) > _MAX_METRES or abs(yaw) > _MAX_YAW:
        raise MessageError("viewpoint is out of range")
    return {"x": x, "y": y, "yaw": yaw}
