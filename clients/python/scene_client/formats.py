"""Scenes from the data of files and messages: a table of formats, and requests as they are.

    fields = from_data(json.loads(results[0].to_json()))  # Ultralytics
    answer = client.missing(**fields)

docs/clients.md lists the formats, and what each field becomes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import islice
from typing import Any, Final, NamedTuple, TypeVar

from scene_client import image_formats, world_formats
from scene_client.image_formats import Lines, Parts
from scene_client.image_plane import left_pairs
from scene_client.ros_fields import REMEDY, LabelMap, MessageError, read_label_map, unwrapped
from scene_client.sightings import Message
from scene_client.vision_msgs import MAX_OBJECTS, SceneFields, from_message, is_message
from scene_client.world_formats import Table

T = TypeVar("T")


class Format(NamedTuple):
    """A format of files.

    Attributes:
        name: name in messages.
        matches: function that returns whether data has this format.
        read: function that converts the data of one scene.
        parts: function that returns the data of each scene by its name.
    """

    name: str
    matches: Callable[[Any], bool]
    read: Callable[[Any], Message]
    parts: Callable[[Any], Parts] = lambda data: {"": data}


FORMATS: Final = (
    Format("CVAT", image_formats.is_cvat, image_formats.read_cvat, image_formats.cvat_parts),
    Format(
        "CSV", lambda data: isinstance(data, Table), world_formats.read_table,
        world_formats.table_parts,
    ),
    Format("YOLO", lambda data: isinstance(data, Lines), image_formats.read_yolo),
    Format("COCO", image_formats.is_coco, image_formats.read_coco, image_formats.coco_parts),
    Format(
        "Label Studio", image_formats.is_label_studio, image_formats.read_label_studio,
        image_formats.label_studio_parts,
    ),
    Format(
        "Roboflow", image_formats.is_roboflow, image_formats.read_roboflow,
        image_formats.roboflow_parts,
    ),
    Format(
        "Ultralytics", image_formats.is_ultralytics, image_formats.read_ultralytics,
        image_formats.ultralytics_parts,
    ),
    Format("AI2-THOR", world_formats.is_ai2thor, world_formats.read_ai2thor),
    Format("Hydra", world_formats.is_hydra, world_formats.read_hydra, world_formats.hydra_parts),
    Format("ScanNet", world_formats.is_scannet, world_formats.read_scannet),
    Format("MoveIt", world_formats.is_moveit, world_formats.read_moveit),
)  # fmt: skip


Reader = Callable[[], SceneFields]
"""A function that converts one scene. It raises `MessageError`."""


def from_data(data: Any, label_map: LabelMap | None = None, *, scene: object = None) -> SceneFields:
    """Convert a message, or the parsed contents of a file, to the fields of a request.

    Args:
        data: a ROS message, or a JSON value in one of the `FORMATS`, a request, a list of objects,
            or a scene of the training format.
        label_map: labels of numeric class ids; see `read_label_map`.
        scene: name of the scene (id of an image or task, number of a frame, name of a room), if the
            data has several.

    Raises:
        MessageError: the data has an unknown format, has several scenes, or lacks labels.
    """
    return chosen(scenes_in(data, label_map), scene)()


def scenes_in(data: Any, label_map: LabelMap | None = None) -> dict[str, Reader]:
    """Return the readers of all scenes in data by the names of the scenes; see `from_data`.

    The name of an only scene may be empty.

    Raises:
        MessageError: the data has an unknown format, or contains no objects.
    """
    data = unwrapped(data)
    if is_message(data):
        return {"": partial(from_message, data, label_map)}
    form = next((form for form in FORMATS if form.matches(data)), None)
    if form is None:
        return {"": partial(_with_labels, data, label_map)}
    parts: Parts = _guarded(form.name, form.parts, data)
    if not parts:
        raise MessageError("the file contains no objects")
    return {name: partial(_converted, form, part, label_map) for name, part in parts.items()}


def chosen(scenes: Mapping[str, Reader], scene: object, file: str = "") -> Reader:
    """Return the reader of the scene with a name, or of the only scene.

    ``file`` is the name of the file for the text of errors.

    Raises:
        MessageError: there is no such scene, or there are several scenes and ``scene`` is None.
    """
    if scene is None and len(scenes) == 1:
        return next(iter(scenes.values()))
    if scene is not None and str(scene) in scenes:
        return scenes[str(scene)]
    if [*scenes] == [""]:
        raise MessageError(f"the file has one scene, and no scene {scene}")
    names = ", ".join(islice(scenes, 5)) + (", …" if len(scenes) > 5 else "")
    first = next(iter(scenes), "")
    how = f"{file}:{first}" if file else f"scene={first!r}"
    problem = "" if scene is None else f"no scene {scene}; it has "
    raise MessageError(
        f"the file has {problem}{len(scenes)} scenes ({names}): choose one, such as {how}"
    )


def _converted(form: Format, part: Any, label_map: LabelMap | None) -> SceneFields:
    message = _guarded(form.name, form.read, part)
    fields = from_message(vars(message), label_map, viewpoint=message.viewpoint)
    fields.notes = message.notes + fields.notes
    return fields


def _guarded(name: str, read: Callable[[Any], T], data: Any) -> T:
    """Return the result of a reader. A wrong value in the data becomes a `MessageError`."""
    try:
        return read(data)
    except MessageError:
        raise
    except (LookupError, AttributeError, TypeError, ValueError, OverflowError, RecursionError):
        problem = f"looks like {name}, but a field is missing or has a wrong type"
        raise MessageError(f"the file {problem}; docs/clients.md describes the format") from None


# ------------------------------------------------------------------------------------ requests

# Fields of the training format that a request does not have.
_TRAINING: Final = frozenset(
    ("scene_id", "source", "group", "viewer_frame", "counts", "false_relations", "confirmed")
)
_TRAINING_OBJECT: Final = frozenset(("box2d", "count"))


def _request(data: Any) -> dict[str, Any]:
    if isinstance(data, list) and all(
        isinstance(thing, str) or (isinstance(thing, dict) and "label" in thing) for thing in data
    ):
        return {"objects": data}
    if not isinstance(data, dict) or not isinstance(data.get("objects"), list):
        raise MessageError(
            f"{_kind(data)} is neither a request with a list of objects nor a known format; "
            "docs/clients.md lists the formats"
        )
    things = [thing for thing in data["objects"] if isinstance(thing, dict)]
    is_training = _TRAINING & data.keys() or any(
        type(thing.get("id")) is int or _TRAINING_OBJECT & thing.keys() for thing in things
    )
    if not is_training:
        return data
    try:
        return _of_training(data, things)
    except MessageError:
        raise
    except (LookupError, AttributeError, TypeError, ValueError):
        raise MessageError("this is not a scene of the training format") from None


def _kind(data: Any) -> str:
    if isinstance(data, dict):
        names = ", ".join(str(name)[:40] for name in islice(data, 5))
        return f"a JSON object with the fields {names}" if names else "an empty JSON object"
    return "a JSON list" if isinstance(data, list) else "a JSON value"


def _of_training(scene: Mapping[str, Any], things: list[dict[str, Any]]) -> dict[str, Any]:
    # The service accepts most of these scenes too, but its answers would name an object by its
    # number. Here, its id is its label, followed by its number if several objects have the label.
    counts = Counter(thing["label"] for thing in things)
    names = {
        thing["id"]: thing["label"] + (f"_{thing['id']}" if counts[thing["label"]] > 1 else "")
        for thing in things
        if type(thing.get("id")) is int
    }
    if len({*names.values()}) < sum(type(thing.get("id")) is int for thing in things):
        raise ValueError("two objects have the same id")
    objects = []
    for thing in scene["objects"]:
        if isinstance(thing, dict):
            thing = {
                name: _named(value, names) if name in ("id", "supported_by") else value
                for name, value in thing.items()
                if name not in _TRAINING_OBJECT and value is not None
            }
        objects.append(thing)
    fields = {
        name: value
        for name, value in scene.items()
        if name not in _TRAINING and name != "relations" and value is not None
    }
    fields["objects"] = objects
    has_poses = all("position" in thing for thing in things) and len(things) == len(objects)
    if scene.get("relations") and not has_poses:
        fields["relations"] = [_relation(one, names) for one in scene["relations"]]
    elif relations := _image_relations(scene["objects"], objects):
        fields["relations"] = relations
    is_fixed = not scene.get("viewer_frame") and ("scene_id" in scene or "viewer_frame" in scene)
    if is_fixed and "frame_id" not in fields:
        fields["frame_id"] = "map"
    return fields


def _relation(relation: Any, names: Mapping[Any, str]) -> list[Any]:
    if isinstance(relation, dict):
        relation = [relation[end] for end in ("subject", "relation", "object")]
    subject, kind, other = relation
    return [_named(subject, names), kind, _named(other, names)]


def _named(value: Any, names: Mapping[Any, str]) -> Any:
    return names.get(value, value) if type(value) is int else value


def _image_relations(annotated: list[Any], objects: list[Any]) -> list[list[str]]:
    """Return the relations left between boxes in an image, if all objects have ids and boxes."""
    boxes = [thing.get("box2d") if isinstance(thing, dict) else None for thing in annotated]
    if any("position" in thing or "id" not in thing for thing in objects) or None in boxes:
        return []
    if len(boxes) > MAX_OBJECTS:  # the time grows with the square of their number
        raise MessageError(f"the scene has more than {MAX_OBJECTS} boxes in an image")
    ids = [thing["id"] for thing in objects]
    pairs = sorted(left_pairs(boxes, range(len(boxes))))
    return [[ids[first], "left", ids[second]] for first, second in pairs]


def _with_labels(data: Any, label_map: LabelMap | None) -> SceneFields:
    scene, labels, objects = _request(data), read_label_map(label_map), []
    for thing in scene["objects"]:
        label = thing.get("label") if isinstance(thing, dict) else thing
        if isinstance(label, str | int) and str(label).isdecimal():
            label = labels.get(str(label))
            if label is None:
                raise MessageError(f"an object has a class id instead of a label: {REMEDY}")
            thing = {**thing, "label": label} if isinstance(thing, dict) else label
        objects.append(thing)
    return SceneFields(scene | {"objects": objects})
