"""Events, things and places of a `scene_client.Home` as ROS messages."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from scene_reasoning_msgs.msg import Place, SceneEvent, Thing
from visualization_msgs.msg import Marker, MarkerArray

from scene_client import Event, Home
from scene_client.schemas import MissingAnswer, WhereAnswer

UNKNOWN = (math.nan, math.nan, math.nan)
_SMALLEST, _LARGEST = 0.05, 1.5  # extent of a marker in metres

Objects = dict[str, tuple[str, Mapping[str, Any]]]
"""The present things as objects of a request, with their rooms, by id."""


def present(home: Home) -> Objects:
    """Return the present things. Without rooms, these are the things within 5 m of the robot."""
    rooms = sorted({one.room for one in home.things()})
    return {one["id"]: (room, one) for room in rooms for one in home.scene(room)["objects"]}


def time_of(seconds: float) -> Time:
    """Return a time."""
    nanoseconds = round(seconds * 1e9)
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def kind_of(kind: str) -> int:
    """Return the constant for the kind of an event."""
    return getattr(SceneEvent, kind.upper().replace("-", "_"))


def event_of(event: Event) -> SceneEvent:
    """Return an event."""
    return SceneEvent(
        kind=kind_of(event.kind),
        stamp=time_of(event.stamp),
        since=time_of(event.since),
        id=event.id or "",
        label=event.label or "",
        room=event.room,
        probability=math.nan if event.probability is None else event.probability,
        detail=event.detail or "",
    )


def things_of(objects: Objects, alarms: Iterable[Event]) -> list[Thing]:
    """Return the present things with their alarms."""
    kinds = {one.id: kind_of(one.kind) for one in alarms}
    return [
        Thing(
            id=name,
            label=one["label"],
            confidence=one["confidence"],
            room=room,
            pose=Pose(
                position=_vector(Point, one.get("position", UNKNOWN)),
                orientation=_turn(one.get("yaw", 0.0)),
            ),
            size=_vector(Vector3, one.get("size", UNKNOWN)),
            alarm=kinds.get(name, SceneEvent.NONE),
        )
        for name, (room, one) in objects.items()
    ]


def places_of(answer: WhereAnswer, objects: Objects) -> list[Place]:
    """Return the places of an answer, with their positions in the frame of the map."""
    places = []
    for spot in answer.places:
        anchor = objects.get(spot.object or "", ("", {}))[1].get("position")
        position, std = _spot(anchor, spot.offset)
        places.append(
            Place(
                room=spot.room,
                relation=spot.relation or "",
                object=spot.object or "",
                probability=spot.probability,
                is_listed=spot.is_listed,
                position=_vector(Point, position),
                position_std=_vector(Vector3, std),
            )
        )
    return places


def markers_of(answer: MissingAnswer, objects: Objects, header: Any, most: int) -> MarkerArray:
    """Return markers for the likeliest missing objects: a text, and a sphere of two deviations.

    An object whose place has no position has no marker. The first marker deletes earlier ones.
    """
    clear = Marker(header=header)
    clear.action = Marker.DELETEALL
    markers, shown = [clear], 0
    for missing in answer.missing:
        for placement in missing.placements:
            label, anchor = _anchor(objects, placement.object)
            if shown == most or anchor is None:
                continue
            shown += 1
            position, std = _spot(anchor, placement.offset)
            text = f"{missing.listed_as or missing.label}? {placement.relation} {label}"
            markers.append(_marker(header, len(markers), Marker.TEXT_VIEW_FACING, position, 1.0))
            markers[-1].text, markers[-1].scale.z = text, 0.08
            if std is not UNKNOWN:
                markers.append(_marker(header, len(markers), Marker.SPHERE, position, 0.35))
                sides = (min(max(2 * side, _SMALLEST), _LARGEST) for side in std)
                markers[-1].scale = _vector(Vector3, tuple(sides))
            break
    return MarkerArray(markers=markers)


def _anchor(objects: Objects, name: str) -> tuple[str, Any]:
    _, one = objects.get(name, ("", {}))
    return one.get("label", ""), one.get("position")


def _spot(anchor: Any, offset: Any) -> tuple[Any, Any]:
    """Return position and deviations of a place: those of the offset, or else the anchor alone."""
    if anchor is None or offset is None:
        return anchor or UNKNOWN, UNKNOWN
    mean, std = offset.mean, offset.std
    position = (anchor[0] + mean.x, anchor[1] + mean.y, anchor[2] + mean.z)
    return position, (std.x, std.y, std.z)


def _marker(header: Any, number: int, kind: int, position: Any, opacity: float) -> Marker:
    marker = Marker(header=header, ns="missing", id=number, type=kind, action=Marker.ADD)
    marker.pose.position = _vector(Point, position)
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = 1.0, 0.6, 0.0, opacity
    return marker


def _vector(kind: Any, values: Any) -> Any:
    x, y, z = values
    return kind(x=float(x), y=float(y), z=float(z))


def _turn(yaw: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
