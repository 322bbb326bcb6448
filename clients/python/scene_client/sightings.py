"""Messages in the layout of vision_msgs, which every reader of a file format returns.

A `Message` has the fields of a Detection2DArray or a Detection3DArray. So one converter,
`vision_msgs.from_message`, chooses labels, ids and at most 256 objects for all formats.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from scene_client.frames import Quaternion
from scene_client.ros_fields import number
from scene_client.vision_msgs import Note, Reason

NO_TURN: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)


@dataclass
class Message:
    """Detections of one scene.

    Attributes:
        detections: entries as of `detection`.
        header: `frame_id` and `stamp`, as in std_msgs/Header.
        viewpoint: pose of the viewer, or None if unknown.
        notes: notes on entries that are not part of the scene.
    """

    detections: list[dict[str, Any]]
    header: Mapping[str, Any] = field(default_factory=dict)
    viewpoint: Mapping[str, float] | None = None
    notes: tuple[Note, ...] = ()


def detection(
    label: Any, score: Any = 1.0, name: Any = "", *, frame: Any = "", **box: Any
) -> dict[str, Any]:
    """Return a detection with a class (label or id), a score, an id and the field ``bbox``."""
    result = {"class_id": label, "score": score}
    return {"header": {"frame_id": frame}, "id": name, "results": [result], **box}


def image_box(x: Any, y: Any, width: Any, height: Any, theta: float = 0.0) -> dict[str, Any]:
    """Return the field ``bbox`` of a box in an image, by its centre, its size and its rotation."""
    centre = {"x": x, "y": y, "theta": theta}
    return {"bbox": {"center": centre, "size_x": width, "size_y": height}}


def box_between(xs: Iterable[Any], ys: Iterable[Any], theta: float = 0.0) -> dict[str, Any]:
    """Return the field ``bbox`` of the box around points of an image, rotated by ``theta``."""
    (left, right), (top, bottom) = _span(xs), _span(ys)
    return image_box((left + right) / 2, (top + bottom) / 2, right - left, bottom - top, theta)


def solid_box(
    centre: Any, size: Any, turn: Any = NO_TURN, *, yaw: float | None = None
) -> dict[str, Any]:
    """Return the field ``bbox`` of a box. Each value is a sequence or None.

    ``yaw`` is the rotation about the axis that points up in radians, instead of ``turn``.
    """
    pose = {"position": _named("xyz", centre), "orientation": _named("xyzw", turn), "yaw": yaw}
    return {"bbox": {"center": pose, "size": _named("xyz", size)}}


def turn_of(yaw: float) -> Quaternion:
    """Return the rotation about the z axis by an angle in radians."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def vector(value: Any) -> Any:
    """Return the values of an object {x, y, z}; other values unchanged."""
    return [value.get(axis) for axis in "xyz"] if isinstance(value, Mapping) else value


def excluded(count: int, what: str) -> tuple[Note, ...]:
    """Return a note that the scene does not contain ``count`` entries, or no note for 0."""
    reason: Reason = "excluded"
    return (Note(None, reason, f"the scene leaves out {count} {what}"),) if count else ()


def _span(values: Iterable[Any]) -> tuple[float, float]:
    """Return the minimum and the maximum, or NaN if a value is not a finite number."""
    every = [number(value) for value in values]
    finite = [value for value in every if value is not None]
    if not finite or len(finite) < len(every):
        return math.nan, math.nan
    return min(finite), max(finite)


def _named(names: str, values: Sequence[Any] | None) -> dict[str, Any] | None:
    return None if values is None else dict(zip(names, values, strict=True))
