"""Boxes of many conventions: numbers in data become boxes in an image or with a position."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Final

from scene_client.frames import Conventions, quaternion_of
from scene_client.image_plane import Box, upright_box
from scene_client.ros_fields import MessageError, number, take
from scene_client.sightings import Solid

NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
"""A number as text."""
IMAGE: Final = ("corners", "rows", "corner", "centre", "points", "spans", "radii")
"""Kinds of boxes in an image, by the meaning of their numbers."""
SOLID: Final = ("position", "size", "turn", "axes", "matrix", "span", "yaw", "degrees", "about")
"""Parts of a box with a position."""

_NONE: Final = frozenset(("", "nan", "null", "none", "n/a", "inf", "-inf", "infinity"))


def numeric(value: Any, what: str) -> float:
    """Return a number, also of text; NaN for other values.

    Raises:
        MessageError: the value is text without a number.
    """
    if type(value) is float:
        return value
    if isinstance(value, str):
        value = value.strip()
        if NUMBER.fullmatch(value):
            return float(value)
        if value.lower() not in _NONE:
            raise MessageError(f"{what}: {value[:40]!r} is not a number")
    return math.nan if (found := number(value)) is None else found


def numerics(value: Any, what: str) -> list[float]:
    """Return the numbers of a list, of nested lists, of "x,y;x,y", or of the members x, y, z, w."""
    if isinstance(value, str) and "," in value:
        value = value.strip("[]() ").replace(";", ",").split(",")
    if hasattr(value, "tolist"):  # an array of numpy or of the standard library
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [part for one in value for part in numerics(one, what)]
    if value is None or isinstance(value, str | float | int):
        return [numeric(value, what)]
    parts = [take(value, axis) for axis in "xyzw"]
    return [numeric(part, what) for n, part in enumerate(parts) if n < 2 or part is not None]


def image(kind: str, values: Any, what: str, theta: float = 0.0) -> Box | None:
    """Return the upright box around a box in an image that is rotated by ``theta`` radians."""
    if kind == "spans":
        xs, ys = (numerics(one, what) for one in values)
    else:
        if isinstance(values, list) and all(isinstance(one, Mapping) for one in values):
            # Protocol buffers leave a 0 out.
            values = [(one.get("x") or 0, one.get("y") or 0) for one in values]
        several = numerics(values, what)
        xs, ys = several[::2], several[1::2]
        if kind == "rows":  # y before x
            xs, ys = ys, xs
        if kind != "points" and len(several) != 4:
            return None
    if not xs or not all(map(math.isfinite, xs + ys)):
        return math.nan, math.nan, math.nan, math.nan
    if kind == "circle":  # its centre and a point on it
        radius = math.dist((xs[0], ys[0]), (xs[-1], ys[-1]))
        return xs[0] - radius, ys[0] - radius, xs[0] + radius, ys[0] + radius
    if kind in ("corner", "centre", "radii"):
        (x, width), (y, height) = xs, ys
        if kind == "radii":
            width, height = 2 * width, 2 * height
        if kind == "corner":  # the rotation is about the corner
            cos, sin = math.cos(theta) / 2, math.sin(theta) / 2
            x, y = x + cos * width - sin * height, y + sin * width + cos * height
    else:
        x, y, width, height = sum(_span(xs)) / 2, sum(_span(ys)) / 2, _side(xs), _side(ys)
    return upright_box((x, y), (width, height), theta)


def _span(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def _side(values: list[float]) -> float:
    return max(values) - min(values)


def solid(form: Mapping[str, Any], values: Mapping[str, Any], what: str) -> Solid | None:
    """Return a box with a position, with z up if the format has another convention."""
    parts = {name: numerics(value, what) for name, value in values.items()}
    if len(matrix := parts.get("matrix", [])) == 16:  # the columns, one after another
        parts |= {"position": matrix[12:15], "axes": matrix[0:3] + matrix[4:7] + matrix[8:11]}
    if len(axes := parts.get("axes", [])) == 9:
        parts["turn"] = [*quaternion_of(axes)]
    if (span := parts.get("span")) and all(map(math.isfinite, span)):
        sides = [_side(span[axis::3]) for axis in range(3)]
        middle = [sum(_span(span[axis::3])) / 2 for axis in range(3)]
        parts = {"position": middle, **parts} | ({"size": sides} if any(sides) else {})
    if "about" in parts:  # the y axis
        half = parts["about"][0] / 2
        parts["turn"] = [0.0, math.sin(half), 0.0, math.cos(half)]
    if len(position := parts.get("position", [])) in (1, 2):  # a member is missing
        position = [math.nan] * 3
    size, turn = (_of_length(parts.get(name), n) for name, n in (("size", 3), ("turn", 4)))
    yaw = [*map(math.radians, parts.get("degrees", ())), *parts.get("yaw", ()), None][0]
    if len(position) != 3:
        return None
    if "up" not in form or not all(map(math.isfinite, position)):
        return Solid(position, size, turn, yaw)
    x, y, z = position
    up = form["up"]
    if up == "unity":  # a left-handed frame, whose z axis points the other way
        up, z, yaw = "y", -z, None if yaw is None else -yaw
    order, origin = form.get("order", "xyzw"), form.get("origin", "centre")
    conventions = Conventions(up, box_origin=origin, quaternion_order=order)
    try:
        box = conventions.box((x, y, z), size, None if yaw is not None else turn, yaw)
    except ValueError:  # no rotation
        box = conventions.box((x, y, z), size)
    return Solid(box[0] or position, box[1], None, box[2])


def _of_length(values: list[float] | None, length: int) -> Any:
    return tuple(values) if values and len(values) == length else None
