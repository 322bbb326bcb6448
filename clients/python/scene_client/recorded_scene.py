"""Scenes of requests in the training format, as the recorder writes them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from secrets import token_hex
from time import localtime, strftime, time_ns
from typing import TYPE_CHECKING, Any, Final

from scene_client.frames import body_pose, is_optical, is_world_fixed

if TYPE_CHECKING:
    from scene_client.schemas import Detection, SceneRequest, Viewpoint

LEAST_CONFIDENCE: Final = 0.5
"""Objects with a lower confidence are left out of a scene."""

Triple = tuple[str, str, str]
Time = tuple[str, dict[str, int]]
ON_TOP: Final = ("on-top", "under")


def scene_of(request: SceneRequest, time: Time | None = None) -> dict[str, Any]:
    """Return the scene of a request in the training format, with the current time by default.

    Positions are in the axes of the viewer, except in world-fixed frames without a viewpoint. The
    training takes unlisted relations for false, so relations are listed only if the request states
    all of them. Otherwise, on-top becomes `supported_by`, and the other relations are left out.
    """
    hour, stamp = time or time_of(request)
    scene: dict[str, Any] = {"scene_id": f"{hour}-{token_hex(8)}", "group": hour}
    if request.room_type is not None:
        scene["room_type"] = request.room_type
    entries = likely(request)
    optical = is_optical(request.frame_id)
    scene["objects"] = objects = [
        _object(name, entry, request.viewpoint, optical)
        for name, entry in zip(_ids(entries), entries, strict=True)
    ]
    if request.relations is not None or any("supported_by" in thing for thing in objects):
        _relate(scene, request)
    if any("position" in thing for thing in objects):
        has_viewer = request.viewpoint is not None or not is_world_fixed(request.frame_id)
        scene["viewer_frame"] = has_viewer
    scene["stamp"] = stamp
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


def likely(request: SceneRequest) -> list[str | Detection]:
    """Return the objects that are recorded."""
    return [
        entry
        for entry in request.objects
        if isinstance(entry, str) or entry.confidence >= LEAST_CONFIDENCE
    ]


def _ids(objects: Sequence[str | Detection]) -> list[str]:
    """Return distinct ids, as the service chooses them."""
    stated = [None if isinstance(entry, str) else entry.id for entry in objects]
    labels = [entry if isinstance(entry, str) else entry.label for entry in objects]
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
    name: str, entry: str | Detection, view: Viewpoint | None, optical: bool
) -> dict[str, Any]:
    """Return an object in the training format. `supported_by` is an id or a label."""
    if isinstance(entry, str):
        return {"id": name, "label": entry}
    thing: dict[str, Any] = {"id": name, "label": entry.label}
    size = None if entry.size is None else (entry.size.x, entry.size.y, entry.size.z)
    yaw = 0.0
    if (centre := entry.position) is not None:
        turn = None
        if entry.yaw is not None:
            turn = (0.0, 0.0, math.sin(entry.yaw / 2), math.cos(entry.yaw / 2))
        elif (q := entry.orientation) is not None:
            turn = (q.x, q.y, q.z, q.w)
        place, size, yaw = body_pose((centre.x, centre.y, centre.z), size, turn, optical=optical)
        if view is not None:
            cos, sin = math.cos(view.yaw), math.sin(view.yaw)
            x, y = place[0] - view.x, place[1] - view.y
            place, yaw = (x * cos + y * sin, y * cos - x * sin, place[2]), yaw - view.yaw
        thing["position"] = _rounded(place)
    if size is not None:
        thing["size"] = _rounded(size)
    if yaw:
        thing["yaw"] = round(math.remainder(yaw, math.tau), 4)
    if entry.supported_by is not None:
        thing["supported_by"] = entry.supported_by
    return thing


def _rounded(vector: Iterable[float]) -> list[float]:
    # Faster than round(value, 4), and without -0.0.
    return [round(value * 1e4) / 1e4 for value in vector]
