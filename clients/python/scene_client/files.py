"""Reading of files with scenes, for `scene_client.from_file` and for the command ``scene``."""

from __future__ import annotations

import csv
import json
import os
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

from scene_client.formats import Reader, chosen, from_data, scenes_in
from scene_client.home_state import FORMAT, state_of
from scene_client.image_formats import Lines
from scene_client.ros_fields import WELL_KNOWN, LabelMap, MessageError, read_label_map
from scene_client.vision_msgs import SceneFields
from scene_client.world_formats import LABEL_COLUMNS, Table

MAX_FILE: Final = 64 * 2**20
"""Maximum size of a scene file in bytes. The service has the same upper limit for a body."""

# A file, and the name of one of its scenes. Some of these kinds of files are refused with a reason.
_FILE: Final = re.compile(
    r"(?P<file>.+\.(json|jsonl|csv|txt|xml|ya?ml|zip|gz))(:(?P<scene>.+))?", re.DOTALL
)
_PATH_STARTS: Final = (".", "~", os.sep)

_YAML: Final = (
    "this is YAML, as `ros2 topic echo` prints it: convert it to JSON, for example by "
    "python -c 'import json, sys, yaml; print(json.dumps(next(yaml.safe_load_all(sys.stdin))))'"
)
_PART: Final = 2**16  # characters of XML
_PACKED: Final = (
    "this is compressed: extract it, and choose one of its .json, .xml, .csv or .txt files"
)


def is_file(argument: str) -> bool:
    """Return whether an argument of the command is a file. Labels such as sofa/couch are not."""
    if argument == "-" or _FILE.fullmatch(argument):
        return True
    return os.sep in argument and (argument.startswith(_PATH_STARTS) or Path(argument).exists())


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
    if scene is None and not Path(name).exists() and (parts := _FILE.fullmatch(name)):
        name, scene = parts["file"], parts["scene"]
    content = _bytes(name)
    try:
        return chosen(scenes_of(content, name, labels), scene, name)()
    except MessageError as error:
        raise MessageError(f"{name}: {error}") from None


def scenes_of(content: bytes, name: str, label_map: LabelMap | None = None) -> dict[str, Reader]:
    """Return the readers of all scenes in a file by the names of the scenes.

    Args:
        content: the content of the file.
        name: name of the file. Only its suffix ``.jsonl`` counts.
        label_map: labels of numeric class ids; see `read_label_map`.

    Raises:
        MessageError: the content has an unknown format, or contains no objects.
    """
    text = _text(content)
    if (lines := _json_lines(name, text)) is not None:
        return {
            str(number): partial(_read_line, line, label_map)
            for number, line in enumerate(lines, 1)
            if line.strip()
        }
    return scenes_in(_parsed(text), label_map)


def _read_line(line: str, label_map: LabelMap | None) -> SceneFields:
    return from_data(_parsed(line), label_map)


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
        return _rooms_in(_parsed(_text(content)), name)
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


def label_map_of(option: str) -> dict[str, str | None]:
    """Return the labels of the class ids that a name, or the name of a file, stands for.

    Raises:
        MessageError: the file cannot be read or does not contain labels.
    """
    if option in WELL_KNOWN:
        return read_label_map(option)
    content = _bytes(option)
    try:
        return labels_in(content.decode())
    except ValueError:
        raise MessageError(f"--label-map: {option} does not contain labels") from None


def labels_in(text: str) -> dict[str, str | None]:
    """Return the labels of class ids in JSON, in YAML with `names:`, or of one label a line.

    The name of a known list, such as coco80, stands for its labels.

    Raises:
        MessageError: the text does not contain labels.
    """
    try:
        return read_label_map(text if text in WELL_KNOWN else _names(text))
    except (LookupError, TypeError, ValueError, RecursionError):
        raise MessageError("the label map does not contain labels") from None


def _names(text: str) -> Any:
    try:
        names: Any = json.loads(text)
    except json.JSONDecodeError:
        _, is_yaml, block = f"\n{text}".partition("\nnames:")
        if not is_yaml:
            return text.splitlines()
        entries = re.findall(r"^[ \t]*(?:-|(\d+):)(.+)$", block, re.MULTILINE)
        if inline := re.match(r"[ \t]*\[([^\]]*)\]", block):
            entries = [("", name) for name in inline[1].split(",")]
        return {
            key or n: name.strip().strip("'\"") for n, (key, name) in enumerate(entries)
        } or None
    names = names.get("categories", names) if isinstance(names, dict) else names
    if isinstance(names, list) and isinstance(names[0], dict):
        return {entry["id"]: entry["name"] for entry in names}
    return names


def _bytes(name: str) -> bytes:
    try:
        if name == "-":
            text = sys.stdin.buffer.read(MAX_FILE + 1)
        else:
            with Path(name).expanduser().open("rb") as file:
                text = file.read(MAX_FILE + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MessageError(f"{name}: {str(reason).lower()}") from None
    if len(text) > MAX_FILE:
        raise MessageError(f"{name} is too large: it has more than {MAX_FILE} bytes")
    return text


def _text(content: bytes) -> str:
    if content.startswith((b"PK\x03\x04", b"\x1f\x8b")):  # ZIP and gzip
        raise MessageError(_PACKED)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise MessageError("this is not JSON and no other text in UTF-8") from None


def _json_lines(name: str, text: str) -> list[str] | None:
    """Return the lines of a file with one JSON value per line; None for other files."""
    first, _, rest = text.lstrip().partition("\n")
    if not rest.strip() or not first.rstrip().endswith(("}", "]")) or first[:1] not in "{[":
        return [text] if name.endswith(".jsonl") else None
    try:
        json.loads(first)
    except (ValueError, RecursionError):
        return text.split("\n") if name.endswith(".jsonl") else None
    return text.split("\n")


def _parsed(text: str) -> Any:
    start = text.lstrip()[:1]
    if start == "<":
        return _xml(text)
    if start not in "{[":
        lines = [line for line in re.split(r"\r?\n", text) if line.strip()]
        if (table := _table(lines)) is not None:
            return table
        words = [line.split() for line in lines]
        if all(len(line) >= 5 and all(map(_is_number, line)) for line in words):
            return Lines(words)
        if re.match(r"---\s|[\w.-]+:(\s|$)", text):
            raise MessageError(_YAML)
        labels = [label.strip() for line in lines for label in line.split(",") if label.strip()]
        if labels and not re.search(r'[{}[\]":<]', text) and not any(map(_is_number, labels)):
            return labels
    try:
        return json.loads(text)
    except RecursionError:
        raise MessageError("this is not JSON that can be read: its nesting is too deep") from None
    except ValueError as error:
        raise MessageError(f"this is not JSON, and no other known format: {error}") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _table(lines: list[str]) -> Table | None:
    """Return the rows of a CSV file, or None if the first line does not name the columns."""
    header = lines[0].lower()
    delimiter = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    if len(names) < 2 or not set(LABEL_COLUMNS) & set(names):
        return None
    if len(set(names)) < len(names):
        raise MessageError("this is a table with two columns of the same name")
    rows = csv.reader(lines[1:], delimiter=delimiter, strict=True)
    try:
        return Table(dict(zip(names, map(str.strip, row), strict=False)) for row in rows)
    except csv.Error as error:
        raise MessageError(f"this is not a table that can be read: {error}") from None


def _xml(text: str) -> ElementTree.Element:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise MessageError("this is XML with a document type, which this program does not read")
    try:
        # Expat bounds the expansion of entities, and a document type is refused above. Between two
        # parts of the text, other threads run.
        parser, step = ElementTree.XMLParser(), max(_PART, len(text) // 32)  # noqa: S314
        for at in range(0, len(text), step):
            parser.feed(text[at : at + step])
        root = parser.close()
    except ElementTree.ParseError as error:
        raise MessageError(f"this is not XML that can be read: {error}") from None
    if root.tag != "annotations":
        raise MessageError(
            f"this is XML with the root <{root.tag[:40]}>; only exports of CVAT are read"
        )
    return root
