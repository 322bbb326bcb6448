"""ROS messages for tests: the published layouts, read by the parser that reads bags.

`Layout.current` is vision_msgs from Humble on, and `Layout.former` is that of Foxy. Messages are
plain dataclasses. `blank` fills in ROS's defaults, and `to_json` writes as rosbridge does.
"""

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

MESSAGES = Path(__file__).parent / "msg"
OWN = Path(__file__).resolve().parents[2] / "clients" / "ros2" / "scene_reasoning_msgs"


def _store(layout: str) -> Typestore:
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for folder in (MESSAGES / "common", MESSAGES / layout):
        for path in folder.glob("*.msg"):
            types |= get_types_from_msg(path.read_text("utf-8"), f"vision_msgs/msg/{path.stem}")
    for path in OWN.glob("msg/*.msg"):
        types |= get_types_from_msg(path.read_text("utf-8"), f"{OWN.name}/msg/{path.stem}")
    for path in OWN.glob("srv/*.srv"):
        parts = zip(("Request", "Response"), path.read_text("utf-8").split("---\n"), strict=True)
        for part, text in parts:
            types |= get_types_from_msg(text, f"{OWN.name}/msg/{path.stem}_{part}")
    store.register(types)
    return store


class Layout:
    """The message types of two generations of vision_msgs."""

    current = _store("current")
    former = _store("former")


_NUMBERS = count(1)


def blank(store: Typestore, name: str, /, **values: Any) -> Any:
    """A message with ROS's defaults, and the fields given."""
    made = {}
    for field, (kind, detail) in store.fielddefs[name][1]:
        made[field] = _blank_field(store, int(kind), detail)
    if name == "geometry_msgs/msg/Quaternion":
        made["w"] = 1.0
    return store.types[name](**(made | values))


def _blank_field(store: Typestore, kind: int, detail: Any) -> Any:
    if kind == 1:
        return {"string": "", "bool": False, "float64": 0.0, "float32": 0.0}.get(detail[0], 0)
    if kind == 2:
        return blank(store, detail)
    (inner, inner_detail), length = detail
    if int(inner) == 2 or inner_detail[0] == "string":
        return []
    return np.zeros(length if kind == 3 else 0, dtype=inner_detail[0])


def filled(store: Typestore, name: str, numbers: Iterator[float], length: int) -> Any:
    """A message with these numbers, lists of this length, and distinct integers and texts."""
    made = {}
    for field, (kind, detail) in store.fielddefs[name][1]:
        made[field] = _blank_field(store, int(kind), detail)
        if int(kind) == 2:
            made[field] = filled(store, detail, numbers, length)
        elif int(kind) == 3:
            made[field] = np.array([next(numbers) for _ in range(detail[1])])
        elif int(kind) == 4 and int(detail[0][0]) == 2:
            made[field] = [filled(store, detail[0][1], numbers, length) for _ in range(length)]
        elif detail[0] in {"float32", "float64"}:
            made[field] = next(numbers)
        elif detail[0] in {"string", "int32", "uint32"}:
            number = next(_NUMBERS)
            made[field] = "é" * (number % 7) if detail[0] == "string" else number
    return store.types[name](**made)


def through_cdr(store: Typestore, message: Any) -> Any:
    """The message after a journey over the wire of ROS 2; fails where it breaks its type."""
    name = message.__msgtype__
    return store.deserialize_cdr(store.serialize_cdr(message, name), name)


def to_json(message: Any) -> Any:
    """The message as rosbridge sends it: numbers that JSON lacks are null."""
    if is_dataclass(message) and not isinstance(message, type):
        return {
            field.name: to_json(getattr(message, field.name))
            for field in fields(message)
            if field.name != "__msgtype__"
        }
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, list):
        return [to_json(entry) for entry in message]
    if isinstance(message, float) and not math.isfinite(message):
        return None
    return message
