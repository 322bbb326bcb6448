"""Conversion of what a detector has seen to the fields of a request.

All readers of messages and files return `Sighting`s, so labels, ids and boxes have one conversion.
The request does not contain unknown and unset values, and `SceneFields.notes` lists these values.
The module never guesses a value.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple, get_args

from scene_client.image_plane import Box, left_pairs
from scene_client.ros_fields import REMEDY, MessageError, is_plain, number, take, text, time_of
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
    "percent",  # the scores are in percent
    "no-label",  # the class id is a number without a label, or is not plain text
    "unwanted",  # the label map maps the class to None
    "too-many",  # the message has too many detections or relations for a request
    "no-position",  # the position is unset, not finite, or in another frame
    "no-box",  # the box in the image is empty, not finite, or in another frame
    "degrees",  # the rotations are in degrees
    "renamed",  # the id is a duplicate, or is not plain text
    "no-stamp",  # the stamp is not a valid time
    "excluded",  # the file marks entries as invisible, removed, or a crowd
    "unread",  # fields with a box, a score, a frame or a time are not read
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


class Solid(NamedTuple):
    """A box with a position: lists of numbers, which may be NaN. An unknown part is None."""

    position: Sequence[float]
    size: Sequence[float] | None = None
    turn: Sequence[float] | None = None
    yaw: float | None = None

    @property
    def is_unset(self) -> bool:
        """Whether the box is at the origin and has no size, as in an empty message."""
        return not (any(self.position) or self.sides)

    @property
    def sides(self) -> Sequence[float] | None:
        """The size, or None if one side is negative or not finite, or all are 0."""
        size = self.size or (-1.0,)
        return size if any(size) and all(0 <= side <= _MAX_EXTENT for side in size) else None


@dataclass(slots=True)
class Sighting:
    """What a detector has seen: the label or class id, the score, and boxes.

    Attributes:
        name: id of the object, or "".
        is_numbered: whether the name is a number that follows the label, as in chair_3.
        frame: frame of the box, or "" for the frame of the message.
        solid: box with a position, or None.
        image: box in the image, which may have NaN, or None.
        is_unset: whether the message has a box or pose without a value.
    """

    label: Any
    score: Any = 1.0
    name: str = ""
    frame: str = ""
    solid: Solid | None = None
    image: Box | None = None
    is_unset: bool = False
    is_numbered: bool = False
    index: int = 0
    confidence: float = 0.0


@dataclass
class Seen:
    """The sightings of one scene.

    Attributes:
        frame: name of the frame, or "".
        stamp: time of the scene as in a message, or None.
        viewpoint: pose of the viewer, or None if unknown.
        is_solid: whether the boxes have positions, or lie in an image. None: as the boxes show.
        notes: notes on what the scene does not contain.
        left_out: number of further sightings, which have lower scores.
    """

    sightings: list[Sighting]
    frame: str = ""
    stamp: Any = None
    viewpoint: Viewpoint | None = None
    is_solid: bool | None = None
    notes: list[Note] = field(default_factory=list)
    left_out: int = 0


Viewpoint = tuple[float, float, float] | Mapping[str, float]


def to_fields(
    seen: Seen,
    labels: Mapping[str, str | None],
    *,
    min_score: float = 0.0,
    unknown_labels: str = "nearest-or-ignore",
) -> SceneFields:
    """Convert sightings to the fields of a request.

    Args:
        seen: the sightings of a scene.
        labels: label of each class id, or None for classes that are no objects of the scene.
        min_score: minimum score of the objects in the request.
        unknown_labels: field of the request.

    Raises:
        MessageError: all class ids are numbers without a label, the name of the frame is not plain
            text, or an argument is invalid.
    """
    if number(min_score) is None:
        raise MessageError("min_score must be a finite number")
    if unknown_labels not in get_args(UnknownLabels):
        raise MessageError(f"unknown_labels must be one of {', '.join(get_args(UnknownLabels))}")
    converter = _Converter(seen, labels, min_score)
    fields: dict[str, Any] = {"objects": converter.objects()}
    if converter.is_flat and not converter.is_solid:
        fields["relations"] = converter.image_relations(fields["objects"])
    if seen.viewpoint is not None:
        fields["viewpoint"] = _viewpoint(seen.viewpoint)
    fields["unknown_labels"] = unknown_labels
    if converter.frame:
        fields["frame_id"] = converter.frame
    if (time := time_of(seen.stamp)) is not None:
        fields["stamp"] = time
    elif seen.stamp is not None:
        converter.note(None, "no-stamp", "the stamp of the message is not a valid time")
    notes = sorted(converter.notes, key=lambda note: -1 if note[0] is None else note[0])
    return SceneFields(fields, tuple(notes))


class _Converter:
    def __init__(self, seen: Seen, labels: Mapping[str, str | None], min_score: float) -> None:
        self.notes, self.labels, self.min_score = [*seen.notes], labels, min_score
        self.left_out = seen.left_out
        every = seen.sightings
        for index, sighting in enumerate(every):
            sighting.index = index
        kept = [sighting for sighting in every if self._is_labelled(sighting)]
        numbers = [is_number(text(sighting.label)) for sighting in every if sighting.score]
        has_ids = any(note.reason == "no-label" for note in self.notes)
        if has_ids and all(numbers) and not (kept or labels):
            raise MessageError(f"the class ids are numbers: {REMEDY}")
        self.has_poses = any(one.solid is not None for one in every)
        self.is_solid, self.is_flat = self.has_poses, any(one.image is not None for one in every)
        if seen.is_solid is not None:
            self.is_solid, self.is_flat = seen.is_solid, not seen.is_solid
        self.sightings = self._most_confident(kept)
        self.frame = seen.frame or next((one.frame for one in self.sightings if one.frame), "")
        if self.frame and not is_plain(self.frame, _MAX_FRAME):
            raise MessageError("frame_id is not plain text")

    def note(self, index: int | None, reason: Reason, detail: str) -> None:
        self.notes.append(Note(index, reason, detail))

    def _is_labelled(self, sighting: Sighting) -> bool:
        """Return whether a sighting has a label and a score. Without them, add a note."""
        index, score, class_id = sighting.index, number(sighting.score), text(sighting.label)
        if score is None:
            self.note(index, "no-hypothesis", "the detection has no hypothesis with a score")
            return False
        if not score > 0 or score < self.min_score:
            detail = f"the score {score:g} is not positive or is below min_score"
            self.note(index, "low-score", detail)
            return False
        label = self.labels.get(class_id, class_id)
        if label is None:
            self.note(index, "unwanted", f"the label map excludes class {class_id!r}")
            return False
        sighting.label, sighting.confidence = label.strip(), min(score, 1.0)
        if is_number(label) or not is_plain(sighting.label, _MAX_LABEL):
            self.note(index, "no-label", f"class {class_id[:_MAX_LABEL]!r} has no label")
            return False
        if score > 1:
            self.note(index, "high-score", f"the score {score:g} is above 1 and counts as 1")
        return True

    def _most_confident(self, sightings: list[Sighting]) -> list[Sighting]:
        """Return at most `MAX_OBJECTS` sightings, those of highest confidence, in message order."""
        ranked = sorted(sightings, key=lambda sighting: -sighting.confidence)
        if (more := len(ranked) - MAX_OBJECTS + self.left_out) > 0:
            detail = f"{more} detections are left out: {MAX_OBJECTS} have equal or higher scores"
            self.note(None, "too-many", detail)
        return sorted(ranked[:MAX_OBJECTS], key=lambda sighting: sighting.index)

    def objects(self) -> list[dict[str, Any]]:
        ids = self._ids()
        return [
            {"id": ids[one.index], "label": one.label, "confidence": one.confidence}
            | (self._pose(one) if self.is_solid else {})
            for one in self.sightings
        ]

    def _ids(self) -> dict[int, str]:
        """Return the id of each detection: that of the detector, or its label and a number."""
        index_of_id: dict[str, int] = {}
        for sighting in self.sightings:
            name = sighting.name
            if name and sighting.is_numbered:
                name = f"{sighting.label}_{name}"
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

    def _pose(self, sighting: Sighting) -> dict[str, Any]:
        """Return the fields position, size and orientation of a detection, as far as known."""
        solid, detail = sighting.solid, ""
        if sighting.frame not in ("", self.frame):
            detail = "the detection has another frame than the message"
        elif solid is None:
            detail = "the box and the pose are unset"
        elif not all(abs(value) <= _MAX_METRES for value in solid.position):
            detail = "the position is not finite or out of range"
        if detail or solid is None:
            if solid or sighting.is_unset or self.has_poses:
                self.note(sighting.index, "no-position", detail)
            return {}
        fields: dict[str, Any] = {"position": _named("xyz", solid.position)}
        if solid.sides:
            fields["size"] = _named("xyz", solid.sides)
        length = math.hypot(*solid.turn) if solid.turn else math.nan
        if solid.yaw is not None and math.isfinite(solid.yaw):
            fields["yaw"] = math.remainder(solid.yaw, math.tau)
        elif solid.turn and _MIN_NORM < length < math.inf:
            fields["orientation"] = _named("xyzw", [value / length for value in solid.turn])
        return fields

    def image_relations(self, objects: list[dict[str, Any]]) -> list[dict[str, str]]:
        """Return the relations left between neighbouring boxes in the image."""
        boxes = [self._image_box(sighting) for sighting in self.sightings]
        # If there are too many relations, the request contains those of the most confident objects.
        order = sorted(range(len(boxes)), key=lambda i: -self.sightings[i].confidence)
        pairs = left_pairs(boxes, order)
        if (extra := len(pairs) - MAX_RELATIONS) > 0:
            self.note(None, "too-many", f"the request leaves out {extra} relations")
        return [
            {"subject": objects[i]["id"], "relation": "left", "object": objects[j]["id"]}
            for i, j in sorted(pairs[:MAX_RELATIONS])
        ]

    def _image_box(self, sighting: Sighting) -> Box | None:
        box, detail = sighting.image, ""
        if sighting.frame not in ("", self.frame):
            detail = "the detection has another frame than the message"
        elif box is None or not all(map(math.isfinite, box)):
            detail = "the box is not finite"
        elif not (box[2] > box[0] and box[3] > box[1]):
            detail = "the box must have a positive width and height"
        if detail:
            self.note(sighting.index, "no-box", detail)
        return None if detail else box


def is_number(label: str) -> bool:
    """Return whether a class is a whole number or an id of Freebase, which need a label map."""
    return label.removeprefix("-").isdecimal() or label.startswith(("/m/", "/g/", "/t/"))


def _named(names: str, values: Sequence[float] | None) -> dict[str, float]:
    return dict(zip(names, values or (), strict=True))


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
