"""Formats that need more than the paths of the table ``formats.json``.

Each function returns records with the fields that the table, or a table of records, names. All
other exceptions than `MessageError` mean a value of a wrong type.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from scene_client.boxes import numerics
from scene_client.frames import Quaternion, Vector, product, rotated
from scene_client.paths import each
from scene_client.ros_fields import items, members, numbers, take

NO_TURN: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)
_SYMBOL: Final = re.compile(r"(\w?\(?\d+\)?)?")  # of a node, such as O(3)
Records = list[dict[str, Any]]


def rows_of(path: str, data: Any) -> Records:
    """Return the records of lists of equal length, such as ``boxes``, ``labels`` and ``scores``."""
    records = []
    for chain in each(data, path):
        key, node = chain[-1]
        pairs = [(name, _listed(value)) for name, value in members(node)]
        lists = {name: value for name, value in pairs if value}
        scene = key + 1 if isinstance(key, int) else key
        rows = zip(*lists.values(), strict=True)
        records += [{"scene": scene, **dict(zip(lists, row, strict=True))} for row in rows]
    return records


def _listed(value: Any) -> list[Any]:
    """Return a list, or the values of an object; an empty list for other data."""
    return (
        value if isinstance(value, list) else [*value.values()] if isinstance(value, dict) else []
    )


# -------------------------------------------------------------------------------- scene graphs


def hydra(data: Any) -> Records:
    """Return the objects of a scene graph with their rooms. An object is in the room of its place.

    The graph may contain the names of the classes.
    """
    nodes = {node["id"]: node for node in data["nodes"]}
    parents: dict[Any, Any] = {}
    for edge in data["edges"]:
        pair = [nodes[edge[name]] for name in ("source", "target") if edge[name] in nodes]
        if len(pair) == 2 and pair[0]["layer"] != pair[1]["layer"]:
            low, high = sorted(pair, key=lambda node: node["layer"])
            parents[low["id"]] = high["id"]
    rooms = {
        key: str(node["attributes"].get("name") or key)
        for key, node in nodes.items()
        if "Room" in str(node["attributes"].get("type"))
    }
    spaces = (data.get("metadata") or {}).get("labelspaces") or {}
    labels = dict(next((spaces[key] for key in sorted(spaces) if key.startswith("_l2")), ()))
    records = []
    for key, node in nodes.items():
        thing = node["attributes"]
        if "Object" in str(thing.get("type")):
            number, name = thing["semantic_label"], thing.get("name", "")
            label = labels.get(number, number if _SYMBOL.fullmatch(name) else name)
            record = {
                "label": label,
                "id": thing.get("name", ""),
                "room": _room(key, parents, rooms),
            }
            records.append(record | _hydra_box(thing))
    return records


def _hydra_box(thing: Mapping[str, Any]) -> dict[str, Any]:
    box = thing.get("bounding_box") or {}
    size = box.get("dimensions")
    if size is None and "max" in box:  # before version 1.0.3
        size = [a - b for a, b in zip(box["max"], box["min"], strict=True)]
    if "world_P_center" not in box or not any(numerics(size, "the size")):
        return {"position": thing.get("position")}
    rotation = box.get("world_R_center")
    return {"position": box["world_P_center"], "size": size, "orientation": rotation}


def _room(node: Any, parents: Mapping[Any, Any], rooms: Mapping[Any, str]) -> str:
    """Return the name of the room that contains a node, or "" without a room."""
    for _ in range(8):  # an invalid graph can have a circle
        node = parents.get(node)
        if node in rooms:
            return rooms[node]
    return ""


def virtualhome(data: Any) -> Records:
    """Return the objects of an environment graph with their rooms."""
    nodes = {node["id"]: node for node in data["nodes"]}
    rooms = {
        key: f"{node['class_name']}_{key}"
        for key, node in nodes.items()
        if node.get("category") == "Rooms"
    }
    links = [edge for edge in data.get("edges") or () if edge["relation_type"] in ("INSIDE", "ON")]
    inside = {edge["from_id"]: edge["to_id"] for edge in links}
    inside |= {edge["from_id"]: edge["to_id"] for edge in links if edge["to_id"] in rooms}
    return [
        {**node, "room": _room(key, inside, rooms) or _around(node, nodes, rooms)}
        for key, node in nodes.items()
        if key not in rooms
    ]


def _around(node: Any, nodes: Mapping[Any, Any], rooms: Mapping[Any, str]) -> str:
    """Return the name of the room whose box contains the centre of an object, or ""."""
    centre = node["bounding_box"]["center"]
    for key, name in rooms.items():
        box = nodes[key].get("bounding_box") or {"center": centre, "size": (-1,) * 3}
        parts = zip(centre, box["center"], box["size"], strict=True)
        if all(abs(at - middle) <= side / 2 for at, middle, side in parts):
            return name
    return ""


# ---------------------------------------------------------------------------- planning scenes

_SIDES: Final[
    dict[int, Callable[[list[float]], list[float]]]
] = {  # type of a shape_msgs/SolidPrimitive: extents in x, y and z
    1: lambda box: list(box[:3]),
    2: lambda sphere: [2 * sphere[0]] * 3,
    3: lambda cylinder: [2 * cylinder[1], 2 * cylinder[1], cylinder[0]],
    4: lambda cone: [2 * cone[1], 2 * cone[1], cone[0]],
}
_ORIGIN: Final[Vector] = (0.0, 0.0, 0.0)


def moveit(data: Any) -> Records:
    """Return the collision objects of a planning scene, also those that the robot holds."""
    scene = take(data, "scene") or data
    objects = list(items(take(take(scene, "world") or scene, "collision_objects"), "objects"))
    state = take(scene, "robot_state", "attached_collision_objects")
    objects += [take(entry, "object") for entry in items(state, "attached_collision_objects")]
    return [
        {
            "label": take(thing, "type", "key") or take(thing, "id"),
            "id": take(thing, "id"),
            "frame_id": take(thing, "header", "frame_id") or "",
            "operation": take(thing, "operation") in (1, b"\x01"),  # rclpy represents a byte so
            **_collision_box(thing),
        }
        for thing in objects
    ]


def _collision_box(thing: Any) -> dict[str, Any]:
    """Return the box around the shapes of an object, in the object's frame."""
    at, turn = _pose(take(thing, "pose"))
    points = []
    for names in (("primitives", "primitive_poses"), ("meshes", "mesh_poses")):
        solids, poses = (items(take(thing, name), name) for name in names)
        for index, solid in enumerate(solids):
            shape_at, shape_turn = _pose(poses[index] if index < len(poses) else None)
            if len(solids) == 1 and names[0] == "primitives":  # its own axes fit it best
                at, turn = _sum(at, rotated(shape_at, turn)), product(turn, shape_turn)
                shape_at, shape_turn = _ORIGIN, NO_TURN
            points += [_sum(shape_at, rotated(point, shape_turn)) for point in _points(solid)]
    if not points:
        return {"position": at, "size": None, "orientation": turn}
    spans = [(min(values), max(values)) for values in zip(*points, strict=True)]
    middle = [(low + high) / 2 for low, high in spans]
    size = [high - low for low, high in spans]
    return {"position": _sum(at, rotated(middle, turn)), "size": size, "orientation": turn}


def _points(solid: Any) -> list[Vector]:
    """Return the vertices of a mesh, or the corners of the box around a primitive."""
    if (vertices := take(solid, "vertices")) is not None:
        return [(take(one, "x"), take(one, "y"), take(one, "z")) for one in vertices]
    sides = _SIDES[take(solid, "type")](take(solid, "dimensions"))
    x, y, z = ((-side / 2, side / 2) for side in sides)
    return [*itertools.product(x, y, z)]


def _pose(pose: Any) -> tuple[Vector, Quaternion]:
    at = numbers(take(pose, "position"), "xyz")
    turn = numbers(take(pose, "orientation"), "xyzw")
    length = math.hypot(*turn.values()) if turn else 0.0
    place = (at["x"], at["y"], at["z"]) if at else _ORIGIN
    if turn is None or not length > 0:
        return place, NO_TURN
    x, y, z, w = (value / length for value in turn.values())
    return place, (x, y, z, w)


def _sum(a: Sequence[float], b: Sequence[float]) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


SPECIAL: Final[dict[str, Callable[[Any], Records]]] = {
    one.__name__: one for one in (hydra, virtualhome, moveit)
}
"""The functions by the names in the table."""
