"""Readers of formats with poses: tables (CSV), AI2-THOR, Hydra, ScanNet and MoveIt.

The functions have the same names and errors as those of `image_formats`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, Final

from scene_client.frames import Quaternion, Vector
from scene_client.image_formats import Parts, are_dicts, has_list
from scene_client.ros_fields import MessageError, items, numbers, take, text
from scene_client.sightings import (
    NO_TURN,
    Message,
    box_between,
    detection,
    excluded,
    solid_box,
    turn_of,
    vector,
)

_FIXED: Final = {"frame_id": "map"}
"""Header of a scene whose axes do not depend on a viewer."""

# ----------------------------------------------------------------------------------------- CSV


class Table(list[dict[str, str]]):
    """Rows of a CSV file, with the names of the columns in lower case."""


LABEL_COLUMNS: Final = ("label", "name", "class_name", "class", "class_id")
_IMAGE_COLUMNS: Final = ("image", "image_id", "filename", "file_name", "frame")
_CORNERS: Final = ("xmin", "ymin", "xmax", "ymax")
_NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")


def table_parts(rows: Table) -> Parts:
    """Return the rows of each image, or all rows if no column names an image."""
    column = next((name for name in _IMAGE_COLUMNS if name in rows[0]), None) if rows else None
    parts: Parts = {}
    for number_, row in enumerate(rows, 2):
        parts.setdefault(row[column] if column else "", []).append((number_, row))
    return parts


def read_table(part: Any) -> Message:
    """Convert rows: label, x, y, z, sx, sy, sz, yaw, id, confidence; or xmin, ymin, xmax, ymax."""
    return Message([_row(line, row) for line, row in part])


def _row(line: int, row: Mapping[str, str]) -> dict[str, Any]:
    def value(*names: str) -> Any:
        cell = next((row[name] for name in names if row.get(name)), "")
        if cell and not _NUMBER.fullmatch(cell) and cell.lower() not in ("nan", "null", "none"):
            raise MessageError(f"line {line}, column {names[0]}: {cell[:40]!r} is not a number")
        return float(cell) if _NUMBER.fullmatch(cell) else None

    label = next((row[name] for name in LABEL_COLUMNS if row.get(name)), "")
    score = value("confidence", "score") if row.get("confidence") or row.get("score") else 1.0
    box: dict[str, Any] = {}
    if any(row.get(axis) for axis in "xyz"):
        sizes = [value(f"s{axis}") for axis in "xyz"]
        size = None if None in sizes else sizes
        box = solid_box([value(axis) for axis in "xyz"], size, yaw=value("yaw"))
    elif any(row.get(name) for name in _CORNERS):
        left, top, right, bottom = map(value, _CORNERS)
        box = box_between((left, right), (top, bottom))
    return detection(label, score, row.get("id", ""), **box)


# ------------------------------------------------------------------------------------- AI2-THOR


def is_ai2thor(data: Any) -> bool:
    """Return whether the data is the metadata of an event of AI2-THOR."""
    return are_dicts(_thor(data).get("objects"), "objectType", "position")


def read_ai2thor(data: Any) -> Message:
    """Convert the visible objects. The world of Unity is left-handed, and its y axis points up."""
    scene = _thor(data)
    visible = [thing for thing in scene["objects"] if thing.get("visible") is not False]
    agent = scene.get("agent") or {}
    viewpoint = None
    if "position" in agent and "rotation" in agent:
        x, y, _ = _from_unity(agent["position"])
        viewpoint = {"x": x, "y": y, "yaw": -math.radians(agent["rotation"]["y"])}
    return Message(
        [
            detection(thing["objectType"], 1.0, thing.get("objectId", ""), **_thor_box(thing))
            for thing in visible
        ],
        _FIXED,
        viewpoint,
        excluded(len(scene["objects"]) - len(visible), "objects that are not visible"),
    )


def _thor(data: Any) -> Mapping[str, Any]:
    """Return the metadata, which may be a part of the whole event."""
    inner = data.get("metadata", data) if isinstance(data, dict) else {}
    return inner if isinstance(inner, dict) else {}


def _from_unity(values: Mapping[str, float]) -> Vector:
    """Return a point with x forward, y left and z up."""
    return values["z"], -values["x"], values["y"]


def _thor_box(thing: Mapping[str, Any]) -> dict[str, Any]:
    box = thing.get("axisAlignedBoundingBox") or {}
    if not box.get("size"):
        turn = turn_of(-math.radians((thing.get("rotation") or {}).get("y", 0)))
        return solid_box(_from_unity(thing["position"]), None, turn)
    size = [abs(side) for side in _from_unity(box["size"])]
    return solid_box(_from_unity(box["center"]), size)


# ---------------------------------------------------------------------------------------- Hydra


def is_hydra(data: Any) -> bool:
    """Return whether the data is a scene graph of Hydra (Spark-DSG)."""
    return (
        has_list(data, "edges")
        and has_list(data, "nodes")
        and are_dicts(data["nodes"][:1], "attributes")
    )


def hydra_parts(data: Any) -> Parts:
    """Return the objects of each room. An object is in the room of its place."""
    nodes = {node["id"]: node for node in data["nodes"]}
    parents: dict[Any, Any] = {}
    for edge in data["edges"]:
        pair = [nodes[edge[name]] for name in ("source", "target") if edge[name] in nodes]
        if len(pair) == 2 and pair[0]["layer"] != pair[1]["layer"]:
            low, high = sorted(pair, key=lambda node: node["layer"])
            parents[low["id"]] = high["id"]
    objects = [node for node in data["nodes"] if "Object" in str(node["attributes"].get("type"))]
    parts: Parts = {}
    for node in objects:
        room = _room_of(node["id"], parents, nodes)
        parts.setdefault(room, (data, []))[1].append(node)
    return parts


def read_hydra(part: Any) -> Message:
    """Convert the objects of one room. The graph may contain the names of the classes."""
    data, nodes = part
    spaces = (data.get("metadata") or {}).get("labelspaces") or {}
    names = next((spaces[key] for key in sorted(spaces) if key.startswith("_l2")), None)
    labels = dict(names) if names else {}
    detections = []
    for node in nodes:
        thing = node["attributes"]
        box = thing.get("bounding_box") or {}
        centre, size, turn = box.get("world_P_center"), box.get("dimensions"), NO_TURN
        if size is None and "max" in box:  # before version 1.0.3
            size = [a - b for a, b in zip(vector(box["max"]), vector(box["min"]), strict=True)]
        if rotation := numbers(box.get("world_R_center"), "xyzw"):
            turn = tuple(rotation.values())  # type: ignore[assignment]
        if centre is None or not any(size or ()):
            centre, size = thing.get("position"), None
        label = labels.get(thing["semantic_label"], thing["semantic_label"])
        solid = solid_box(vector(centre), vector(size), turn)
        detections.append(detection(label, 1.0, thing.get("name", ""), **solid))
    return Message(detections, _FIXED)


def _room_of(node: Any, parents: Mapping[Any, Any], nodes: Mapping[Any, Any]) -> str:
    """Return the name of the room that contains a node, or "" without a room."""
    for _ in range(8):  # an invalid graph can have a circle
        node = parents.get(node)
        if node is None:
            return ""
        attributes = nodes[node]["attributes"]
        if "Room" in str(attributes.get("type")):
            return str(attributes.get("name") or node)
    return ""


# -------------------------------------------------------------------------------------- ScanNet


def is_scannet(data: Any) -> bool:
    """Return whether the data is an aggregation of ScanNet, or the segments of 3RScan."""
    return has_list(data, "segGroups")


def read_scannet(data: Any) -> Message:
    """Convert the objects of a scan. Only 3RScan has boxes."""
    return Message(
        [
            detection(
                group["label"],
                1.0,
                f"{text(group['label'])}_{text(group.get('objectId', group.get('id')))}",
                **({} if group.get("obb") is None else _upright(**group["obb"])),
            )
            for group in data["segGroups"]
        ],
        _FIXED,
    )


def _upright(
    centroid: Any, axesLengths: Any, normalizedAxes: Sequence[float], **_: Any
) -> dict[str, Any]:
    """Return a box that stands on the side whose axis is nearest to the vertical."""
    axes = [normalizedAxes[first : first + 3] for first in (0, 3, 6)]
    up = max(range(3), key=lambda axis: abs(axes[axis][2]))
    across, along = (axis for axis in range(3) if axis != up)
    size = [axesLengths[axis] for axis in (across, along, up)]
    return solid_box(centroid, size, turn_of(math.atan2(axes[across][1], axes[across][0])))


# --------------------------------------------------------------------------------------- MoveIt

_SIDES: Final[
    dict[int, Callable[[list[float]], list[float]]]
] = {  # type of a shape_msgs/SolidPrimitive: extents in x, y and z
    1: lambda box: list(box[:3]),
    2: lambda sphere: [2 * sphere[0]] * 3,
    3: lambda cylinder: [2 * cylinder[1], 2 * cylinder[1], cylinder[0]],
    4: lambda cone: [2 * cone[1], 2 * cone[1], cone[0]],
}
_REMOVE: Final = (1, b"\x01")  # operation of a CollisionObject, also as rclpy represents a byte
_ORIGIN: Final[Vector] = (0.0, 0.0, 0.0)


def is_moveit(data: Any) -> bool:
    """Return whether the data is a planning scene of MoveIt, or a part with collision objects."""
    return _collision_objects(data) is not None


def read_moveit(data: Any) -> Message:
    """Convert the collision objects, also those that the robot holds."""
    objects = list(_collision_objects(data) or ())
    state = take(take(data, "scene") or data, "robot_state", "attached_collision_objects")
    objects += [take(entry, "object") for entry in items(state, "attached_collision_objects")]
    kept = [thing for thing in objects if take(thing, "operation") not in _REMOVE]
    return Message(
        [
            detection(
                take(thing, "type", "key") or take(thing, "id"),
                1.0,
                take(thing, "id"),
                frame=take(thing, "header", "frame_id") or "",
                **_collision_box(thing),
            )
            for thing in kept
        ],
        notes=excluded(len(objects) - len(kept), "removed objects"),
    )


def _collision_objects(data: Any) -> Sequence[Any] | None:
    scene = take(data, "scene") or data
    objects = take(take(scene, "world") or scene, "collision_objects")
    return objects if isinstance(objects, list | tuple) else None


def _collision_box(thing: Any) -> dict[str, Any]:
    """Return the box of a shape, or the box around several shapes in the object's frame."""
    at, turn = _pose(take(thing, "pose"))
    shapes = []
    for names in (("primitives", "primitive_poses"), ("meshes", "mesh_poses")):
        solids, poses = (items(take(thing, name), name) for name in names)
        for index, solid in enumerate(solids):
            shapes.append((*_pose(poses[index] if index < len(poses) else None), *_extent(solid)))
    if not shapes:
        return solid_box(at, None, turn)
    if len(shapes) == 1:
        shape_at, shape_turn, middle, size = shapes[0]
        inner = _sum(shape_at, _turned(shape_turn, middle))
        centre = _sum(at, _turned(turn, inner))
        return solid_box(centre, size, _product(turn, shape_turn))
    corners = [
        _sum(shape_at, _turned(shape_turn, _sum(middle, tuple(s * side / 2 for s, side in pairs))))
        for shape_at, shape_turn, middle, size in shapes
        for pairs in (tuple(zip(signs, size, strict=True)) for signs in product((-1, 1), repeat=3))
    ]
    low, high = (tuple(map(choose, zip(*corners, strict=True))) for choose in (min, max))
    middle = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
    size = [b - a for a, b in zip(low, high, strict=True)]
    return solid_box(_sum(at, _turned(turn, middle)), size, turn)


def _extent(solid: Any) -> tuple[Vector, list[float]]:
    if (vertices := take(solid, "vertices")) is None:
        return _ORIGIN, _SIDES[take(solid, "type")](take(solid, "dimensions"))
    spans = [[take(vertex, axis) for vertex in vertices] for axis in "xyz"]
    x, y, z = ((min(span) + max(span)) / 2 for span in spans)
    return (x, y, z), [max(span) - min(span) for span in spans]


def _pose(pose: Any) -> tuple[Vector, Quaternion]:
    at = numbers(take(pose, "position"), "xyz")
    turn = numbers(take(pose, "orientation"), "xyzw")
    length = math.hypot(*turn.values()) if turn else 0.0
    if turn is None or not length > 0:
        return _vector(at), NO_TURN
    x, y, z, w = (value / length for value in turn.values())
    return _vector(at), (x, y, z, w)


def _vector(values: Mapping[str, float] | None) -> Vector:
    return (values["x"], values["y"], values["z"]) if values else _ORIGIN


def _sum(a: Sequence[float], b: Sequence[float]) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the rotation by q and then by p."""
    a, b, c, d = p
    x, y, z, w = q
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def _turned(turn: Quaternion, point: Sequence[float]) -> Vector:
    x, y, z, w = turn
    a, b, c, _ = _product(_product(turn, (point[0], point[1], point[2], 0.0)), (-x, -y, -z, w))
    return a, b, c
