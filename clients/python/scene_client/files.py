"""Reading of files with scenes, for `scene_client.from_file` and for the command ``scene``."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final

from scene_client.formats import Reader, are_records, chosen, from_data, scenes_in
from scene_client.home_state import FORMAT, state_of
from scene_client.parsing import Parts, data_of, json_value, parsed, text_of
from scene_client.ros_fields import WELL_KNOWN, LabelMap, MessageError, read_label_map
from scene_client.sightings import SceneFields
from scene_client.untrusted import read_regular

MAX_FILE: Final = 64 * 2**20
"""Maximum size of a scene file in bytes. The service has the same upper limit for a body."""

# A file, and the name of one of its scenes. Some of these kinds of files are refused with a reason.
_FILE: Final = re.compile(
    r"(?P<file>.+\.(json|jsonl|ndjson|csv|tsv|txt|xml|ya?ml|mcap|zip|gz))(:(?P<scene>.+))?",
    re.DOTALL,
)
_PATH_STARTS: Final = (".", "~", os.sep)


def is_file(argument: str) -> bool:
    """Return whether an argument of the command is a file. Labels such as sofa/couch are not."""
    if argument == "-" or _FILE.fullmatch(argument) or Path(argument).is_file():
        return True
    is_path = argument.startswith(_PATH_STARTS) and os.sep in argument
    return is_path or _split(argument)[1] is not None


def _split(name: str) -> tuple[str, str | None]:
    """Return the name of a file and the name of a scene in it, or None."""
    if Path(name).exists():
        return name, None
    if (parts := _FILE.fullmatch(name)) is not None:
        return parts["file"], parts["scene"]
    file, _, scene = name.partition(":")
    return (file, scene) if scene and Path(file).is_file() else (name, None)


def from_file(
    path: str | os.PathLike[str], label_map: LabelMap | None = None, *, scene: object = None
) -> SceneFields:
    """Read a file with a scene and return the fields of a request.

    Args:
        path: name of a file in a format of docs/clients.md; ``NAME:SCENE`` for one scene of a file
            with several; or ``-`` for standard input.
        label_map: labels of numeric class ids: a value for `read_label_map`, or the name of a file
            with the labels.
        scene: line of a file with one scene per line, id of an image or task, number of a frame, or
            name of a room. Needed only if the file has several scenes.

    Raises:
        MessageError: the file cannot be read, has an unknown format, has several scenes, or lacks
            labels.
    """
    name, labels = os.fspath(path), label_map
    if isinstance(labels, str):
        labels = label_map_of(labels)
    if scene is None:
        name, scene = _split(name)
    content = _bytes(name)
    try:
        return chosen(scenes_of(content, labels), scene, name)()
    except MessageError as error:
        raise MessageError(f"{name}: {error}") from None


def scenes_of(content: bytes, label_map: LabelMap | None = None) -> dict[str, Reader]:
    """Return the readers of all scenes in the content of a file by the names of the scenes.

    ``label_map`` has the labels of numeric class ids; see `read_label_map`.

    Raises:
        MessageError: the content has an unknown format, or contains no objects.
    """
    data = parsed(content)
    if not isinstance(data, Parts):
        return scenes_in(data, label_map)
    if not data:
        raise MessageError("the file contains no messages that can be decoded")
    first = next(iter(data.values()))()
    if are_records([first]):  # one object a line
        return scenes_in([part() for part in data.values()], label_map)
    topics = {name.rpartition(":")[0]: part for name, part in reversed(data.items())}
    usable = [topic for topic, part in topics.items() if not topic or _has_scene(part)]
    if not usable:
        some = ", ".join(islice(topics, 5))
        raise MessageError(f"this is a recording without detections; its topics are {some}")
    names = {name: name.rpartition(":") for name in data}
    return {
        number if len(usable) == 1 else name: partial(_read_part, data[name], label_map)
        for name, (topic, _, number) in names.items()
        if topic in usable
    }


def _read_part(part: Callable[[], Any], label_map: LabelMap | None) -> SceneFields:
    return from_data(part(), label_map)


def _has_scene(part: Callable[[], Any]) -> bool:
    try:
        return bool(scenes_in(part()))
    except MessageError:
        return False


# ------------------------------------------------------------------------------ rooms of a home


def rooms_from_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file with the rooms of a home. Return the fields of a `where` request without a label.

    ``client.where("medicine", **rooms_from_file("home.json"))`` asks about the rooms.

    Args:
        path: name of a JSON file, or ``-`` for standard input. It is the file of a `Home`; or a
            request; or its rooms, as a list or as a mapping from their names to their objects.

    Raises:
        MessageError: the file cannot be read, or it does not contain rooms.
        HomeFileError: the file of a `Home` is damaged, or of a newer version.
    """
    name = os.fspath(path)
    content = _bytes(name)
    try:
        return _rooms_in(json_value(text_of(content)), name)
    except MessageError as error:
        raise MessageError(f"{name}: {error}") from None


def _rooms_in(data: Any, name: str) -> dict[str, Any]:
    if isinstance(data, dict) and data.get("format") == FORMAT:
        return state_of(data, name).where_fields()
    if isinstance(data, dict) and "rooms" in data:
        fields = {key: value for key, value in data.items() if key != "label"}
    else:
        fields = {"rooms": data}
    rooms = fields["rooms"]
    if isinstance(rooms, dict):
        rooms = [_room(key, content) for key, content in rooms.items()]
    if not isinstance(rooms, list) or not all(isinstance(room, dict) for room in rooms):
        raise MessageError(
            "this has no rooms: it must be a request of /where, a list of its rooms, or a JSON "
            'object such as {"kitchen": ["fridge", "stove"]}'
        )
    return fields | {"rooms": rooms}


def _room(name: str, content: Any) -> Any:
    if isinstance(content, list):
        return {"id": name, "objects": content}
    return {"id": name, **content} if isinstance(content, dict) else content


# ----------------------------------------------------------------------------------- label maps


def label_map_of(option: str) -> dict[str, str | None]:
    """Return the labels of the class ids that a name, or the name of a file, stands for.

    Raises:
        MessageError: the file cannot be read or does not contain labels.
    """
    if option in WELL_KNOWN:
        return read_label_map(option)
    try:
        return labels_in(text_of(_bytes(option)))
    except MessageError as error:
        raise MessageError(f"--label-map: {option}: {error}") from None


def labels_in(text: str) -> dict[str, str | None]:
    """Return the labels of class ids in a text; its syntax decides how to read it.

    The text has one label a line, or an id and a label a line; or it is JSON or YAML of a data set,
    a model (`id2label`) or the parameters of a ROS node; or a label map of TensorFlow. The name of
    a known list, such as coco80, stands for its labels.

    Raises:
        MessageError: the text does not contain labels.
    """
    try:
        names = text if text in WELL_KNOWN else _names_in(data_of(text))
        if names is None:
            raise MessageError("send one label a line, or ids and labels")
        return read_label_map(names)
    except MessageError as error:
        raise MessageError(f"the label map does not contain labels: {error}") from None


_NAMES: Final = (
    *("names", "id2label", "label_map", "class_names", "class_labels", "labels", "classes"),
    *("categories", "class_map", "label2id"),
)


_IDS: Final = ("id", "class_id", "LabelName")
_LABELS: Final = ("DisplayName", "name", "class_name", "label", "raw_category", "category")


def _first(entry: dict[str, Any], *names: str, default: Any = None) -> Any:
    return next((entry[name] for name in names if name in entry), default)


_DEEPEST: Final = 6


def _names_in(data: Any, depth: int = _DEEPEST) -> Any:
    """Return the labels in data: a list, or a dictionary by class ids; None without labels."""
    if isinstance(data, list):
        records = [one for one in data if isinstance(one, dict)]
        if any({"box", "bbox", "score", "confidence"} & one.keys() for one in records):
            return None  # detections
        pairs = [
            (_first(one, *_IDS, default=n), _first(one, *_LABELS)) for n, one in enumerate(records)
        ]
        if not all(label for _, label in pairs):
            return None
        return dict(pairs) or data or None
    if not isinstance(data, dict) or not depth:
        return None
    named = [name for name in _NAMES if name in data]
    for name in named or data:
        found = _names_in(data[name], depth - 1)
        if found is not None and (named or isinstance(data[name], dict)):
            return found
    if not named and data and all(type(number) is int for number in data.values()):
        return {number: label for label, number in data.items()}  # from labels to ids
    has_ids = depth == _DEEPEST or all(str(key).isdecimal() for key in data)
    is_flat = not named and all(isinstance(label, str) for label in data.values())
    return data if has_ids and is_flat and data else None


# -------------------------------------------------------------------------------------- contents


def _bytes(name: str) -> bytes:
    try:
        if name != "-":
            return read_regular(Path(name).expanduser(), MAX_FILE)
        content = sys.stdin.buffer.read(MAX_FILE + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MessageError(f"{name}: {str(reason).lower()}") from None
    if len(content) > MAX_FILE:
        raise MessageError(f"{name}: it is too large: it has more than {MAX_FILE} bytes")
    return content
