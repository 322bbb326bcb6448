"""Scenes of requests in the training format, as the recorder writes them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from secrets import token_hex
from time import localtime, strftime, time_ns
from typing import TYPE_CHECKING, Any, Final

from scene_client.frames import METRES, Conventions, Vector, is_world_fixed

if TYPE_CHECKING:
    from scene_client.schemas import SceneRequest, Viewpoint

LEAST_CONFIDENCE: Final = 0.5
"""Objects with a lower confidence are left out of a scene."""

Thing = Mapping[str, Any]
Triple = tuple[str, str, str]
Time = tuple[str, dict[str, int]]
ON_TOP: Final = ("on-top", "under")


def scene_of(
    request: SceneRequest, time: Time | None = None, things: Sequence[Thing] | None = None
) -> dict[str, Any]:
    """Return the scene of a request in the training format, with the current time by default.

    Positions are in metres and in the axes of the viewer, except in world-fixed frames without a
    viewpoint: then they are in body axes. If the size of a box is unknown, its origin counts as its
    centre. The
    training takes unlisted relations for false, so relations are listed only if the request states
    all of them. Otherwise, on-top becomes `supported_by`, and the other relations are left out.
    """
    hour, stamp = time or time_of(request)
    scene: dict[str, Any] = {"scene_id": f"{hour}-{token_hex(8)}", "group": hour}
    if request.room_type is not None:
        scene["room_type"] = request.room_type
    things = likely(request) if things is None else things
    conventions = Conventions.of(request, request.frame_id)
    scene["objects"] = objects = [
        _object(name, thing, request.viewpoint, conventions)
        for name, thing in zip(_ids(things), things, strict=True)
    ]
    if request.relations is not None or any("supported_by" in thing for thing in objects):
        _relate(scene, request)
    if any("position" in thing for thing in objects):
        has_viewer = request.viewpoint is not None or not is_world_fixed(request.frame_id)
        scene["viewer_frame"] = has_viewer
    scene["stamp"] = stamp
    if request.confirmed:
        scene["confirmed"] = True
    return scene


def _relate(scene: dict[str, Any], request: SceneRequest) -> None:
    """Add the stated relations to a scene, and replace the labels in `supported_by` by ids."""
    objects = {thing["id"]: thing for thing in scene["objects"]}
    labels = Counter(thing["label"] for thing in objects.values())
    names = {thing["label"]: name for name, thing in objects.items() if labels[thing["label"]] == 1}
    names |= {name: name for name in objects}
    relations = [
        [names[one.subject], one.relation, names[one.object]]
        for one in request.relations or ()
        if one.subject in names and one.object in names
    ]
    for subject, relation, anchor in () if request.relations_complete else relations:
        if relation in ON_TOP:
            upper, lower = (subject, anchor) if relation == "on-top" else (anchor, subject)
            objects[upper].setdefault("supported_by", lower)
    for thing in objects.values():
        if "supported_by" in thing and (support := names.get(thing.pop("supported_by"))):
            thing["supported_by"] = support
    if request.relations_complete:
        supports = [
            [name, "on-top", thing["supported_by"]]
            for name, thing in objects.items()
            if "supported_by" in thing
        ]
        scene["relations"] = relations + [one for one in supports if one not in relations]


def time_of(request: SceneRequest) -> Time:
    """Return the hour in local time, which is the group of the scene, and the stamp."""
    if request.stamp is None:
        second, nanosecond = divmod(time_ns(), 10**9)
    else:
        second, nanosecond = request.stamp.sec, request.stamp.nanosec
    return strftime("%Y-%m-%dT%H", localtime(second)), {"sec": second, "nanosec": nanosecond}


def likely(request: SceneRequest) -> list[Thing]:
    """Return the fields of the recorded objects. For a label, this is only the field `label`."""
    # A dictionary is faster than the attributes of a pydantic object.
    things: Iterable[Thing] = (
        {"label": one} if isinstance(one, str) else vars(one) for one in request.objects
    )
    return [one for one in things if one.get("confidence", 1.0) >= LEAST_CONFIDENCE]


def _ids(things: Sequence[Thing]) -> list[str]:
    """Return distinct ids, as the service chooses them."""
    stated: list[Any] = [one.get("id") for one in things]
    if None not in stated:
        return stated
    labels = [one["label"] for one in things]
    used = {name for name in stated if name is not None}
    bare = Counter(label for label, name in zip(labels, stated, strict=True) if name is None)
    ids = []
    for name, label in zip(stated, labels, strict=True):
        own, number = label if name is None else name, 0
        while name is None and (own in used or (bare[label] > 1 and not number)):
            number += 1
            own = f"{label}_{number}"
        used.add(own)
        ids.append(own)
    return ids


def _object(
    name: str, entry: Thing, view: Viewpoint | None, conventions: Conventions
) -> dict[str, Any]:
    """Return an object in the training format. `supported_by` is an id or a label."""
    thing: dict[str, Any] = {"id": name, "label": entry["label"]}
    place, size, yaw = conventions.box(
        None if (one := entry.get("position")) is None else (one.x, one.y, one.z),
        None if (one := entry.get("size")) is None else (one.x, one.y, one.z),
        None if (one := entry.get("orientation")) is None else (one.x, one.y, one.z, one.w),
        entry.get("yaw"),
    )
    if place is not None:
        if view is not None:
            cos, sin, metres = math.cos(view.yaw), math.sin(view.yaw), METRES[conventions.units]
            x, y = place[0] - metres * view.x, place[1] - metres * view.y
            place, yaw = (x * cos + y * sin, y * cos - x * sin, place[2]), yaw - view.yaw
        thing["position"] = _rounded(place)
    if size is not None:
        thing["size"] = _rounded(size)
    if place is not None and yaw:
        thing["yaw"] = round(math.remainder(yaw, math.tau), 4)
    if (support := entry.get("supported_by")) is not None:
        thing["supported_by"] = support
    return thing


def _rounded(vector: Vector) -> list[float]:
    # Faster than round(value, 4), and without -0.0.
    x, y, z = vector
    return [(x * 1e4 + 0.5) // 1 / 1e4, (y * 1e4 + 0.5) // 1 / 1e4, (z * 1e4 + 0.5) // 1 / 1e4]
