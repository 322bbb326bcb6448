"""The rooms of a home as polygons, and the pose of a robot, in the frame ``map`` in metres."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from scene_client.errors import InvalidRequestError
from scene_client.tracks import Point, Vector

EDGE: Final = 0.2  # metres outside of a room until a thing, or the robot, has left it
LEAST_CORNERS: Final = 3


class FloorPlan:
    """The polygons of the rooms by name. A plan without rooms is possible.

    Raises:
        InvalidRequestError: a polygon has fewer than three corners, or another form.
    """

    def __init__(self, rooms: Mapping[str, Iterable[Sequence[float]]]) -> None:
        self.rooms = {name: _polygon(name, corners) for name, corners in rooms.items()}

    def room_of(self, place: Vector, room: str) -> str:
        """Return the room of a place, or "". At the edges of its `room`, a thing stays in it."""
        (x, y, _), polygon = place, self.rooms.get(room, ())
        around = ((x, y), (x - EDGE, y), (x + EDGE, y), (x, y - EDGE), (x, y + EDGE))
        if any(inside(*at, polygon) for at in around):
            return room
        return next((one for one, edge in self.rooms.items() if inside(x, y, edge)), "")


def _polygon(name: str, corners: Iterable[Sequence[float]]) -> list[Point]:
    rule = "must be a list of at least three corners [x, y] in metres"
    try:
        polygon = [(float(x), float(y)) for x, y in corners]
    except (TypeError, ValueError):
        raise InvalidRequestError.about(rule, f"#/rooms/{name}") from None
    if not all(math.isfinite(value) for corner in polygon for value in corner):
        raise InvalidRequestError.about(f"{rule}, without NaN", f"#/rooms/{name}")
    if (distinct := len(set(polygon))) < LEAST_CORNERS:
        raise InvalidRequestError.about(f"{rule}, not of {distinct}", f"#/rooms/{name}")
    return polygon


def inside(x: float, y: float, polygon: Iterable[Point]) -> bool:
    """Return whether a polygon contains a point (even-odd rule)."""
    corners, odd = list(polygon), False
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            odd = not odd
    return odd


def pose_of(values: Sequence[float] | Mapping[str, float] | None) -> Vector | None:
    """Return x, y and yaw; None if the robot is not located.

    Raises:
        InvalidRequestError: the values have another form than x, y, yaw.
    """
    if values is None:
        return None
    try:
        if isinstance(values, Mapping):
            values = [values[name] for name in ("x", "y", "yaw")]
        x, y, yaw = map(float, values)
    except (LookupError, TypeError, ValueError):
        rule = "must be x, y and yaw of the robot, in metres and radians"
        raise InvalidRequestError.about(rule, "#/pose") from None
    return (x, y, yaw) if all(map(math.isfinite, (x, y, yaw))) else None
