"""Conversion of a scene in the format of the training to the fields of a request."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any


def is_annotated(scene: Any) -> bool:
    """Return whether a scene has the ids or the positions of the training format."""
    objects = scene.get("objects") if isinstance(scene, dict) else None
    return isinstance(objects, list) and any(
        isinstance(thing, dict)
        and (isinstance(thing.get("id"), int) or isinstance(thing.get("position"), list))
        for thing in objects
    )


def from_annotated(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a request for a scene of the training format.

    An object gets its label as id, followed by its number if several objects have the label. If all
    objects have positions, the request contains the positions, and otherwise the relations and
    supports of the scene.

    Raises:
        KeyError, TypeError, ValueError: the scene does not have the training format.
    """
    objects = scene["objects"]
    counts = Counter(thing["label"] for thing in objects)
    ids = {
        thing["id"]: f"{thing['label']}_{thing['id']}"
        if counts[thing["label"]] > 1
        else thing["label"]
        for thing in objects
    }
    found: dict[str, Any] = {}
    if all(thing.get("position") is not None for thing in objects):
        found["objects"] = [_with_pose(ids[thing["id"]], thing) for thing in objects]
        if not scene.get("viewer_frame"):
            found["frame_id"] = "map"
    else:
        found["objects"] = [{"id": ids[thing["id"]], "label": thing["label"]} for thing in objects]
        supports = [
            [thing["id"], "on-top", thing["supported_by"]]
            for thing in objects
            if thing.get("supported_by") is not None
        ]
        stated = {tuple(one): None for one in [*(scene.get("relations") or ()), *supports]}
        relations = [
            {"subject": ids[subject], "relation": relation, "object": ids[other]}
            for subject, relation, other in stated
        ]
        found |= {"relations": relations} if relations else {}
    if scene.get("room_type") is not None:
        found["room_type"] = scene["room_type"]
    return found


def _with_pose(name: str, thing: Mapping[str, Any]) -> dict[str, Any]:
    half = thing.get("yaw", 0.0) / 2
    pose = {
        "id": name,
        "label": thing["label"],
        "position": _metres(thing["position"]),
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }
    return pose | ({"size": _metres(thing["size"])} if thing.get("size") is not None else {})


def _metres(vector: list[float]) -> dict[str, float]:
    x, y, z = vector
    return {"x": x, "y": y, "z": z}
