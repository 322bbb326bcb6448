"""Scenes from the data of files and messages: the formats of the table, and requests as they are.

    fields = from_data(json.loads(results[0].to_json()))  # Ultralytics
    answer = client.missing(**fields)

docs/clients.md lists the formats, and what each field becomes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import islice
from typing import Any, Final, TypeVar

from scene_client.image_plane import left_pairs
from scene_client.parsing import Xml, Yaml
from scene_client.paths import LOOKED_AT, leads
from scene_client.records import (
    FIELDS,
    FORMATS,
    LABEL_MAP,
    RECORDS,
    Form,
    Record,
    Rows,
    names_scene,
    read,
    records_of,
    require_records,
)
from scene_client.ros_fields import REMEDY, LabelMap, MessageError, read_label_map, short, unwrapped
from scene_client.schemas import Detection
from scene_client.sightings import MAX_OBJECTS, SceneFields, to_fields
from scene_client.special_formats import SPECIAL, rows_of
from scene_client.vision_msgs import form_of, from_message

T = TypeVar("T")

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
    if isinstance(data, list | dict):
        require_records(len(data))
    form = data.form if isinstance(data, Rows) else None
    if form in (None, RECORDS):
        form = form_of(data)
    form = form or _form_of_records(data)
    if form is None and _is_label_map(data):
        form = LABEL_MAP
    if form is None and _has_rooms(data):
        return {room: partial(_with_labels, {"objects": data[room]}, label_map) for room in data}
    if form is None and isinstance(data, list) and data and form_of(data[0]) is not None:
        return {str(n): partial(from_data, one, label_map) for n, one in enumerate(data, 1)}
    if form is None:
        return {"": partial(_with_labels, _request(data), label_map)}
    if "use" in form:
        raise MessageError(f"this is {form['name']}: {form['use']}")
    name, whole = form["name"], data
    if "is_solid" in form:
        return {"": partial(from_message, data, label_map)}
    if "code" in form:
        data = _guarded(name, SPECIAL[form["code"]], data)
    elif "columns" in form:
        data = _guarded(name, partial(rows_of, form["columns"]), data)
    scenes = _guarded(name, partial(records_of, form), data)
    if not scenes:
        raise MessageError(f"the file contains no objects; it looks like {name}")
    return {
        scene: partial(_converted, form, records, whole, label_map)
        for scene, records in scenes.items()
    }


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
        if str(scene) == "1":
            return scenes[""]
        raise MessageError(f"the file has one scene, and no scene {scene}")
    names = ", ".join(short(name)[:24] for name in islice(scenes, 5)) + ", …" * (len(scenes) > 5)
    first = next((name for name in scenes if name and name == short(name)), "")
    how = f", such as {file}:{first}" if file else f", such as scene={first!r}"
    problem = "" if scene is None else f"no scene {short(str(scene))}; it has "
    raise MessageError(
        f"the file has {problem}{len(scenes)} scenes ({names}): choose one{how if first else ''}"
    )


def _has_rooms(data: Any) -> bool:
    return (
        isinstance(data, dict)
        and len(data) > 1
        and all(
            isinstance(labels, list) and labels and all(isinstance(label, str) for label in labels)
            for labels in data.values()
        )
    )


def _is_label_map(data: Any) -> bool:
    return (
        isinstance(data, dict)
        and bool(data)
        and all(str(key).isdecimal() and isinstance(label, str) for key, label in data.items())
    )


_DEEPEST: Final = 3  # lists and objects around records
_OWN_NAME: Final = ["^.frame_id|^.frame|^.frame_number|^.image|^.file_name|^.filename", "^.@"]


def _form_of_records(data: Any) -> Form | None:
    """Return the format of the only list of records in data, or of the only lists of one kind."""
    if isinstance(data, Rows):
        return RECORDS
    paths = _paths_of_records(data, _DEEPEST)
    if len(paths) != 1:
        return None
    (path,) = paths
    is_several = path.count("[]") + path.count("*") > 1
    return RECORDS | {"items": path} | ({"scene": _OWN_NAME} if is_several else {})


def _paths_of_records(data: Any, depth: int, name: str = "") -> set[str]:
    if are_records(data, name):
        return {"[]"}
    inner: list[tuple[str, set[str]]] = []
    if isinstance(data, list) and depth:
        inner = [("[]", _paths_of_records(one, depth - 1)) for one in data[:LOOKED_AT]]
    elif isinstance(data, dict) and depth:
        inner = [(key, _paths_of_records(one, depth - 1, key)) for key, one in data.items()]
        if len(inner) > 1 and all(paths == {"[]"} for _, paths in inner):  # by images or rooms
            return {"*.[]"}
    return {f"{step}.{path}" for step, paths in inner for path in paths}


def are_records(data: Any, name: str = "") -> bool:
    """Return whether data is a list of objects of a detector, and not those of a request.

    ``name`` is the name of the list, which is `objects` in a request.
    """
    if not isinstance(data, list) or not data or not all(isinstance(one, dict) for one in data):
        return False
    if name not in ("", "objects") and "label" in data[0]:
        return True
    first = Record(((None, data), (0, data[0])))
    if first.first("label") is None or data[0].keys() <= _REQUESTED:
        return False
    names = {*FIELDS["position"], *FIELDS["score"], *(name for _, name in FIELDS["image"])}
    if "label" in data[0]:
        # The object can be one of a request, with a misspelt field.
        names -= {"position", "confidence"}
        others = data[0].keys() - _REQUESTED if name != "objects" else set()
        if others & {*first.unread()} or any(names_scene(one) is not None for one in others):
            return True
    return any(first.take(name) is not None for name in (*FIELDS["span"], *names))


def _converted(
    form: Form, records: list[Record], data: Any, label_map: LabelMap | None
) -> SceneFields:
    seen = _guarded(form["name"], lambda records: read(form, records, data), records)
    return to_fields(seen, read_label_map(label_map))


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
_REQUESTED: Final = _TRAINING_OBJECT | Detection.model_fields.keys()


def _request(data: Any) -> dict[str, Any]:
    if isinstance(data, list) and all(
        isinstance(thing, str) or (isinstance(thing, dict) and "label" in thing) for thing in data
    ):
        return {"objects": data}
    if not isinstance(data, dict) or not isinstance(data.get("objects"), list):
        raise MessageError(f"this is {_kind(data)}, and no known format{_nearest(data)}")
    things = [thing for thing in data["objects"] if isinstance(thing, dict)]
    if things and not any("label" in thing for thing in things):
        kind = _kind(things)
        raise MessageError(f"this is {kind} and no label, and no known format{_nearest(data)}")
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
    if isinstance(data, Xml):
        return f"XML with the root <{short(next(iter(data)))}>"
    is_list = isinstance(data, list)
    one, kind = (data[0], "list of objects") if is_list and data else (data, "object")
    if not isinstance(one, dict):
        return "a JSON list" if is_list else "a JSON value"
    names = ", ".join(short(str(name))[:24] for name in islice(one, 5))
    kind = "YAML" if isinstance(data, Yaml) else f"a JSON {kind}"
    return f"{kind} with the fields {names}" if names else f"{kind} without fields"


def _signs(form: Form, data: Any) -> float:
    """Return which part of the paths in `has` leads to a value."""
    paths = form.get("has", ())
    if not paths or (paths[0].startswith("[]") and not isinstance(data, list)):
        return 0.0
    return sum(leads(path, data) for path in paths) / max(len(paths), 1)


def _nearest(data: Any) -> str:
    """Return the name of the format with the most paths in data, and a path that is missing."""
    form = max(FORMATS, key=lambda form: _signs(form, data))
    if not _signs(form, data):
        return ": send a list of objects with the field label, or a format of docs/clients.md"
    lacking = next(path for path in form["has"] if not leads(path, data))
    return f"; the nearest is {form['name']}, which also has {lacking.partition('|')[0][:60]}"


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


def _with_labels(scene: dict[str, Any], label_map: LabelMap | None) -> SceneFields:
    labels, objects = read_label_map(label_map), []
    for thing in scene["objects"]:
        label = thing.get("label") if isinstance(thing, dict) else thing
        if isinstance(label, str | int) and str(label).isdecimal():
            label = labels.get(str(label))
            if label is None:
                raise MessageError(f"an object has a class id instead of a label: {REMEDY}")
            thing = {**thing, "label": label} if isinstance(thing, dict) else label
        objects.append(thing)
    return SceneFields(scene | {"objects": objects})
