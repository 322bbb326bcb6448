"""Conversion of a scene in the format of the training to the fields of a request."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any


def is_annotated(scene: Any) -> bool:
    """Return whether a value is a scene of the training format, which has a `scene_id`."""
    return isinstance(scene, dict) and "scene_id" in scene


def from_annotated(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a request for a scene of the training format.

    An object gets its label as id, followed by its own id if several objects have the label. If an
    object has no position, the request also contains the relations and supports of the scene.

    Raises:
        ArithmeticError, KeyError, TypeError, ValueError: the scene does not have this format.
    """
    objects = scene["objects"]
    counts = Counter(thing["label"] for thing in objects)
    ids = {
        thing["id"]: f"{thing['label']}_{thing['id']}"
        if counts[thing["label"]] > 1
        else thing["label"]
        for thing in objects
    }
    if len(set(ids.values())) < len(objects):
        raise ValueError("two objects have the same id")
    fields: dict[str, Any] = {"objects": [_detection(ids[thing["id"]], thing) for thing in objects]}
    if not all("position" in thing for thing in fields["objects"]):
        supports = [
            [thing["id"], "on-top", thing["supported_by"]]
            for thing in objects
            if thing.get("supported_by") is not None
        ]
        stated = dict.fromkeys(map(tuple, [*(scene.get("relations") or ()), *supports]))
        relations = [
            {"subject": ids[subject], "relation": relation, "object": ids[other]}
            for subject, relation, other in stated
        ]
        fields |= {"relations": relations} if relations else {}
    if not scene.get("viewer_frame"):
        fields["frame_id"] = "map"
    if scene.get("room_type") is not None:
        fields["room_type"] = scene["room_type"]
    return fields


def _detection(name: str, thing: Mapping[str, Any]) -> dict[str, Any]:
    detection: dict[str, Any] = {"id": name, "label": thing["label"]}
    if thing.get("position") is not None:
        half = thing.get("yaw", 0.0) / 2
        detection["position"] = _metres(thing["position"])
        detection["orientation"] = {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}
        detection |= {"size": _metres(thing["size"])} if thing.get("size") is not None else {}
    return detection


def _metres(vector: list[float] | dict[str, float]) -> dict[str, float]:
    x, y, z = vector.values() if isinstance(vector, dict) else vector
    return {"x": x, "y": y, "z": z}
