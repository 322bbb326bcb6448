"""Reading of ROS messages in two forms: JSON from rosbridge, or Python objects.

rclpy and bag readers return objects with attributes. rosbridge returns dictionaries in which NaN
and infinity are null. The functions of this module return None for a field that is missing or has
the wrong type.

Detectors report a class id as text, which is often a number ("56"). A label map contains the label
of each class id; `read_label_map` lists its forms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from numbers import Real
from typing import Any, Final, TypeAlias

from scene_client.untrusted import printable


class MessageError(ValueError):
    """A message does not contain a valid scene, or an argument is invalid. The text is one line."""

    def __str__(self) -> str:
        return printable(super().__str__())


def take(message: Any, *path: str) -> Any:
    """Return the nested field at a path of names, or None if a part of the path is missing."""
    for name in path:
        if message is None:
            return None
        # A message has hundreds of fields. The check for `dict` is much faster than the check for
        # `Mapping`.
        if type(message) is dict or isinstance(message, Mapping):
            message = message.get(name)
        else:
            message = getattr(message, name, None)
    return message


def members(message: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of the fields of a message; nothing for other data."""
    if isinstance(message, Mapping):
        yield from ((name, value) for name, value in message.items() if isinstance(name, str))
        return
    names: Any = getattr(message, "get_fields_and_field_types", dict)()  # of rclpy
    for name in names or getattr(message, "__slots__", ()) or getattr(message, "__dict__", ()):
        yield name, getattr(message, name, None)


def items(field: Any, name: str) -> Sequence[Any]:
    """Return the entries of a list field, or an empty sequence for a missing field.

    Raises:
        MessageError: the field is not a list.
    """
    if field is None:
        return ()
    if not isinstance(field, list | tuple):
        raise MessageError(f"{name} must be a list")
    return field


def number(field: Any) -> float | None:
    """Return the field as a float, or None if the field is not a finite number."""
    if type(field) is not float:
        if isinstance(field, bool) or not isinstance(field, Real):
            return None
        try:
            field = float(field)
        except OverflowError:
            return None
    return field if math.isfinite(field) else None


def integer(field: Any) -> int | None:
    """Return the field as an int, or None if the field is not a whole number."""
    value = number(field)
    return int(value) if value is not None and value.is_integer() else None


def numbers(message: Any, names: str) -> dict[str, float] | None:
    """Return the numbers in fields with one-letter names ("xyz"), or None if one is not finite."""
    values = {name: value for name in names if (value := number(take(message, name))) is not None}
    return values if len(values) == len(names) else None


def text(field: Any) -> str:
    """Return a text or a whole number as text without surrounding blanks, or "" for other types."""
    if isinstance(field, str):
        return field.strip()
    whole = integer(field)
    return "" if whole is None else str(whole)


def is_plain(value: str, longest: int) -> bool:
    """Return whether the service accepts a text of at most ``longest`` characters as a name."""
    return 0 < len(value) <= longest and value.isprintable()


def short(name: str) -> str:
    """Return the start of a name for a message, without unprintable characters."""
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in name[:40])


def frame_of(header: Any) -> str:
    """Return the name of the frame in a std_msgs/Header, or "" if the header has no frame."""
    frame = take(header, "frame_id")
    # In tf2, a frame name has no leading slash. Older drivers still send a leading slash.
    return frame.strip().lstrip("/") if isinstance(frame, str) else ""


def time_of(stamp: Any) -> dict[str, int] | None:
    """Convert a time of ROS 1 or ROS 2 to the field `stamp`. Return None for an invalid time."""
    for names in (("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec")):
        seconds, nanoseconds = (integer(take(stamp, name)) for name in names)
        if seconds is not None and nanoseconds is not None:
            is_valid = -(2**31) <= seconds < 2**31 and 0 <= nanoseconds < 1_000_000_000
            return {"sec": seconds, "nanosec": nanoseconds} if is_valid else None
    return None


def unwrapped(message: Any) -> Any:
    """Return a ROS message without the envelope that rosbridge adds."""
    inner = message.get("msg") if isinstance(message, Mapping) else None
    return inner if isinstance(inner, Mapping) else message


# -------------------------------------------------------------------------------- class ids

LabelMap: TypeAlias = Mapping[Any, str | None] | Sequence[str] | str | object

COCO: Final = (
    *("person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat"),
    *("traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat"),
    *("dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack"),
    *("umbrella", "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball"),
    *("kite", "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket"),
    *("bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple"),
    *("sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair"),
    *("couch", "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse"),
    *("remote", "keyboard", "cell phone", "microwave", "oven", "toaster", "sink"),
    *("refrigerator", "book", "clock", "vase", "scissors", "teddy bear", "hair drier"),
    "toothbrush",
)
"""Labels of the 80 classes of COCO. The index of a label is the usual class id of detectors."""

_UNUSED: Final = frozenset((12, 26, 29, 30, 45, 66, 68, 69, 71, 83))
COCO_91: Final = dict(zip((n for n in range(1, 91) if n not in _UNUSED), COCO, strict=True))
"""Labels of the same classes by the `category_id` (1 to 90) of COCO's files."""

REMEDY: Final = (
    "choose a label map (label_map, or --label-map of the command scene): coco80, coco91 or the "
    "labels of the ids"
)
"""What to do about numeric class ids."""

WELL_KNOWN: Final = {"coco": COCO, "coco80": COCO, "coco91": COCO_91}


def read_label_map(label_map: LabelMap | None) -> dict[str, str | None]:
    """Return a dictionary from class ids (as text) to labels.

    Objects of a class with the label None do not become part of a scene.

    Args:
        label_map: a mapping from class ids (text or numbers) to labels, a list of labels with the
            class ids as indices, a vision_msgs/LabelInfo (message or JSON), "coco80" or "coco" for
            the ids 0 to 79 of detectors, or "coco91" for the ids 1 to 90 of COCO's files. None
            means an empty label map.

    Raises:
        MessageError: `label_map` has another type.
    """
    if label_map is None:
        return {}
    if isinstance(label_map, str):
        if label_map not in WELL_KNOWN:
            names = ", ".join(sorted(WELL_KNOWN))
            raise MessageError(f"no label map has the name {label_map!r}; known names: {names}")
        label_map = WELL_KNOWN[label_map]
    elif (classes := take(label_map, "class_map")) is not None:
        label_map = {
            take(entry, "class_id"): take(entry, "class_name")
            for entry in items(classes, "class_map")
            if isinstance(take(entry, "class_id"), int | str)
        }
    if isinstance(label_map, Mapping):
        pairs = list(label_map.items())
    elif isinstance(label_map, Sequence):
        pairs = list(enumerate(label_map))
    else:
        raise MessageError(
            "label_map must be a mapping, a list of labels, a vision_msgs/LabelInfo or the name of "
            "a known list"
        )
    if not all(label is None or isinstance(label, str) for _, label in pairs):
        raise MessageError("every entry of label_map must be a label or None")
    return {str(class_id).strip(): label for class_id, label in pairs}
